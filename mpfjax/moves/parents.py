"""x_{t-1} of every particle, for the moves after the propagation that need it."""

from collections.abc import Callable, Iterable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Key

from mpfjax.mixture import ParticleMixture
from mpfjax.moves.base import AbstractMove, AbstractPropagation, AbstractRegrouping
from mpfjax.moves.every import Every, with_inner
from mpfjax.operations.indexing import take


def runner(moves: tuple[Any, ...]) -> Callable[..., ParticleMixture]:
    """A function that runs one of the moves, and keeps `mixture.parents` if any move needs them.

    Raises `ValueError` where the parents would not be known.
    """
    if not any(_needs_parents(move) for move in moves):
        return lambda move, *arguments: move(*arguments)
    first = next((t for t, move in enumerate(moves) if isinstance(move, AbstractPropagation)), None)
    check_keep_parents("moves", moves[first:], "another move")
    for move in moves:
        inner = move.moves if isinstance(move, Every) and _needs_parents(move) else ()
        if not all(_needs_parents(m) or isinstance(m, AbstractRegrouping) for m in inner):
            raise ValueError(
                "moves: an Every with a move that needs x_(t-1) may only regroup beside it"
            )
    return _run_with_parents


def check_keep_parents(argument: str, moves: Iterable[Any], needed_by: str) -> None:
    """Raise a `ValueError` that names a move after which particles have no single parents."""
    for move in with_inner(moves):
        if not isinstance(move, Every) and not getattr(move, "keeps_parents", True):
            raise ValueError(
                f"{argument}: {type(move).__name__} leaves no particle one parent x_(t-1), which"
                f" {needed_by} needs"
            )


def _needs_parents(move: Any) -> bool:
    return isinstance(move, AbstractMove) and move.needs_parents


def _run_with_parents(
    move: Any, key: Key[Array, ""], mixture: ParticleMixture, *arguments: Any
) -> ParticleMixture:
    """Run the move, and keep the parents of the particles in their new slots."""
    before = mixture.parents
    if before is None:
        if not isinstance(move, AbstractPropagation):
            return move(key, mixture, *arguments)
        before = mixture.particles
    # The slots that this move alone takes the particles from.
    own = jnp.arange(mixture.num_particles, dtype=jnp.int32)
    moved = move(key, mixture.replace(ancestor_indices=own), *arguments)
    places = moved.ancestor_indices
    return moved.replace(
        parents=jax.tree.map(lambda leaf: take(leaf, places), before),
        ancestor_indices=take(mixture.ancestor_indices, places),
    )
