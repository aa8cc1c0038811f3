"""Positions along a Hilbert curve, which visits every cell of a grid, each next to the last.

Points that are near each other on the curve are near each other in space. To sort points of several
dimensions along the curve corresponds to sorting numbers by value.
"""

import jax.numpy as jnp
from jaxtyping import Array, UInt32

MOST_DIMENSIONS = 8
_BITS = 32


def bits_per_dimension(dimension: int) -> int:
    """How many bits of each coordinate fit into an index of 32 bits.

    Raises `ValueError` for more than 8 dimensions: too few bits are left to tell points apart.
    """
    if not 1 <= dimension <= MOST_DIMENSIONS:
        raise ValueError(
            f"sort_by: {dimension} coordinates are not 1, ..., {MOST_DIMENSIONS}, the dimensions"
            " that a Hilbert curve has here; give a function that returns fewer numbers, or one,"
            ' also where "hilbert" or noise="rqmc" sorts by the whole state'
        )
    return _BITS // dimension


def hilbert_index(cells: UInt32[Array, "d n"], num_bits: int) -> UInt32[Array, " n"]:
    """The place of each cell along the Hilbert curve through a grid of 2^(d num_bits) cells.

    Row k of `cells` is the k-th coordinate, in [0, 2^num_bits). Skilling (2004), "Programming the
    Hilbert curve": bit by bit from the highest, the coordinates are reflected and exchanged as
    the curve turns. That leaves the Gray code of the index.
    """
    d = cells.shape[0]
    if d == 1:
        return cells[0]
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
