"""The moves of a filter, checked: there are some, one weighs, each returns a mixture; its mass."""

from collections.abc import Iterable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mpfjax.checks import check_callable, check_whole, is_series, shown
from mpfjax.mixture import ParticleMixture
from mpfjax.operations.across_islands import excess_over_islands
from mpfjax.operations.logarithms import scaled_log_sum_exp


def as_moves(moves: Any, name: str) -> tuple[Any, ...]:
    """The moves as a tuple; a `ValueError` for other things, or a single move without a list."""
    if not is_series(moves):
        raise ValueError(f"{name}: {shown(moves)} is not a list of moves")
    moves = tuple(moves)
    for move in moves:
        check_callable("a move, (key, mixture, observation) -> mixture", **{name: move})
    return moves


def check_result(moved: Any, mixture: ParticleMixture, move: Any) -> ParticleMixture:
    """The result of a move; a `ValueError` unless it is a mixture of the same shapes and types."""
    who = f"moves: {getattr(move, '__name__', type(move).__name__)} returned"
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


def check_weighed(moves: tuple[Any, ...]) -> None:
    """Raise a `ValueError` for no moves, and where none of them weighs by the observation."""
    if not moves:
        raise ValueError("moves: a filter needs at least one")
    if not any(getattr(move, "weighs", True) for move in moves):
        names = ", ".join(type(move).__name__ for move in moves)
        raise ValueError(
            f"moves: {names} never weigh the particles by what is observed, and log Ẑ would be 0;"
            " Propagate does, or Reweight after Predict"
        )


def check_sizes(moves: Iterable[Any], num_particles: int, num_components: int) -> None:
    """Raise a `ValueError` unless every component has the particles that it needs."""
    check_whole(num_particles=num_particles, num_components=num_components)
    if num_particles < num_components:
        raise ValueError(
            f"num_particles: {num_particles} is less than num_components, {num_components};"
            " every component needs a particle"
        )
    for move in moves:
        per_component = getattr(move, "particles_per_component", None)
        if per_component is not None and per_component * num_components > num_particles:
            raise ValueError(
                f"particles_per_component: {per_component} for each of {num_components}"
                f" components needs more than num_particles, {num_particles}"
            )


def same_mass(moved: ParticleMixture, mixture: ParticleMixture) -> bool:
    """Whether a move has returned the very weights that it was given, as one that only learns."""
    return moved.log_weights is mixture.log_weights and moved.log_scale is mixture.log_scale


def normalised(
    mixture: ParticleMixture, previous: ParticleMixture, may_be_empty: bool
) -> tuple[ParticleMixture, Float[Array, ""]]:
    """Remove the growth of the mass. If no mass is left, keep the previous weights or, where a
    mixture may be empty, none.

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
    without_mass = mixture.log_weights if may_be_empty else previous.log_weights
    log_weights = jnp.where(keep, shares, without_mass)
    log_growth = log_scale + log_total
    if may_be_empty:
        log_growth = jnp.where(keep, log_growth, 0.0)
    normalised = mixture.replace(log_weights=log_weights, log_scale=jnp.zeros_like(log_total))
    return normalised, log_growth
