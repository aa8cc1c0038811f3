"""A choice that all runs of a `vmap` make together, so that only one branch runs.

Under `vmap`, `jax.lax.cond` becomes a `where` as soon as its condition differs from run to run, and
both branches run. Where the expensive branch gives the right result for every run, the runs can
choose together: if one needs the expensive branch, all take it.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, PyTree


def cond_if_any(
    is_needed: Bool[Array, ""], dear: Callable[[], PyTree], cheap: Callable[[], PyTree]
) -> PyTree:
    """`dear()` if any run of the caller's `vmap` needs it, `cheap()` otherwise.

    For a run that does not need it, `dear()` must give the result of `cheap()`.
    """
    return jax.lax.cond(any_run(is_needed), dear, cheap)


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
