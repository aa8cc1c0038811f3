"""A bar that shows how far a compiled run has come."""

import contextlib
import itertools
from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int
from tqdm import tqdm

from mpfjax.operations.compiling import is_traced

_MOST_CALLS = 100  # calls of the host by one program, at equal distances of the run
_bars: dict[int, tqdm] = {}
_numbers = itertools.count()


class Bar(NamedTuple):
    """The bar that a program advances, and the number of runs that each of its steps counts for."""

    number: Int[Array, ""] | np.ndarray
    num_runs: int = 1


@contextlib.contextmanager
def shown_progress(progress: bool, num_steps: int, arguments: Any) -> Iterator[Bar | None]:
    """A bar of this many steps, or None without `progress` or where the caller compiles the run."""
    if not progress or is_traced(arguments):
        yield None
        return
    number = next(_numbers)
    with tqdm(total=num_steps, unit="step", disable=jax.process_index() > 0) as bar:
        _bars[number] = bar
        try:
            yield Bar(np.asarray(number % 2**31, np.int32))
            jax.effects_barrier()
        finally:
            del _bars[number]


def advance_bar(bar: Bar, step: Int[Array, ""], length: int) -> None:
    """Count the step, within the program: the host is told of many at once.

    `step` must be the same for all runs under `vmap`, which then tell the host once together.
    """
    every = -(-length // _MOST_CALLS)
    done = step + 1
    since = jnp.where(done % every == 0, every, done % every)
    jax.lax.cond(
        (done % every == 0) | (done == length),
        lambda: jax.debug.callback(_advance, bar.number, since * bar.num_runs),
        lambda: None,
    )


def _advance(number: Any, num_steps: Any) -> None:
    bar = _bars.get(int(number))
    if bar is not None:  # runs that fill up the last block are not counted
        bar.update(min(int(num_steps), (bar.total or 0) - bar.n))
