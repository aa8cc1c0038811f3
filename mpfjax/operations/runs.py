"""Sums, maxima and places of segments that stand side by side, with labels in ascending order.

In numpy: `np.add.reduceat(values, firsts)`. Values are taken in blocks. A block strictly between a
segment's first and last block is all its own, so its sum is taken as it is. Only of the first and
last block the entries are looked at. There is no scatter, and nothing is recomputed.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Shaped

from mpfjax.operations.indexing import take
from mpfjax.operations.stored import block_size, stored, whole_blocks


class Runs(NamedTuple):
    """Where segments stand, in blocks of places; all of them fill whole blocks."""

    labels: Int[Array, "blocks size"]
    first_blocks: Int[Array, " m"]
    last_blocks: Int[Array, " m"]

    def sums(self, values: Float[Array, " p"]) -> Float[Array, " m"]:
        """The sum of each segment's values."""
        return self._reduced(values, jnp.sum, 0.0)

    def maxima(self, values: Float[Array, " p"]) -> Float[Array, " m"]:
        """The largest value of each segment, -inf for an empty one."""
        return self._reduced(values, jnp.max, -jnp.inf)

    def extents(self, mask: Bool[Array, " p"]) -> tuple[Int[Array, " m"], Int[Array, " m"]]:
        """The first and the last masked place of each segment; some place where it has none."""
        places = jnp.arange(mask.shape[0], dtype=jnp.int32)
        last = mask.shape[0] - 1
        firsts = self._reduced(jnp.where(mask, places, last), jnp.min, last)
        lasts = self._reduced(jnp.where(mask, places, 0), jnp.max, 0)
        return firsts, lasts

    def _reduced(
        self, values: Shaped[Array, " p"], reduce: Callable[..., Array], nothing: float
    ) -> Shaped[Array, " m"]:
        blocks = values.reshape(self.labels.shape)
        empty = jnp.array(nothing, values.dtype)
        block = jnp.arange(blocks.shape[0], dtype=jnp.int32)[:, None]
        is_inside = (block > self.first_blocks[None]) & (block < self.last_blocks[None])
        of_blocks = reduce(blocks, axis=1)
        inside = reduce(jnp.where(is_inside, of_blocks[:, None], empty), axis=0)
        label = jnp.arange(self.first_blocks.shape[0], dtype=self.labels.dtype)[:, None]

        def within(block: Int[Array, " m"], counts: Bool[Array, " m"]) -> Shaped[Array, " m"]:
            is_own = (take(self.labels, block) == label) & counts[:, None]
            return reduce(jnp.where(is_own, take(blocks, block), empty), axis=1)

        is_another = self.last_blocks > self.first_blocks
        parts = [
            inside,
            within(self.first_blocks, jnp.ones_like(is_another)),
            within(self.last_blocks, is_another),
        ]
        return reduce(jnp.stack(parts), axis=0)


def runs_of(labels: Int[Array, " p"], num_segments: int) -> Runs:
    """The runs of labels in ascending order, whole blocks of them."""
    blocks = labels.reshape(-1, block_size(labels.shape[0]))
    label = jnp.arange(num_segments, dtype=labels.dtype)[None]
    last = blocks.shape[0] - 1
    before = jnp.sum((blocks[:, -1:] < label).astype(jnp.int32), axis=0)
    after = jnp.sum((blocks[:, :1] > label).astype(jnp.int32), axis=0)
    bound = blocks.shape[0] + 1
    return Runs(
        blocks,
        stored(jnp.minimum(before, last), bound),
        stored(jnp.maximum(last - after, 0), bound),
    )


def whole(values: Array, fill: float) -> Array:
    """The values, filled up to whole blocks."""
    n = values.shape[0]
    return jnp.pad(values, (0, whole_blocks(n) - n), constant_values=fill)
