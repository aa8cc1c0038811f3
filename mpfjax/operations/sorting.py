"""The order of particles by a number of 32 bits, component by component.

In numpy: `np.lexsort((keys, segments))`. On a CPU, XLA sorts one array several times faster than
pairs. So digits of the key and the index are packed into one integer, and sorted digit by digit.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, Shaped, UInt32

from mpfjax.operations.indexing import take
from mpfjax.operations.stored import stored

_BITS = 32


def order_by_key(
    keys: UInt32[Array, " n"], segments: Int[Array, " n"], num_segments: int
) -> Int[Array, " n"]:
    """The indices in order of the segments, and of the keys within one; ties stay as they are.

    Segments are in [0, num_segments).
    """
    n = keys.shape[0]
    index_bits = max((n - 1).bit_length(), 1)
    digit = _BITS - index_bits
    segments = segments.astype(jnp.uint32)
    index = jnp.arange(n, dtype=jnp.uint32)
    order = index.astype(jnp.int32)
    for low in range(0, _BITS + (num_segments - 1).bit_length(), digit):
        # The bits from `low` on of the segment and the key, side by side.
        word = keys >> low if low < _BITS else segments >> (low - _BITS)
        if 0 < low < _BITS:
            word = word | (segments << (_BITS - low))
        if low > 0:
            # Otherwise the gather would compute the keys again, not vectorised.
            word = take(stored(word & ((1 << digit) - 1)), order)
        ranked = jax.lax.sort((word << index_bits) | index) & ((1 << index_bits) - 1)
        ranked = ranked.astype(jnp.int32)
        order = ranked if low == 0 else take(order, ranked)
    return order


def sortable_bits(values: Shaped[Array, " n"]) -> UInt32[Array, " n"]:
    """Whole numbers of 32 bits in the same order as the values; NaN is the largest.

    Floating point values are taken in float32.
    """
    if not jnp.issubdtype(values.dtype, jnp.floating):
        values = values.astype(jnp.int32)
        return jax.lax.bitcast_convert_type(values, jnp.uint32) ^ jnp.uint32(1 << 31)
    values = values.astype(jnp.float32)
    values = jnp.where(values == 0, 0.0, values)  # -0 is 0
    values = jnp.where(jnp.isnan(values), jnp.nan, values)
    bits = jax.lax.bitcast_convert_type(values, jnp.uint32)
    return jnp.where(bits >> 31 == 1, ~bits, bits | jnp.uint32(1 << 31))
