"""Values that are computed once and kept.

In numpy all of this is `values.copy()` and `values.astype(int)`. XLA fuses a computation into
everything that uses its result, and then repeats it for every use. It does not fuse across the
call of a function that it must not inline, and a call that does nothing takes no time.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.xla_metadata import set_xla_metadata
from jaxtyping import Array, Float, Int, Shaped

from mpfjax.operations.platforms import on_platform

VECTOR = 32
# Powers of two fill the vectors; sizes far from 32 make more rows or longer products.
_BLOCKS = (VECTOR, 16, 40, 48, 24, 56, 28, 36, 20, 44, 52)
EXACT_IN_FLOAT32 = 2**23  # as exact as up to 2^24, and readable from the lowest bits


def whole_blocks(n: int) -> int:
    """The length, n or more, that the blocks of a prefix sum divide."""
    size = block_size(n)
    return -(-n // size) * size


def block_size(n: int) -> int:
    # Operations fused with a padding, or a division by an odd size, are not vectorised.
    whole = (size for size in _BLOCKS if n % size == 0 and n > VECTOR)
    return next(whole, VECTOR)


@jax.custom_jvp
def stored(values: Shaped[Array, "*rest n"]) -> Shaped[Array, "*rest n"]:
    """The same numbers, computed once and kept, where XLA on a CPU would not keep them.

    XLA would compute them again wherever they are used: once for every particle, even if there is
    one for each component, and without vectors in a scatter or gather over flattened rows.
    """
    return on_platform(values, cpu=_through_a_call, default=lambda values: values)


@stored.defjvp
def _stored_jvp(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    return stored(*primals), tangents[0]


def _through_a_call(values: Array) -> Array:
    # In the blocks of the prefix sums, so that there is no division within the loop.
    *rest, n = values.shape
    size = block_size(n)
    blocks = values.reshape(*rest, -1, size) if n % size == 0 else values
    with set_xla_metadata(inlineable="false"):
        return _same(blocks).reshape(values.shape)


@jax.jit
def _same(values: Array) -> Array:
    return values


def to_int(
    values: Float[Array, "*shape"], bound: int = EXACT_IN_FLOAT32 - 1
) -> Int[Array, "*shape"]:
    """Whole numbers from 0 to `bound` as integers.

    Added to 2^23 as floats, numbers below 2^23 are in the lowest bits. XLA's own conversion takes
    several times as long on a CPU, since it checks for NaN and for numbers out of range.
    """
    if values.dtype != jnp.float32 or bound >= EXACT_IN_FLOAT32:
        return values.astype(jnp.int32)
    shift = np.float32(2**23)
    return jax.lax.bitcast_convert_type(values + shift, jnp.int32) - shift.view(np.int32)
