"""A choice that all runs of a `vmap` make together, so that only one branch runs.

Under `vmap`, `jax.lax.cond` becomes a `where` as soon as its condition differs from run to run, and
both branches run. Where the expensive branch gives the right result for every run, the runs can
choose together: if one needs the expensive branch, all take it.
"""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array, Bool, Int, Key, PyTree


def cond_if_any(
    is_needed: Bool[Array, ""], dear: Callable[[], PyTree], cheap: Callable[[], PyTree]
) -> PyTree:
    """`dear()` if any run of the caller's `vmap` needs it, `cheap()` otherwise.

    For a run that does not need it, `dear()` must give the result of `cheap()`.
    """
    return jax.lax.cond(any_run(is_needed), dear, cheap)


def drawn_once(key: Key[Array, "*num"], draw: Callable[..., PyTree]) -> PyTree:
    """`draw(key)`, computed once, where XLA would draw again in each operation that uses it.

    It is a branch that is always taken, which XLA cannot know: no word of a key has more bits than
    32. Unlike `stored`, this takes numbers of any kind, and NaN. Use it where draws are made once
    in a program and many operations use them: each would take part of a second to compile. Outside
    of a program it is `draw(key)` itself.
    """
    if not isinstance(key, Tracer):
        return draw(key)
    function = partial(draw, key)
    holds = any_run(jnp.all(jax.lax.population_count(jax.random.key_data(key)) <= 32))
    shapes = jax.eval_shape(function)
    nothing = lambda: jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes)  # noqa: E731
    return jax.lax.cond(holds, function, nothing)


@jax.custom_batching.custom_vmap
def most_of_runs(number: Int[Array, ""]) -> Int[Array, ""]:
    """The largest of the numbers of the caller's `vmap`, the same for all its runs."""
    return number


@most_of_runs.def_vmap
def _most_of_many_runs(
    axis_size: int, in_batched: list[bool], numbers: Int[Array, " b"]
) -> tuple[Int[Array, ""], bool]:
    del axis_size, in_batched
    # A `vmap` around this one combines its own runs.
    return most_of_runs(jnp.max(numbers)), False


@jax.custom_batching.custom_vmap
def any_run(is_needed: Bool[Array, ""]) -> Bool[Array, ""]:
    """Whether it is needed in any run of the caller's `vmap`, the same for all of them."""
    return is_needed


@any_run.def_vmap
def _any_run_of_many(
    axis_size: int, in_batched: list[bool], is_needed: Bool[Array, " b"]
) -> tuple[Bool[Array, ""], bool]:
    del axis_size, in_batched
    # A `vmap` around this one combines its own runs.
    return any_run(jnp.any(is_needed)), False
