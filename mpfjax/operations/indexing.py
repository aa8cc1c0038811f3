"""Gathers and scatters: values at given indices, and how often each index is named.

In numpy: `values[indices]`, `np.bincount(places)` and `np.argsort(places)`. Here indices are known
to be in range, so nothing is clipped. Under `vmap` all rows of a scatter become one long row, since
a CPU scatters with single indices in half the time of pairs of indices.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Int, Shaped, UInt32

from mpfjax.checks import check_numbered
from mpfjax.operations.gradients import without_gradient
from mpfjax.operations.stored import stored


def take(values: Array, indices: Int[Array, " n"]) -> Array:
    """values[indices] for indices that are known to lie in range."""
    return values.at[from_the_start(indices)].get(mode="promise_in_bounds")


def from_the_start(indices: Int[Array, "*shape"]) -> UInt32[Array, "*shape"]:
    """Indices without a sign, so that JAX does not check whether they count from the end."""
    return indices.astype(jnp.uint32)


def count_places(
    places: Int[Array, " n"], num_places: int, dtype: DTypeLike = jnp.int32
) -> Shaped[Array, " num_places"]:
    """How many of the entries name each place, all of which must be in [0, num_places)."""

    def scatter(rows: Int[Array, "k n"]) -> Shaped[Array, "k num_places"]:
        line = jnp.zeros(rows.shape[0] * num_places, dtype).at[_on_one_line(rows, num_places)]
        return line.add(1, mode="promise_in_bounds").reshape(-1, num_places)

    return in_rows(scatter)(places)


def inverse_permutation(places: Int[Array, " n"]) -> Int[Array, " n"]:
    """The index at each place, given every index's place."""
    n = places.shape[0]

    def scatter(rows: Int[Array, "k n"]) -> Int[Array, "k n"]:
        index = jnp.broadcast_to(jnp.arange(n, dtype=jnp.int32), rows.shape).reshape(-1)
        line = jnp.zeros(index.shape, jnp.int32).at[_on_one_line(rows, n)]
        return line.set(index, mode="promise_in_bounds", unique_indices=True).reshape(-1, n)

    return in_rows(scatter)(stored(places))


def _on_one_line(rows: Int[Array, "k n"], num_places: int) -> UInt32[Array, " k*n"]:
    check_numbered(
        "places up to", rows.shape[0] * num_places, num_particles=rows.shape[1],
        runs_at_once=rows.shape[0],
    )  # fmt: skip
    firsts = num_places * jnp.arange(rows.shape[0], dtype=jnp.int32)
    return from_the_start((rows + firsts[:, None]).reshape(-1))


def in_rows(scatter: Callable[..., Array]) -> Callable[..., Array]:
    """A scatter over one row. Under `vmap`, all rows become one long row.

    On a CPU that takes about half the time of a scatter with pairs of indices. A derivative treats
    it as a constant: JAX would apply the rule below to itself without end.
    """
    scatter_rows = jax.custom_batching.custom_vmap(scatter)

    @scatter_rows.def_vmap
    def _(
        axis_size: int, in_batched: list[bool], *arguments: Shaped[Array, "..."]
    ) -> tuple[Shaped[Array, "b k p"], bool]:
        every = [
            rows if is_batched else jnp.broadcast_to(rows, (axis_size, *rows.shape))
            for rows, is_batched in zip(arguments, in_batched, strict=True)
        ]
        scattered = scatter_rows(*(rows.reshape(-1, rows.shape[-1]) for rows in every))
        return scattered.reshape(axis_size, -1, scattered.shape[-1]), True

    return lambda *arguments: scatter_rows(*(row[None] for row in without_gradient(arguments)))[0]
