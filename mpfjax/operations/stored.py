"""Values that are computed once and kept.

In numpy all of this is `values.copy()` and `values.astype(int)`. XLA fuses what is computed into
whatever uses it, and then computes it again for every use; a product with the identity is a border
that it does not fuse across.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Shaped

_BLOCKS = (32, 16, 8)
EXACT_IN_FLOAT32 = 2**23  # as exact as up to 2^24, and readable from the lowest bits


def whole_blocks(n: int) -> int:
    """The length, n or more, at which a prefix sum's blocks need no filling up."""
    size = block_size(n)
    return -(-n // size) * size


def block_size(n: int) -> int:
    # Nothing that is fused with filling up runs on vectors, nor with dividing by an odd size.
    whole = (size for size in _BLOCKS if n % size == 0 and n > _BLOCKS[0])
    return next(whole, _BLOCKS[0])


def stored(values: Shaped[Array, "*rest n"], bound: int | None = None) -> Shaped[Array, "*rest n"]:
    """The same finite numbers, computed once and kept, where XLA for a CPU would not keep them.

    It would compute them again within whatever uses them, once for every particle even where they
    are one a component, and without vectors within a scatter or gather over flattened rows. A
    product with the identity is what it computes on its own. `bound` is above all whole numbers
    there may be; where it is above 2^23, more than is certain to come out exactly, nothing is done.
    """
    if bound is not None and bound > EXACT_IN_FLOAT32:
        return values
    return jax.lax.platform_dependent(values, cpu=_times_identity, default=lambda values: values)


def _times_identity(values: Array) -> Array:
    # The blocks are those of the prefix sums, so that nothing is divided within the loop.
    is_float = jnp.issubdtype(values.dtype, jnp.floating)
    *rest, n = values.shape
    size = block_size(n)
    lines = values if is_float else values.astype(jnp.float32)
    lines = jnp.pad(lines, [(0, 0)] * len(rest) + [(0, whole_blocks(n) - n)])
    blocks = lines.reshape(*rest, -1, size)
    product = (blocks @ jnp.eye(size, dtype=lines.dtype)).reshape(lines.shape)
    return (product if is_float else to_int(product))[..., :n].astype(values.dtype)


def to_int(
    values: Float[Array, "*shape"], bound: int = EXACT_IN_FLOAT32 - 1
) -> Int[Array, "*shape"]:
    """Whole numbers from 0 to `bound` as integers.

    Added to 2^23 they stand in the lowest bits, as long as they are smaller. XLA's own conversion
    costs a CPU several times as much, since it looks for NaN and for what is out of range.
    """
    if values.dtype != jnp.float32 or bound >= EXACT_IN_FLOAT32:
        return values.astype(jnp.int32)
    shift = np.float32(2**23)
    return jax.lax.bitcast_convert_type(values + shift, jnp.int32) - shift.view(np.int32)
