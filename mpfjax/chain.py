"""What a chain of moves needs beside the moves: checks, results, memory, parents, shared models."""

from collections.abc import Callable, Iterable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key, PyTree

from mpfjax.checks import check_callable, check_whole, is_series, shown
from mpfjax.mixture import ParticleMixture
from mpfjax.models.base import AbstractStateSpaceModel
from mpfjax.models.inputs import with_inputs
from mpfjax.moves.base import AbstractMove
from mpfjax.moves.every import Every, with_inner
from mpfjax.operations.islands import excess_over_islands, island_index, num_islands
from mpfjax.operations.logarithms import scaled_log_sum_exp
from mpfjax.operations.stored import take

Moves = tuple[AbstractMove, ...]


class FunctionMove(AbstractMove):
    """A function `(key, mixture, observation) -> mixture` as a move; what it does is not known."""

    function: Callable[..., ParticleMixture]

    approximate = True

    def __call__(
        self, key: Key[Array, ""], mixture: ParticleMixture, observation: PyTree = None
    ) -> ParticleMixture:
        """What the function returns."""
        return self.function(key, mixture, observation)

    def predict(self, key: Key[Array, ""], mixture: ParticleMixture) -> ParticleMixture:
        """Raise a `ValueError`: a function does not say what it does without an observation."""
        del key, mixture
        raise ValueError(f"moves: {self.function!r} does not define predict, for a missing y_t")


def as_moves(moves: Any, name: str) -> Moves:
    """The moves as a tuple; a `ValueError` for other things, or a single move without a list."""
    if not is_series(moves):
        raise ValueError(f"{name}: {shown(moves)} is not a list of moves")
    moves = tuple(moves)
    for move in moves:
        check_callable("a move, (key, mixture, observation) -> mixture", **{name: move})
    return tuple(m if isinstance(m, AbstractMove) else FunctionMove(m) for m in moves)


def name_of(move: AbstractMove) -> str:
    """The name of the move's class, or of the user's function."""
    function = move.function if isinstance(move, FunctionMove) else move
    return getattr(function, "__name__", type(function).__name__)


# Checks, before anything compiles.


def check_chain(moves: Moves, num_particles: int, num_components: int) -> None:
    """Raise a `ValueError` for moves that make no filter of this size."""
    check_whole(num_particles=num_particles, num_components=num_components)
    if num_particles < num_components:
        raise ValueError(
            f"num_particles: {num_particles} is less than num_components, {num_components};"
            " every component needs a particle"
        )
    for move in with_inner(moves):
        per_component = move.particles_per_component
        if per_component is not None and per_component * num_components > num_particles:
            raise ValueError(
                f"particles_per_component: {per_component} for each of {num_components}"
                f" components needs more than num_particles, {num_particles}"
            )
    if not moves:
        raise ValueError("moves: a filter needs at least one")
    if not any(move.weighs for move in moves):
        raise ValueError(
            f"moves: {', '.join(map(name_of, moves))} never weigh the particles by what is"
            " observed, and log Ẑ would be 0; Propagate does, or Reweight after Predict"
        )
    _check_memory(moves)
    _check_parents(moves)


def _check_memory(moves: Moves) -> None:
    """Each memory has one keeper, and each that is read has one."""
    keepers: dict[str, str] = {}
    for move in with_inner(moves):
        for name in move.own_memory:
            if name in keepers:
                raise ValueError(
                    f"moves: {keepers[name]} and {name_of(move)} would share one memory, {name!r}"
                )
            keepers[name] = name_of(move)
    for move in with_inner(moves):
        for name in sorted(move.reads - set(keepers)):
            raise ValueError(
                f"moves: {name_of(move)} reads the memory {name!r}, which none of them keeps"
            )


def _check_parents(moves: Moves) -> None:
    """Where a move needs x_{t-1} of the particles, no move loses it after the propagation."""
    if not any(move.needs_parents for move in moves):
        return
    first = next((t for t, move in enumerate(moves) if move.propagates), 0)
    check_keep_parents("moves", moves[first:], "another move")
    for move in moves:
        inner = move.moves if isinstance(move, Every) and move.needs_parents else ()
        if not all(m.needs_parents or m.regroups for m in inner):
            raise ValueError(
                "moves: an Every with a move that needs x_(t-1) may only regroup beside it"
            )


def check_keep_parents(argument: str, moves: Iterable[AbstractMove], needed_by: str) -> None:
    """Raise a `ValueError` that names a move after which particles have no single parents."""
    for move in with_inner(moves):
        if not isinstance(move, Every) and not move.keeps_parents:
            raise ValueError(
                f"{argument}: {name_of(move)} leaves no particle one parent x_(t-1), which"
                f" {needed_by} needs"
            )


# One move of a step.


def moved_by(
    move: AbstractMove,
    key: Key[Array, ""],
    mixture: ParticleMixture,
    observation: PyTree,
    moves: Moves,
) -> ParticleMixture:
    """The mixture after one move of the chain: by y_t, or by a prediction where that is None."""
    if observation is None:
        return check_result(move.predict(key, mixture), mixture, move)
    after = (lambda moved: forgetting(moves, moved),) if isinstance(move, Every) else ()
    run = lambda mixture: move(key, mixture, observation, *after)  # noqa: E731
    if any(other.needs_parents for other in moves):
        return check_result(_with_parents(run, move.propagates, mixture), mixture, move)
    return check_result(run(mixture), mixture, move)


def _with_parents(
    run: Callable[[ParticleMixture], Any], propagates: bool, mixture: ParticleMixture
) -> Any:
    """What the move returns, with x_{t-1} of the particles in their new slots."""
    before = mixture.parents
    if before is None:
        if not propagates:
            return run(mixture)
        before = mixture.particles
    # The slots that this move alone takes the particles from.
    own = jnp.arange(mixture.num_particles, dtype=jnp.int32)
    moved = run(mixture.replace(ancestor_indices=own))
    places = moved.ancestor_indices
    return moved.replace(
        parents=jax.tree.map(lambda leaf: take(leaf, places), before),
        ancestor_indices=take(mixture.ancestor_indices, places),
    )


def check_result(moved: Any, mixture: ParticleMixture, move: AbstractMove) -> ParticleMixture:
    """The result of a move; a `ValueError` unless it is a mixture of the same shapes and types."""
    who = f"moves: {name_of(move)} returned"
    if not isinstance(moved, ParticleMixture):
        raise ValueError(f"{who} {shown(moved)}, no ParticleMixture")
    names = ("particles", "log_weights", "component_indicators")
    for name, new, old in ((n, getattr(moved, n), getattr(mixture, n)) for n in names):
        structures = jax.tree.structure(new), jax.tree.structure(old)
        if structures[0] != structures[1]:
            raise ValueError(
                f"{who} {name} of another structure, {structures[0]}, than it was given,"
                f" {structures[1]}"
            )
        for own, given in zip(jax.tree.leaves(new), jax.tree.leaves(old), strict=True):
            own_kind, kind = (
                f"{jnp.result_type(leaf)}{list(jnp.shape(leaf))}" for leaf in (own, given)
            )
            if own_kind != kind:
                raise ValueError(f"{who} {name} of {own_kind}, and was given {kind}")
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
    memory, dead = mixture.memory, ~mixture.active
    for move in moves:
        memory = move.forget(memory, dead)
    return mixture.replace(memory=memory)


def own_ancestors(mixture: ParticleMixture) -> ParticleMixture:
    """The mixture whose particles are their own ancestors, before a step."""
    own = jnp.arange(mixture.num_particles, dtype=jnp.int32)
    if num_islands() > 1:
        own += mixture.num_particles * island_index()
    return mixture.replace(ancestor_indices=own)


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
