"""Orders of particles: by component, by a number in it, and along a Hilbert curve.

In numpy: `np.argsort(labels, kind="stable")` and `np.lexsort((keys, segments))`. On a CPU, XLA
sorts one array several times faster than pairs, and counting is faster still. The Hilbert curve
visits every cell of a grid, each next to the last: to sort points of several dimensions along it
corresponds to sorting numbers by value.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, UInt32

from mpfjax.operations.prefix_sums import count_upto
from mpfjax.operations.stored import EXACT_IN_FLOAT32, count_places, stored, take, whole_blocks

_COUNTED_BLOCK = 32
_MOST_COUNTED_SEGMENTS = 8 * _COUNTED_BLOCK  # eight counts for each particle
BITS = 32
MOST_DIMENSIONS = 8


def order_by_segment(segments: Int[Array, " n"], num_segments: int) -> Int[Array, " n"]:
    """The indices that make segments contiguous and ascending.

    Within a segment the original order stays; a label equal to `num_segments` comes last. For up to
    a few hundred segments the place of each entry is counted, in O(n), instead of sorted.
    """
    n = segments.shape[0]
    index = jnp.arange(n, dtype=jnp.int32)
    if num_segments <= _MOST_COUNTED_SEGMENTS and n < EXACT_IN_FLOAT32:
        return jnp.zeros_like(index).at[_places_by_segment(segments, num_segments)].set(index)
    return jnp.argsort(segments, stable=True).astype(jnp.int32)


def _places_by_segment(segments: Int[Array, " n"], num_segments: int) -> Int[Array, " n"]:
    """Each entry's place in the order, which is how many come before it.

    A table has a row for each segment and a column for each block of entries; a cell counts the
    block's entries of that segment. The prefix sum over the whole table, row after row, is the
    first place of each cell. The rank of an entry in its cell is the number of entries before it
    in the block that are of its segment.
    """
    n = segments.shape[0]
    # Odd: rows whose distance is a power of two would share few places of a cache.
    num_blocks = -(-n // _COUNTED_BLOCK) | 1
    cells = segments * num_blocks + jnp.arange(n, dtype=jnp.int32) // _COUNTED_BLOCK
    num_cells = whole_blocks((num_segments + 1) * num_blocks + 1)
    # One place further, so that the sum up to a cell is the sum of all cells before it.
    before = count_upto(count_places(cells + 1, num_cells, jnp.float32), n)
    # The start of the first block is filled up with a label of no cell.
    line = jnp.pad(cells, (_COUNTED_BLOCK, 0), constant_values=-1)
    ranks = jnp.zeros(n, jnp.int32)
    for back in range(1, _COUNTED_BLOCK):
        earlier = jax.lax.slice_in_dim(line, _COUNTED_BLOCK - back, _COUNTED_BLOCK - back + n)
        ranks = ranks + (earlier == cells).astype(jnp.int32)
    return take(before, cells) + ranks


def order_by_key(
    keys: UInt32[Array, " n"], segments: Int[Array, " n"], num_segments: int
) -> Int[Array, " n"]:
    """The indices in order of the segments, and of the keys within one; ties stay as they are.

    Segments are in [0, num_segments).
    """
    n = keys.shape[0]
    index_bits = max((n - 1).bit_length(), 1)
    digit = BITS - index_bits
    segments = segments.astype(jnp.uint32)
    index = jnp.arange(n, dtype=jnp.uint32)
    order = index.astype(jnp.int32)
    for low in range(0, BITS + (num_segments - 1).bit_length(), digit):
        # The bits from `low` on of the segment and the key, side by side.
        word = keys >> low if low < BITS else segments >> (low - BITS)
        if 0 < low < BITS:
            word = word | (segments << (BITS - low))
        if low > 0:
            # Otherwise the gather would compute the keys again, not vectorised.
            word = take(stored(word & ((1 << digit) - 1)), order)
        ranked = jax.lax.sort((word << index_bits) | index) & ((1 << index_bits) - 1)
        ranked = ranked.astype(jnp.int32)
        order = ranked if low == 0 else take(order, ranked)
    return order


def sortable_bits(values: Float[Array, " n"]) -> UInt32[Array, " n"]:
    """Whole numbers of 32 bits in the same order as the values in float32; NaN is the largest."""
    values = values.astype(jnp.float32)
    values = jnp.where(values == 0, 0.0, values)  # -0 is 0
    values = jnp.where(jnp.isnan(values), jnp.nan, values)
    bits = jax.lax.bitcast_convert_type(values, jnp.uint32)
    return jnp.where(bits >> 31 == 1, ~bits, bits | jnp.uint32(1 << 31))


def hilbert_index(cells: UInt32[Array, "d n"], num_bits: int) -> UInt32[Array, " n"]:
    """The place of each cell along the Hilbert curve through a grid of 2^(d num_bits) cells.

    Row k of `cells` is the k-th coordinate, in [0, 2^num_bits). Skilling (2004), "Programming the
    Hilbert curve": bit by bit from the highest, the coordinates are reflected and exchanged as
    the curve turns. That leaves the Gray code of the index.
    """
    d = cells.shape[0]
    x = [cells[k] for k in range(d)]
    for bit in range(num_bits - 1, 0, -1):
        below = jnp.uint32((1 << bit) - 1)
        for k in range(d):
            # All ones where the bit is one.
            is_set = jnp.uint32(0) - ((x[k] >> bit) & 1)
            swapped = (x[0] ^ x[k]) & below & ~is_set
            x[0] = x[0] ^ (below & is_set) ^ swapped
            if k > 0:
                x[k] = x[k] ^ swapped
    for k in range(1, d):
        x[k] = x[k] ^ x[k - 1]
    # The prefix sums, modulo 2, of the last coordinate's bits.
    flips = x[-1] >> 1
    for shift in (1, 2, 4, 8, 16):
        if shift < num_bits:
            flips = flips ^ (flips >> shift)
    index = jnp.zeros_like(x[0])
    for bit in range(num_bits - 1, -1, -1):
        for k in range(d):
            index = (index << 1) | (((x[k] ^ flips) >> bit) & 1)
    return index
