"""Checks that each move finds the memory that it reads, and that no two moves write the same."""

from typing import Any

import equinox as eqx

from mpfjax.moves.base import AbstractMove
from mpfjax.moves.every import Every, with_inner


def check_memory(moves: tuple[Any, ...]) -> None:
    """Raise a `ValueError` where two moves keep one memory, or one reads what none keeps."""
    held = [move for move in with_inner(moves) if isinstance(move, AbstractMove)]
    keepers: dict[str, str] = {}
    for move in held:
        for name in _own_memory(move):
            if name in keepers:
                raise ValueError(
                    f"moves: {keepers[name]} and {type(move).__name__} would share one memory,"
                    f" {name!r}"
                )
            keepers[name] = type(move).__name__
    for move in held:
        for name in sorted(move.reads - set(keepers)):
            raise ValueError(
                f"moves: {type(move).__name__} reads the memory {name!r}, which none of them keeps"
            )


def _own_memory(move: AbstractMove) -> list[str]:
    if isinstance(move, Every):
        return [move.name]
    return list(eqx.filter_eval_shape(move.initial_memory, 1))  # its names, without its arrays
