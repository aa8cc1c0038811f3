"""Sums, maxima and places of segments that stand side by side, with labels in ascending order.

In numpy: `np.add.reduceat(values, firsts)`. Values are taken in blocks, whose sums run on vectors.
A block of one label goes to its segment as a whole. Of the others, which hold a border, each
segment takes its own entries: they can only be in the first and the last block that it stands in.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Shaped

from mpfjax.operations.indexing import take
from mpfjax.operations.segments import REDUCTIONS, segment_reduce
from mpfjax.operations.stored import block_size, stored, whole_blocks

_COMBINED = {"add": jnp.add, "max": jnp.maximum, "min": jnp.minimum}


class Runs(NamedTuple):
    """The places of segments, in blocks; the segments together fill whole blocks."""

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
        """The first and the last masked place of each segment; any place where there is none."""
        places = jnp.arange(mask.shape[0], dtype=jnp.int32)
        last = mask.shape[0] - 1
        # The last place is the least of the negative ones: one minimum finds both.
        signed = jnp.where(mask[None], jnp.stack([places, -places]), last)
        firsts, lasts = jax.vmap(lambda row: self._reduced("min", row, last))(signed)
        return firsts, jnp.maximum(-lasts, 0)

    def _reduced(
        self, how: str, values: Shaped[Array, " p"], nothing: float
    ) -> Shaped[Array, " m"]:
        m, blocks = self.first_blocks.shape[0], values.reshape(self.labels.shape)
        is_whole = self.labels[:, 0] == self.labels[:, -1]
        reduce = REDUCTIONS[how]
        found = segment_reduce(
            how, reduce(blocks, axis=1), jnp.where(is_whole, self.labels[:, 0], m), m, nothing
        )

        # Of the first and the last block of each segment, unless it is whole, its own entries.
        ends = jnp.concatenate([self.first_blocks, self.last_blocks])
        labels = take(self.labels, ends)
        is_last = np.arange(2 * m) >= m
        counts = (labels[:, 0] != labels[:, -1]) & (
            ~is_last | jnp.tile(self.last_blocks > self.first_blocks, 2)
        )
        is_own = labels == np.tile(np.arange(m, dtype=labels.dtype), 2)[:, None]
        own = jnp.where(is_own & counts[:, None], take(blocks, ends), nothing)
        of_ends = reduce(own.astype(values.dtype), axis=1)
        return functools.reduce(_COMBINED[how], (found, of_ends[:m], of_ends[m:]))


def runs_of(labels: Int[Array, " p"], num_segments: int) -> Runs:
    """The runs of labels in ascending order, whole blocks of them."""
    blocks = labels.reshape(-1, block_size(labels.shape[0]))
    label = jnp.arange(num_segments, dtype=labels.dtype)[None]
    last = blocks.shape[0] - 1
    before = jnp.sum((blocks[:, -1:] < label).astype(jnp.int32), axis=0)
    after = jnp.sum((blocks[:, :1] > label).astype(jnp.int32), axis=0)
    ends = jnp.stack([jnp.minimum(before, last), jnp.maximum(last - after, 0)])
    return Runs(blocks, *stored(ends))


def whole(values: Array, fill: float) -> Array:
    """The values, filled up to whole blocks."""
    n = values.shape[0]
    return jnp.pad(values, (0, whole_blocks(n) - n), constant_values=fill)
