"""Prefix sums, the sums of all values before each, and from them the parent of each slot.

In numpy: `np.cumsum(values) - values` and `np.searchsorted(starts, slots, "right") - 1`. On a CPU,
XLA's own cumulative sum makes several passes over the values. Here blocks of them are multiplied
by a triangle of ones, in one pass. Resampling then needs no search and is O(N).

Of more than a hundred thousand particles, weights are added as whole numbers of small units. One
float32 has 24 bits: of a million slots that leaves four for the fraction, so that neighbours are
drawn too often or too seldom.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Shaped

from mpfjax.operations.stored import (
    EXACT_IN_FLOAT32,
    block_size,
    count_places,
    on_platform,
    stored,
    whole,
    whole_blocks,
)

_ONE_BLOCK = 128
# A sum in float32 of more numbers than these has too few bits for the fraction. The limit is a
# number of particles, which is static: filters below it have the draws that they always had.
MOST_IN_ONE_FLOAT = 100_000
_GOLDEN = 0x9E3779B9  # the golden ratio's fraction, of 2^32


def sum_before(values: Float[Array, " n"]) -> tuple[Float[Array, " n"], Float[Array, ""]]:
    """The exclusive prefix sums c_i = v_0 + ... + v_{i-1}, shape (n,), and the sum of all.

    For values >= 0 the prefix sums never fall. Where v_i is zero, c_{i+1} is c_i to the bit, and
    after the last value above zero they are the sum of all. So rounding never gives a value of
    zero a share of the line. On a CPU, blocks are multiplied by a triangle of ones, which is
    several times faster than XLA's own cumulative sum. Other platforms use XLA's.
    """
    return on_platform(values, cpu=_blocked_sum_before, default=_sum_before_by_scan)


def _sum_before_by_scan(values: Float[Array, " n"]) -> tuple[Float[Array, " n"], Float[Array, ""]]:
    upto = jnp.cumsum(values)
    total = upto[-1]
    # Each zero takes the sum of the next value that is not zero.
    before = jnp.minimum(jnp.pad(upto[:-1], (1, 0)), total)
    starts = jnp.where(values == 0, total, before)
    return jax.lax.cummin(starts, reverse=True), total


def _blocked_sum_before(values: Float[Array, " n"]) -> tuple[Float[Array, " n"], Float[Array, ""]]:
    n = values.shape[0]
    if n <= _ONE_BLOCK:
        ones_before = jnp.triu(jnp.ones((n, whole_blocks(n + 1)), values.dtype), 1)
        sums = (values[None] @ ones_before)[0]
        return sums[:n], sums[n]
    blocks = whole(values, 0.0).reshape(-1, block_size(n))
    size = blocks.shape[1]
    # Columns are summed in the same order, so the sum does not change where the value is zero.
    within = blocks @ jnp.triu(jnp.ones((size, size), values.dtype), 1)
    totals = within[:, -1] + blocks[:, -1]
    # A zero in the last block has the sum of all values before it.
    before, _ = _blocked_sum_before(jnp.pad(totals, (0, 1)))
    if before.shape[0] > _ONE_BLOCK:
        before = stored(before)
    upto = before[1:, None]
    # The order of summing changes between blocks: zeros at a block's end belong to the next.
    sums = jnp.where(within == totals[:, None], upto, jnp.minimum(before[:-1, None] + within, upto))
    return sums.reshape(-1)[:n], before[-1]


def count_upto(values: Shaped[Array, " n"], bound: int) -> Int[Array, " n"]:
    """The exact inclusive prefix sums of whole numbers of any type, or of booleans.

    Their sum must not exceed `bound`.
    """
    scanned = partial(jnp.cumsum, dtype=jnp.int32)
    if bound >= EXACT_IN_FLOAT32:
        return scanned(values)
    return on_platform(values, cpu=_blocked_count_upto, default=scanned)


def _blocked_count_upto(values: Shaped[Array, " n"]) -> Int[Array, " n"]:
    n = values.shape[0]
    blocks = whole(values.astype(jnp.float32), 0.0).reshape(-1, block_size(n))
    before, _ = _blocked_sum_before(jnp.sum(blocks, axis=1))
    size = blocks.shape[1]
    # Whole numbers add up exactly in any order: a block's first entry takes the sum before it.
    is_first = jnp.arange(size) == 0
    blocks = blocks + jnp.where(is_first[None], before[:, None], 0.0)
    upto = blocks @ jnp.triu(jnp.ones((size, size), blocks.dtype))
    return upto.astype(jnp.int32).reshape(-1)[:n]


def count_starts(starts: Int[Array, " n"], num_slots: int) -> Int[Array, " num_slots"]:
    """For each slot s, the last i with starts_i <= s, given starts in ascending order.

    If starts_i is the first slot of parent i, this is the parent of every slot, in O(n) and without
    a search: a one is added at each start, and the prefix sum counts them. A parent without
    offspring has the same start as the next one and gets no slot. Starts at or past `num_slots`
    are dropped. A slot before the first start gets -1.
    """
    # Dropped starts share one extra place.
    num_places = whole_blocks(num_slots + 1)
    dtype = jnp.float32 if starts.size < EXACT_IN_FLOAT32 else jnp.int32
    starts = stored(jnp.minimum(starts, num_slots))
    at_start = count_places(starts, num_places, dtype)
    return count_upto(at_start, starts.size)[:num_slots] - 1


class Positions(NamedTuple):
    """Places on the line of slots, whole + fraction, the fraction in [0, 1)."""

    whole: Int[Array, "*shape"]
    fraction: Float[Array, "*shape"]

    def in_units(self, num_bits: int) -> Int[Array, "*shape"]:
        """In units of 2^-num_bits slots, rounded down."""
        return (self.whole << num_bits) + (self.fraction * 2.0**num_bits).astype(jnp.int32)


def needs_units(num_values: int, dtype: jnp.dtype) -> bool:
    """Whether sums of this many values of this type have no bits left for the fraction."""
    return num_values > MOST_IN_ONE_FLOAT and jnp.finfo(dtype).nmant < 32


def unit_bits(num_slots: int) -> int:
    """b, with units of 2^-b slots: the most with which so many slots are not above 2^30 units."""
    return 30 - (num_slots - 1).bit_length()


def to_units(values: Float[Array, " n"], num_bits: int) -> Int[Array, " n"]:
    """Values >= 0 in whole units, zero as zero.

    They are rounded up and down by the golden ratio's multiples, so that the rounding errors of
    neighbours cancel, whatever the order of the values.
    """
    index = jnp.arange(values.shape[0], dtype=jnp.uint32) * jnp.uint32(_GOLDEN)
    thresholds = (index >> 8).astype(values.dtype) * 2.0**-24
    return jnp.floor(values * 2.0**num_bits + thresholds).astype(jnp.int32)
