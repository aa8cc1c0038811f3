"""What a chain needs beside its moves: reports, checks, one move, memory, faults, shared models."""

from collections.abc import Iterable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key, PyTree

from mpfjax.checks import kinds, shown
from mpfjax.mixture import ParticleMixture
from mpfjax.models.base import AbstractStateSpaceModel, with_inputs
from mpfjax.models.observations import Fault, faults_of
from mpfjax.moves.base import AbstractMove, Moves, name_of, with_inner, without_dead
from mpfjax.moves.eve_indices import EVE_INDICES, evidence_variance, mass_variances
from mpfjax.operations.islands import excess_over_islands, island_index, num_islands
from mpfjax.operations.logarithms import scaled_log_sum_exp

# In the memory while a move reads it: the growth of the mass in the step so far.
INCREMENT = "log_increment"
BROKEN_DENSITY = "model: a density was NaN or infinite for some particle"


# The report of a step.


class StepInfo(eqx.Module):
    """The report of a step, which comes with its mixture."""

    log_likelihood_increment: Float[Array, ""]
    """log p(y_t | y_1..y_{t-1}), estimated; -inf where every particle has zero likelihood."""
    effective_sample_sizes: Float[Array, " m"]
    """of each component of the new mixture, zero for a dead one."""
    mixture_weights: Float[Array, " m"]
    """the mass of each component of the new mixture."""
    resampled: Bool[Array, " m"]
    """which components of the mixture that the step was given were resampled."""
    degenerate: Bool[Array, ""]
    """whether every particle had zero likelihood: the weights are then those of the prediction."""
    labels_ran_out: Bool[Array, ""]
    """whether all M > 1 labels are in use, so that more modes share one; see `Split.is_diffuse`."""
    log_marginal_likelihood_error: Float[Array, ""] | None = None
    """the standard error of log Ẑ of all steps so far, from this one run; None unless the filter
    is one of `mpfjax.smoothing.with_first_ancestors`."""
    mixture_weight_errors: Float[Array, " m"] | None = None
    """the standard error of each mixture weight; None likewise."""
    log_evidence_against_start: Float[Array, ""] | None = None
    """log of p(y_t | x_{t-1} ~ p_0) over p(y_t | y_1..y_{t-1}): how much y_t speaks for a state
    that begins anew, against all that the filter knows; None unless a move tells it, as in
    `with_alarm` and `with_restarts`."""


def step_info(
    moves: Moves,
    mixture: ParticleMixture,
    observation: PyTree,
    increment: Float[Array, ""],
    resampled: Bool[Array, " m"],
) -> StepInfo:
    """The report of a step that ended in this mixture."""
    told = (move.evidence_against(mixture, observation, increment) for move in moves)
    degenerate = increment == -jnp.inf
    of_evidence = of_masses = None
    # Families may have members on several islands.
    if EVE_INDICES in mixture.memory and num_islands() == 1:
        variance = jnp.where(degenerate, jnp.inf, evidence_variance(mixture))
        of_evidence = jnp.sqrt(jnp.maximum(variance, 0.0))
        of_masses = jnp.sqrt(jnp.maximum(mass_variances(mixture), 0.0))
    sizes = mixture.component_effective_sample_sizes
    return StepInfo(
        log_likelihood_increment=increment,
        effective_sample_sizes=sizes,
        mixture_weights=mixture.mixture_weights,
        resampled=resampled,
        degenerate=degenerate,
        labels_ran_out=jnp.all(sizes > 0) & (mixture.num_components > 1),
        log_marginal_likelihood_error=of_evidence,
        mixture_weight_errors=of_masses,
        log_evidence_against_start=next((each for each in told if each is not None), None),
    )


# Checks, before anything compiles.


def check_chain(moves: Moves, num_particles: int, num_components: int) -> None:
    """Raise a `ValueError` for moves that make no filter of this size."""
    each = max((move.particles_per_component or 1 for move in with_inner(moves)), default=1)
    if each * num_components > num_particles:
        raise ValueError(
            f"num_particles: {num_particles} is less than particles_per_component, {each}, for each"
            f" of num_components, {num_components}"
        )
    names = ", ".join(map(name_of, moves))
    if not any(move.weighs for move in moves):
        who = f"moves: {names or 'none'}"
        raise ValueError(f"{who} never weigh the particles by what is observed, as Propagate does")
    kept = [name for move in with_inner(moves) for name in move.own_memory] + [INCREMENT]
    read = {name for move in with_inner(moves) for name in move.reads}
    for name in sorted(read | set(kept)):
        if kept.count(name) != 1:
            number = f"{kept.count(name)} of {names}"
            raise ValueError(f"moves: the memory {name!r} is kept by {number}, and not by one")
    if any(move.needs_parents for move in moves):
        first = next((t for t, move in enumerate(moves) if move.propagates), 0)
        check_keep_parents("moves", moves[first:], "another move")


def check_keep_parents(argument: str, moves: Iterable[AbstractMove], needed_by: str) -> None:
    """Raise a `ValueError` that names a move after which particles have no single parents."""
    for move in with_inner(moves):
        if not move.inner and not move.keeps_parents:
            which = f"one parent x_(t-1), which {needed_by} needs"
            raise ValueError(f"{argument}: {name_of(move)} leaves no particle {which}")


# One move of a step.


def moved_by(
    move: AbstractMove,
    key: Key[Array, ""],
    mixture: ParticleMixture,
    observation: PyTree,
    filter: Any,
) -> tuple[ParticleMixture, Bool[Array, " m"]]:
    """The mixture after one move of a filter's chain, and which components that resampled.

    Without an observation the move only predicts. Where initial moves have weighed x_0, it is not
    resampled before y_1 has weighed its particles too: that would undo a choice by y_1.
    """
    moves, none = filter.moves, jnp.zeros(mixture.num_components, bool)
    if observation is None:
        return check_result(move.predict(key, mixture), mixture, move), none
    if move.propagates and mixture.parents is None and any(m.needs_parents for m in moves):
        mixture = mixture.replace(parents=mixture.particles)
    resampled = move.would_resample(mixture, observation)
    after = (lambda moved: forgetting(moves, moved),) if move.inner else ()
    moved = check_result(move(key, mixture, observation, *after), mixture, move)
    if move.propagates:
        return moved.replace(in_order=False), resampled
    if not (move.resamples and filter.looks_at_first):
        return moved, resampled
    waits, before = mixture.log_scale != 0, mixture.replace(in_order=moved.in_order)
    # Not by a condition, which would copy all that goes through it at every step.
    keep = lambda new, old: new if new is old else jnp.where(waits, old, new)  # noqa: E731
    return jax.tree.map(keep, moved, before), resampled & ~waits


def check_result(moved: Any, mixture: ParticleMixture, move: AbstractMove) -> ParticleMixture:
    """The result of a move; a `ValueError` unless it is a mixture of the same shapes and types."""
    who = f"moves: {name_of(move)} returned"
    if not isinstance(moved, ParticleMixture):
        raise ValueError(f"{who} {shown(moved)}, no ParticleMixture")
    parts = lambda of: (of.particles, of.log_weights, of.component_indicators)  # noqa: E731
    if kinds(parts(moved)) != kinds(parts(mixture)):
        raise ValueError(f"{who} {kinds(parts(moved))}, and was given {kinds(parts(mixture))}")
    return moved


def normalised(
    mixture: ParticleMixture, previous: ParticleMixture
) -> tuple[ParticleMixture, Float[Array, ""]]:
    """Remove the growth of the mass. If no mass is left, keep the previous weights.

    The scale is removed first, which is exact. If it were added to it, the sum of the weights would
    be lost to rounding.
    """
    log_sum, log_largest = scaled_log_sum_exp(mixture.log_weights)
    log_excess, log_total, log_scale = excess_over_islands(mixture.log_scale, log_largest, log_sum)
    has_mass = log_total > -jnp.inf
    log_share = log_excess - jnp.where(has_mass, log_total, 0.0)
    shares = (mixture.log_weights - log_largest) + log_share
    # A comparison with NaN is false, but NaN is not a step of zero likelihood.
    keep = has_mass | jnp.isnan(log_total)
    log_weights = jnp.where(keep, shares, previous.log_weights)
    log_growth = log_scale + log_total
    moved = mixture.replace(log_weights=log_weights, log_scale=jnp.zeros_like(log_total))
    return moved, log_growth


def forgetting(moves: Moves, mixture: ParticleMixture) -> ParticleMixture:
    """The mixture without any memory of components that have died."""
    if not mixture.memory:
        return mixture
    return mixture.replace(memory=without_dead(moves, mixture.memory, ~mixture.active))


def own_ancestors(mixture: ParticleMixture) -> ParticleMixture:
    """The mixture whose particles are their own ancestors, before a step."""
    own = jnp.arange(mixture.num_particles, dtype=jnp.int32)
    if num_islands() > 1:
        own += mixture.num_particles * island_index()
    return mixture.replace(ancestor_indices=own)


# Programs, which return the faults that they met.


def step_and_faults(
    filter: Any,
    key: Key[Array, "*keys"],
    mixture: ParticleMixture,
    observation: PyTree,
    inputs: PyTree = None,
) -> tuple[ParticleMixture, StepInfo, tuple[Fault, ...]]:
    """A step inside a compiled program, and what `raise_faults` needs when that has ended.

    `key` may hold the keys of the moves.
    """
    faults = faults_of(filter.model, observation, inputs)
    moved, info = filter.with_inputs(inputs)._step(key, mixture, observation)
    broken = Fault(~(info.log_likelihood_increment < jnp.inf), BROKEN_DENSITY)
    return moved, info, (*faults, broken)


def start_and_faults(
    filter: Any,
    keys: Key[Array, " keys"],
    observation: PyTree,
    inputs: PyTree,
    particles: PyTree,
) -> tuple[ParticleMixture, tuple[Fault, ...]]:
    """The same for the mixture of x_0, of these particles."""
    faults = faults_of(filter.model, observation, inputs)
    return filter.with_inputs(inputs)._init(keys, observation, particles), faults


# Models inside moves: a filter's own is stored once, and all of them are given their inputs.


class _Tied(eqx.Module):
    """Stands in a move where the filter's own model belongs, so that it is stored only once."""


def tie(moves: Moves, model: Any) -> Moves:
    """The moves without the filter's own model."""
    is_model = lambda node: node is model  # noqa: E731
    return jax.tree.map(lambda node: _Tied() if node is model else node, moves, is_leaf=is_model)


def untie(moves: Moves, model: Any) -> Moves:
    """The moves with the filter's own model in its places."""
    is_tied = lambda node: isinstance(node, _Tied)  # noqa: E731
    return jax.tree.map(lambda node: model if is_tied(node) else node, moves, is_leaf=is_tied)


def give_inputs(tree: PyTree, model: Any, inputs: PyTree) -> PyTree:
    """The tree with u_t in `model`, and in every other model; None leaves it as it is."""
    if inputs is None:
        return tree
    is_model = lambda node: node is model or isinstance(node, AbstractStateSpaceModel)  # noqa: E731
    give = lambda node: with_inputs(node, inputs) if is_model(node) else node  # noqa: E731
    return jax.tree.map(give, tree, is_leaf=is_model)
