"""JAX's own random numbers, drawn faster on a CPU: the same bits from an unrolled Threefry."""

import math
from functools import partial

import jax
import jax.numpy as jnp
from jax.extend.random import define_prng_impl, threefry_prng_impl
from jaxtyping import Array, Key, UInt32

_ROTATIONS = ((13, 15, 26, 6), (17, 29, 16, 24))
_PARITY = 0x1BD11BDA
_SHORT_ROW = 8
_FEW = 256


def fast_key(key: Key[Array, "*shape"]) -> Key[Array, "*shape"]:
    """The same key, from which `jax.random` draws the same numbers in less time on a CPU.

    XLA compiles JAX's Threefry for a CPU as a loop over its rounds, which it cannot fuse with
    what uses the bits. Here the 20 rounds of Threefry-2x32 (Salmon et al. 2011, "Parallel random
    numbers: as easy as 1, 2, 3") are written out, so that one pass turns counters into, say,
    normal draws. A filter wraps the keys that it hands to its moves, and so to the model's own
    calls of `jax.random`. A key of another generator is returned as it is, and so is every key
    where JAX is set not to number its draws (`jax_threefry_partitionable`).
    """
    is_numbered = jax.config.jax_threefry_partitionable  # pyright: ignore[reportAttributeAccessIssue]
    if not is_numbered or jax.random.key_impl(key) != "threefry2x32":
        return key
    return jax.random.wrap_key_data(jax.random.key_data(key), impl=_UNROLLED)


def _random_bits(key: UInt32[Array, " 2"], bit_width: int, shape: tuple[int, ...]) -> Array:
    stock = partial(threefry_prng_impl.random_bits, bit_width=bit_width, shape=shape)
    size = math.prod(shape)
    # Fused with draws in short rows, the rounds would not run on vectors.
    in_short_rows = len(shape) > 1 and shape[-1] < _SHORT_ROW and size > _FEW
    if bit_width != 32 or in_short_rows or not 0 < size < 2**32:
        return stock(key)
    return jax.lax.platform_dependent(key, cpu=partial(_words, shape=shape), default=stock)


def _split(key: UInt32[Array, " 2"], shape: tuple[int, ...]) -> UInt32[Array, "*shape 2"]:
    stock = partial(threefry_prng_impl.split, shape=shape)
    if not 0 < math.prod(shape) < 2**32:
        return stock(key)
    return jax.lax.platform_dependent(key, cpu=partial(_keys, shape=shape), default=stock)


@partial(jax.jit, static_argnames="shape")
def _words(key: UInt32[Array, " 2"], shape: tuple[int, ...]) -> UInt32[Array, "..."]:
    """The word of each position: both halves of its hash, xored."""
    high, low = _hashes(key, shape)
    return high ^ low


@partial(jax.jit, static_argnames="shape")
def _keys(key: UInt32[Array, " 2"], shape: tuple[int, ...]) -> UInt32[Array, "..."]:
    """The key of each position: both halves of its hash, side by side."""
    return jnp.stack(_hashes(key, shape), axis=-1)


def _hashes(
    key: UInt32[Array, " 2"], shape: tuple[int, ...]
) -> tuple[UInt32[Array, "..."], UInt32[Array, "..."]]:
    index = jax.lax.iota(jnp.uint32, math.prod(shape)).reshape(shape)
    return threefry(key, jnp.zeros_like(index), index)


def threefry(
    key: UInt32[Array, " 2"], high: UInt32[Array, " *shape"], low: UInt32[Array, " *shape"]
) -> tuple[UInt32[Array, " *shape"], UInt32[Array, " *shape"]]:
    """Threefry-2x32 with 20 rounds: the counter (high, low) encrypted under `key`."""
    keys = (key[0], key[1], key[0] ^ key[1] ^ jnp.uint32(_PARITY))
    high, low = high + keys[0], low + keys[1]
    for group in range(5):
        for rotation in _ROTATIONS[group % 2]:
            high = high + low
            low = high ^ _rotate_left(low, rotation)
        high = high + keys[(group + 1) % 3]
        low = low + keys[(group + 2) % 3] + jnp.uint32(group + 1)
    return high, low


def _rotate_left(word: UInt32[Array, " *shape"], by: int) -> UInt32[Array, " *shape"]:
    return (word << by) | (word >> (32 - by))


_UNROLLED = define_prng_impl(
    key_shape=(2,),
    seed=threefry_prng_impl.seed,
    split=_split,
    random_bits=_random_bits,
    fold_in=threefry_prng_impl.fold_in,
    name="unrolled_threefry2x32",
    tag="utf",
)
