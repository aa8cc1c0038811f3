"""Conditional SMC: a filter run with one trajectory kept, and a new trajectory from it."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Int, Key, PyTree

from mpfjax.checks import as_numbers, check_flag, check_key, check_type, shown
from mpfjax.filter import Filter, Start
from mpfjax.mixture import ParticleMixture
from mpfjax.models.base import AbstractStateSpaceModel, model_name, require
from mpfjax.models.conditionally_linear import refuse_marginalised
from mpfjax.moves.base import AbstractRegrouping
from mpfjax.moves.conditional import (
    REFERENCE,
    ConditionalPropagation,
    ConditionalResample,
    at,
    put,
)
from mpfjax.moves.every import Every
from mpfjax.moves.initial import sample_initial
from mpfjax.moves.island_interaction import IslandInteraction
from mpfjax.moves.propagation.propagate import Predict, Propagate, Reweight
from mpfjax.moves.resampling.resample import Resample
from mpfjax.observations import Series, as_series
from mpfjax.operations.compiling import jit_on_wide_vectors, with_floats_traced
from mpfjax.operations.random import split, uniform
from mpfjax.running.scan import FilterRun, checked, scan
from mpfjax.smoothing.backward import draw, log_transitions
from mpfjax.smoothing.history import mixtures_of
from mpfjax.smoothing.trajectories import draw_trajectories

_IMPOSSIBLE = "trajectory: its density beside the observations is zero or NaN"


class ConditionalRun(eqx.Module):
    """The result of a conditional filter.

    - `trajectory`: the new one, leaves (t + 1, ...).
    - `run`: the run with all its mixtures, with the kept trajectory among their particles. Its
      marginal likelihood is NOT unbiased, since one particle was not drawn.
    - `slots`: (t + 1,), the slot of the kept trajectory in the mixture of each time.
    - `possible`: (t + 1,), whether the model gives the kept trajectory a density above zero.
    """

    trajectory: PyTree
    run: FilterRun
    slots: Int[Array, " t"]
    possible: Bool[Array, " t"]


def conditional_filter(
    key: Key[Array, ""],
    filter: Filter,
    observations: PyTree,
    trajectory: PyTree,
    *,
    backward: bool = True,
    inputs: PyTree = None,
    missing: str = "error",
) -> ConditionalRun:
    """Run a filter around a trajectory that is kept, and draw a new one from all its particles.

    Conditional SMC (Andrieu, Doucet and Holenstein 2010) with backward sampling (Whiteley 2010;
    Lindsten, Jordan and Schön 2014, section 5). It leaves p(x_0, ..., x_t | y_1..y_t) as it is,
    for every N of at least 2: if `trajectory` is a draw from it, so is the new one. So a chain of
    calls, each with the trajectory of the last, is an MCMC sampler of whole trajectories.

    Why this holds for mixtures. Let Q be the law of all that an ordinary run draws: particles,
    ancestors, indicators. A run and one of its trajectories (slots b_0, ..., b_t), with density
    Ẑ W_t^{b_t} Q / Z, have p(x_0, ..., x_t | y) as the law of the states at these slots. For a
    particle that is resampled within component m, with k_m slots, the weight π_m / k_m of the
    offspring times the probability w_i of the ancestor i is W_i / k_m. So the weights cancel all
    along the trajectory, and what is left is: b_0 is any of N slots, b_s any of the k_m slots of
    the component that the trajectory was in, and all else is drawn by Q. Regrouping is part of Q
    and no more. Indicators are functions of the particles (of all of them, the kept one among
    them) and of numbers drawn apart, so that given the particles their law is the same whichever
    slot is the kept one, and cancels. K-means, merging and splitting move the trajectory from one
    component to another as they do any particle. Both backward sampling and the genealogy then
    draw from the run alone, without regard to which of its trajectories was kept.

    - `trajectory`: x_0, ..., x_t, leaves (t + 1, ...), as one of `sample_trajectories`.
    - `backward`: draw the new trajectory by backward sampling, which needs the model's
      `log_transition`. Without it, by the genealogy: it then differs from the old one only
      in the last steps, unless N is large.
    - `observations`, `inputs`, `missing`: as for `run_filter`.

    x_0 is drawn one particle at a time, also where the model would draw it in strata, and no
    `SelectInitial` chooses it. The model's `sample_transition` must draw particles independently of
    each other.

    Raises `ValueError` for a filter that is no chain of regrouping moves, `Resample`, `Propagate`,
    `Predict` and `Reweight`; a conditionally linear model;
    a proposal without `log_density`; noise that is not independent; a model without
    `log_transition`, unless `backward` is false; a trajectory of other shapes or types than the
    model's states, or of density zero (RuntimeError within jit). Use it in a Gibbs sampler of your
    own; `mpfjax.tuning.particle_gibbs` is one for parameters.
    """
    check_key(key)
    check_type(Filter, "a Filter", filter=filter)
    check_flag(backward=backward)
    check_conditional(filter, backward, "conditional_filter")
    series = as_series(observations, filter.model, inputs, missing)
    trajectory = _as_states(trajectory, filter.model, series.length + 1)
    # Checked before the run: backward sampling could not recover an impossible trajectory.
    _require(_steps_are_possible(filter.model, trajectory, series.inputs))
    run = lambda filter: _run(key, filter, series, trajectory, backward)  # noqa: E731
    found = with_floats_traced(run, filter)
    found = eqx.tree_at(lambda found: found.run, found, checked(found.run))
    if isinstance(found.possible, Tracer):
        return eqx.error_if(found, ~jnp.all(found.possible), _IMPOSSIBLE)
    _require(found.possible)
    return found


def _require(possible: Bool[Array, " t"]) -> None:
    """Raise a `ValueError` that names the first time at which the trajectory is impossible."""
    if not isinstance(possible, Tracer) and not np.all(possible):
        first = int(np.argmin(np.asarray(possible)))
        raise ValueError(f"{_IMPOSSIBLE}, first at index {first} of its times")


@eqx.filter_jit
def _steps_are_possible(
    model: AbstractStateSpaceModel, trajectory: PyTree, inputs: PyTree
) -> Bool[Array, " t"]:
    """At which times the trajectory is possible, regardless of the observations."""
    length = jax.tree.leaves(trajectory)[0].shape[0] - 1
    return _possible(model, trajectory, inputs, jnp.ones(length, bool))


@jit_on_wide_vectors
def _run(key, filter, series, trajectory, backward):
    return renew(key, filter, series, trajectory, backward)


def renew(
    key: Key[Array, ""],
    filter: Filter,
    series: Series,
    trajectory: PyTree,
    backward: bool,
    checked: bool = True,
) -> ConditionalRun:
    """`conditional_filter` under the caller's jit, its arguments unchecked.

    Where the backward sampling is not `checked` either, look at `is_possible` of the trajectory.
    """
    key_slot, key_initial, key_run, key_back = split(key, 4)
    n = filter.num_particles
    first_slot = jnp.clip(jnp.floor(uniform(key_slot, ()) * n).astype(jnp.int32), 0, n - 1)
    particles = _independent_initial(key_initial, filter.model, n)
    start = jax.tree.map(lambda leaf, own: put(leaf, own[0], first_slot), particles, trajectory)
    around = _around(filter, trajectory, first_slot)
    run = scan(Start(key_run, start), around, series, None)
    reference = run.collected.memory[REFERENCE]["slot"]
    log_weights = jax.vmap(at)(run.collected.log_weights, reference)
    later = (log_weights > -jnp.inf) & ~run.degenerate
    slots = jnp.concatenate([first_slot[None], reference])
    drawn = draw_trajectory(key_back, filter.model, run, series.inputs, backward, checked)
    possible = _possible(filter.model, trajectory, series.inputs, later)
    return ConditionalRun(drawn, run, slots, possible)


def _around(filter: Filter, trajectory: PyTree, first_slot: Int[Array, ""]) -> Filter:
    """The same chain of moves around the trajectory."""

    def around(move: Any) -> Any:
        if isinstance(move, Propagate | Predict):
            return ConditionalPropagation(move, trajectory, first_slot)
        return ConditionalResample(move) if isinstance(move, Resample) else move

    return filter.replace(
        moves=[around(move) for move in filter.moves],
        # x_0 is one of N draws of the model's.
        initial_moves=[move for move in filter.initial_moves if not move.weighs],
    )


def _independent_initial(key: Key[Array, ""], model: Any, num_particles: int) -> PyTree:
    """x_0 of every particle, drawn separately: a model may draw many of them in strata."""

    def draw(key: Key[Array, ""]) -> PyTree:
        return jax.tree.map(lambda leaf: leaf[0], sample_initial(key, model, 1))

    return jax.vmap(draw)(split(key, num_particles))


def draw_trajectory(
    key: Key[Array, ""],
    model: AbstractStateSpaceModel,
    run: FilterRun,
    inputs: PyTree,
    backward: bool,
    checked: bool = True,
) -> PyTree:
    """One trajectory of a run, by backward sampling or the genealogy: leaves (t + 1, ...)."""
    mixtures = mixtures_of(run)
    if not backward:
        return _of_the_genealogy(key, mixtures)
    drawn = draw_trajectories(key, model, mixtures, inputs, 1, checked=checked)
    return jax.tree.map(lambda leaf: leaf[0], drawn)


def is_possible(model: Any, trajectory: PyTree, inputs: PyTree) -> Bool[Array, ""]:
    """Whether a trajectory has a density above zero, as far as the model's densities tell."""
    length = jax.tree.leaves(trajectory)[0].shape[0] - 1
    return jnp.all(_possible(model, trajectory, inputs, jnp.ones(length, bool)))


def _of_the_genealogy(key: Key[Array, ""], mixtures: ParticleMixture) -> PyTree:
    """A particle of the last mixture by its weight, and its ancestors."""
    last = jax.tree.map(lambda leaf: leaf[-1], mixtures)
    end = draw(key, (1,), last.log_weights)[0]

    def back(index: Array, ancestors: Array) -> tuple[Array, Array]:
        return at(ancestors, index), index

    first, later = jax.lax.scan(back, end, mixtures.ancestor_indices[1:], reverse=True)
    indices = jnp.concatenate([first[None], later])
    return jax.tree.map(lambda leaf: jax.vmap(at)(leaf, indices), mixtures.particles)


def _possible(
    model: Any, trajectory: PyTree, inputs: PyTree, later: Bool[Array, " t"]
) -> Bool[Array, " all"]:
    """At which times the trajectory has a density above zero, as far as the densities tell."""
    start = jnp.ones((1,), bool)
    if callable(getattr(model, "log_initial", None)):
        start = model.log_initial(jax.tree.map(lambda leaf: leaf[:1], trajectory)) > -jnp.inf
    if callable(getattr(model, "log_transition", None)):
        later &= log_transitions(model, trajectory, inputs) > -jnp.inf
    return jnp.concatenate([start, later])


def check_conditional(filter: Filter, backward: bool, needed_by: str) -> None:
    """Raise a `ValueError` for a filter that cannot keep a trajectory."""
    refuse_marginalised(filter.model, needed_by, "metropolis_hastings and smc2 take it as it is")
    if backward:
        require(filter.model, "log_transition", f"backward sampling in {needed_by}")
    advances = [move for move in filter.moves if isinstance(move, Propagate | Predict)]
    if len(advances) != 1:
        raise ValueError(
            f"filter: {needed_by} needs one Propagate or Predict among its moves, not"
            f" {len(advances)}; moves of other kinds that propagate cannot keep a trajectory, but"
            " particle_filter and mixture_particle_filter can, on any model"
        )
    proposal = getattr(advances[0], "proposal", None)
    if proposal is not None:
        require(proposal, "log_density", needed_by, "proposal")
    if advances[0].noise != "independent":
        raise ValueError(
            f"filter: {needed_by} needs draws that are independent of each other, and not"
            f" noise={advances[0].noise!r}; take noise='independent'"
        )
    for move in filter.moves:
        if isinstance(move, Every) and all(isinstance(m, AbstractRegrouping) for m in move.moves):
            continue
        elif not isinstance(
            move, AbstractRegrouping | Resample | Propagate | Predict | Reweight | IslandInteraction
        ):
            raise ValueError(
                f"filter: {type(move).__name__} cannot keep a trajectory, as {needed_by} does;"
                " regrouping moves, Resample, Propagate, Predict and Reweight can"
            )


def _as_states(trajectory: Any, model: AbstractStateSpaceModel, length: int) -> PyTree:
    """The trajectory as arrays of the states' types; a `ValueError` for one of other shapes."""
    like = jax.eval_shape(lambda key: sample_initial(key, model, 1), jax.random.key(0))
    own, expected = jax.tree.structure(trajectory), jax.tree.structure(like)
    of_states = f"of the states of {model_name(model)}"
    if own != expected:
        raise ValueError(
            f"trajectory: {shown(trajectory)} has not the structure {of_states}, {expected}"
        )

    def convert(leaf: Any, state: jax.ShapeDtypeStruct) -> Array:
        leaf = as_numbers("trajectory", leaf)
        shape = (length, *state.shape[1:])
        if jnp.shape(leaf) != shape:
            raise ValueError(
                f"trajectory: shape {jnp.shape(leaf)} is not {shape}, x_0 and one state"
                f" for each of the observations, {of_states}"
            )
        if not np.can_cast(jnp.result_type(leaf), state.dtype, "same_kind"):
            raise ValueError(
                f"trajectory: {jnp.result_type(leaf)} is not {state.dtype}, that {of_states}"
            )
        return jnp.asarray(leaf, state.dtype)

    return jax.tree.map(convert, trajectory, like)
