"""Sums, maxima and places of segments that stand side by side, with labels in ascending order.

In numpy: `np.add.reduceat(values, firsts)`. Values are taken in blocks, whose sums run on vectors.
A block of one label goes to its segment as a whole. Of the others, which hold a border, each
segment takes its own entries: they can only be in the first and the last block that it stands in.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Shaped

from mpfjax.operations.indexing import take
from mpfjax.operations.segments import REDUCTIONS, segment_reduce
from mpfjax.operations.stored import block_size, stored, whole_blocks


class Runs(NamedTuple):
    """Where segments stand, in blocks of places; all of them fill whole blocks."""

    labels: Int[Array, "blocks size"]
    first_blocks: Int[Array, " m"]
    last_blocks: Int[Array, " m"]

    def sums(self, values: Float[Array, " p"]) -> Float[Array, " m"]:
        """The sum of each segment's values."""
        return self._reduced("add", values, 0.0)

    def maxima(self, values: Float[Array, " p"]) -> Float[Array, " m"]:
        """The largest value of each segment, -inf for an empty one."""
        return self._reduced("max", values, -jnp.inf)

    def extents(self, mask: Bool[Array, " p"]) -> tuple[Int[Array, " m"], Int[Array, " m"]]:
        """The first and the last masked place of each segment; some place where it has none."""
        places = jnp.arange(mask.shape[0], dtype=jnp.int32)
        last = mask.shape[0] - 1
        firsts = self._reduced("min", jnp.where(mask, places, last), last)
        return firsts, self._reduced("max", jnp.where(mask, places, 0), 0)

    def _reduced(
        self, how: str, values: Shaped[Array, " p"], nothing: float
    ) -> Shaped[Array, " m"]:
        m, blocks = self.first_blocks.shape[0], values.reshape(self.labels.shape)
        is_whole = self.labels[:, 0] == self.labels[:, -1]
        reduce = REDUCTIONS[how]
        found = segment_reduce(
            how, reduce(blocks, axis=1), jnp.where(is_whole, self.labels[:, 0], m), m, nothing
        )

        def at(block: Int[Array, " m"], counts: bool | Bool[Array, " m"]) -> Shaped[Array, " m"]:
            """Of the segment's own entries in this block, unless the block is whole."""
            labels = take(self.labels, block)
            counts &= labels[:, 0] != labels[:, -1]
            is_own = labels == jnp.arange(m, dtype=labels.dtype)[:, None]
            own = jnp.where(is_own & counts[:, None], take(blocks, block), nothing)
            return reduce(own.astype(values.dtype), axis=1)

        ends = (
            at(self.first_blocks, True),
            at(self.last_blocks, self.last_blocks > self.first_blocks),
        )
        return reduce(jnp.stack([found, *ends]), axis=0)


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
