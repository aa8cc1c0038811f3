"""Random numbers: JAX's own, drawn faster on a CPU, and Sobol points.

An unrolled Threefry and normals from it give the numbers of `jax.random`. Sobol points are
`scipy.stats.qmc.Sobol` as a JAX function: point i of dimension j has the digits ⊕_b i_b V_jb, where
i_b are the digits of i and V_jb the direction numbers (Sobol 1967). The first 2^m points have one
in each cell of many grids of 2^m equal cells (a net), and so have those from any multiple of 2^m.
"""

import functools
import math
from collections.abc import Iterable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.random import define_prng_impl, threefry_prng_impl
from jax.typing import DTypeLike
from jaxtyping import Array, Float, Int, Key, UInt32

from mpfjax.operations.logarithms import default_float
from mpfjax.operations.stored import apart, on_platform, stored

Words = UInt32[Array, " *shape"]
_ROTATIONS = ((13, 15, 26, 6), (17, 29, 16, 24))
_PARITY = 0x1BD11BDA
_SHORT_ROW = 8
_FEW_KEYS = 4
_FEW = 256
# Giles (2010), "Approximating the erfinv function", table 5, highest power first: erf⁻¹(x) / x as
# a polynomial in w - 2.5 where w = -log(1 - x²) is below 5, and in √w - 3 beyond.
_CENTRE = np.array([
    2.81022636e-08, 3.43273939e-07, -3.5233877e-06, -4.39150654e-06, 0.00021858087,
    -0.00125372503, -0.00417768164, 0.246640727, 1.50140941,
], np.float32)  # fmt: skip
_TAIL = np.array([
    -0.000200214257, 0.000100950558, 0.00134934322, -0.00367342844, 0.00573950773,
    -0.0076224613, 0.00943887047, 1.00167406, 2.83297682,
], np.float32)  # fmt: skip
# Moshier's Cephes library, logf: (log(1 + f) - f + f²/2) / f³ for 1 + f in [√½, √2].
_LOGARITHM = np.array([
    7.0376836292e-2, -1.1514610310e-1, 1.1676998740e-1, -1.2420140846e-1, 1.4249322787e-1,
    -1.6668057665e-1, 2.0000714765e-1, -2.4999993993e-1, 3.3333331174e-1,
], np.float32)  # fmt: skip
_ROOT_OF_HALF = 0x3F3504F3
_FRACTION = 0x7FFFFF
_DIGITS = 32


def fast_key(key: Key[Array, "*shape"]) -> Key[Array, "*shape"]:
    """The key in a form from which `jax.random` draws its numbers in less time on a CPU.

    For a CPU, XLA compiles JAX's Threefry as a loop over its rounds. It cannot fuse a loop with
    what uses the bits. Here the 20 rounds of Threefry-2x32 (Salmon et al. 2011, "Parallel random
    numbers: as easy as 1, 2, 3") are written out. So one pass over the counters gives, for
    example, normal draws. The library wraps a key where it draws. Moves and models get ordinary
    keys, since not all of `jax.random` takes a wrapped one (`poisson` does not, and `jnp.where`
    does not take it beside an ordinary key). A key of another generator is returned as it is. So
    is every key if JAX is set not to number its draws (`jax_threefry_partitionable`).
    """
    if not _is_numbered(key):
        return key
    return jax.random.wrap_key_data(jax.random.key_data(key), impl=_UNROLLED)


def _is_numbered(key: Key[Array, "*shape"]) -> bool:
    """Whether a draw is the hash of its number under the key."""
    is_numbered = jax.config.jax_threefry_partitionable  # pyright: ignore[reportAttributeAccessIssue]
    return is_numbered and jax.random.key_impl(key) == "threefry2x32"


def split(key: Key[Array, "*keys"], num: int) -> Key[Array, " num"]:
    """`jax.random.split`, the same keys; keys that are split stay.

    A longer split starts with the same keys. On a CPU the rounds of Threefry are written out, since
    XLA's loop over them is ten kernels, and each takes time to compile. Apart, they are compiled
    once for all splits into up to four.
    """
    if key.ndim or not _is_numbered(key):
        return key if key.ndim else jax.random.split(key, num)
    return jax.random.wrap_key_data(_hashes(jax.random.key_data(key), num), impl="threefry2x32")


def split_each(keys: Key[Array, " k"], num: int) -> Key[Array, "k num"]:
    """Each key split."""
    function = partial(split, num=num)
    # Keys of some generators are split differently under `vmap`.
    return jax.vmap(function)(keys) if _is_numbered(keys) else jax.lax.map(function, keys)


@partial(jax.jit, static_argnums=1)
def _hashes(key: UInt32[Array, " 2"], num: int) -> UInt32[Array, "num 2"]:
    """The hashes of so many numbers from 0 under the key."""

    def of_numbers(key: UInt32[Array, " 2"]) -> UInt32[Array, "n 2"]:
        # Not one array beside the other, for which the rounds would be compiled twice.
        place = jax.lax.iota(jnp.uint32, 2 * max(num, _FEW_KEYS))
        high, low = threefry(key, jnp.zeros_like(place), place >> 1)
        return jnp.where(place & 1 == 0, high, low).reshape(-1, 2)

    return apart(of_numbers, key)[:num]


def uniform(
    key: Key[Array, ""], shape: tuple[int, ...], dtype: DTypeLike | None = None
) -> Float[Array, "..."]:
    """`jax.random.uniform` on [0, 1), the same numbers in less time on a CPU."""
    return jax.random.uniform(fast_key(key), shape, float if dtype is None else dtype)


def bits(key: Key[Array, ""], shape: tuple[int, ...]) -> UInt32[Array, "..."]:
    """`jax.random.bits` of 32 bits, the same in less time on a CPU."""
    return jax.random.bits(fast_key(key), shape, jnp.uint32)


def below(key: Key[Array, ""], spans: Int[Array, "*shape"]) -> Int[Array, "*shape"]:
    """Independent uniform whole numbers in [0, span), one for each span > 0.

    Each is the upper half of the product of its span and a word of 32 random bits, by which any
    interval has its probability up to 2^-32. `jax.random.randint` divides, and favours the lower
    numbers of a large span: by .4% for 2.2 · 10^7.
    """
    word, span, half = bits(key, spans.shape), spans.astype(jnp.uint32), 0xFFFF
    low = (word & half) * (span & half)
    middle = (word >> 16) * (span & half) + (low >> 16)
    other = (word & half) * (span >> 16) + (middle & half)
    high = (word >> 16) * (span >> 16) + (middle >> 16) + (other >> 16)
    return high.astype(jnp.int32)


def normal(
    key: Key[Array, ""], shape: tuple[int, ...], dtype: DTypeLike | None = None
) -> Float[Array, "..."]:
    """Standard normal draws: those of `jax.random.normal`, up to rounding, in less time on a CPU.

    It is √2 erf⁻¹(u) of the same uniform u on (-1, 1). That is for float32 on a CPU; elsewhere it
    is `jax.random.normal` itself. Use it in a model whose likelihood is so cheap that its noise
    takes half of a step.
    """
    dtype = default_float() if dtype is None else jnp.dtype(dtype)
    stock = partial(jax.random.normal, shape=shape, dtype=dtype)
    if dtype != jnp.float32 or math.prod(shape) == 0:
        return stock(key)
    return on_platform(key, cpu=partial(_normal, shape=shape), default=stock)


def _normal(key: Key[Array, ""], shape: tuple[int, ...]) -> Float[Array, "..."]:
    lowest = np.nextafter(np.float32(-1), np.float32(0))
    uniforms = jax.random.uniform(
        fast_key(key), (math.prod(shape),), jnp.float32, minval=lowest, maxval=1.0
    )
    draws = normal_quantile(uniforms)
    # Operations fused with short rows are not vectorised.
    is_short = len(shape) > 1 and shape[-1] < _SHORT_ROW
    return (stored(draws) if is_short else draws).reshape(shape)


def normal_quantile(values: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """√2 erf⁻¹(x) for x in (-1, 1): the quantile of (1 + x) / 2 of the standard normal.

    `jax.lax.erf_inv` has the same polynomials. XLA compiles its logarithm to a call per number, so
    that a filter's run takes up to 40% longer where vectors are wide.
    """
    if values.dtype != jnp.float32:
        return math.sqrt(2) * jax.lax.erf_inv(values)
    exponent = -_log((1 - values) * (1 + values))
    is_central = exponent < 5
    powers = jnp.where(is_central, exponent - 2.5, jnp.sqrt(exponent) - 3.0)
    coefficients = map(partial(jnp.where, is_central), _CENTRE, _TAIL)
    return np.float32(math.sqrt(2)) * _polynomial(coefficients, powers) * values


def _log(values: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """The logarithm of positive float32 numbers, in operations that run on vectors."""
    # Shifted so that the exponent's bits count from √½.
    bits = jax.lax.bitcast_convert_type(values, jnp.int32) - _ROOT_OF_HALF
    exponent = (bits >> 23).astype(jnp.float32)
    mantissa = jax.lax.bitcast_convert_type((bits & _FRACTION) + _ROOT_OF_HALF, jnp.float32)
    f = mantissa - 1
    series = _polynomial(_LOGARITHM, f)
    return exponent * np.float32(math.log(2)) + (f + f * f * (f * series - 0.5))


def _polynomial(coefficients: Iterable[Any], x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """The polynomial; the coefficient of the highest power comes first."""
    return functools.reduce(lambda value, coefficient: value * x + coefficient, coefficients)


def _random_bits(key: UInt32[Array, " 2"], bit_width: int, shape: tuple[int, ...]) -> Array:
    stock = partial(threefry_prng_impl.random_bits, bit_width=bit_width, shape=shape)
    size = math.prod(shape)
    # Fused with draws in short rows, the rounds would not be vectorised.
    in_short_rows = len(shape) > 1 and shape[-1] < _SHORT_ROW and size > _FEW
    if bit_width != 32 or in_short_rows or not 0 < size < 2**32:
        return stock(key)
    return on_platform(key, cpu=partial(_words, shape=shape), default=stock)


@partial(jax.jit, static_argnames="shape")
def _words(key: UInt32[Array, " 2"], shape: tuple[int, ...]) -> UInt32[Array, "..."]:
    """The word of each position: both halves of its hash, xored."""
    if (size := math.prod(shape)) <= _FEW_KEYS:
        hashes = _hashes(key, size)
        return (hashes[:, 0] ^ hashes[:, 1]).reshape(shape)
    index = jax.lax.iota(jnp.uint32, size).reshape(shape)
    high, low = threefry(key, jnp.zeros_like(index), index)
    return high ^ low


def threefry(key: Any, high: Words, low: Words) -> tuple[Words, Words]:
    """Threefry-2x32 with 20 rounds: the counter (high, low) encrypted under `key`."""
    keys = (key[0], key[1], key[0] ^ key[1] ^ jnp.uint32(_PARITY))
    high, low = high + keys[0], low + keys[1]
    for group in range(5):
        high, low = _rounds(high, low, _ROTATIONS[group % 2])
        high = high + keys[(group + 1) % 3]
        low = low + keys[(group + 2) % 3] + jnp.uint32(group + 1)
    return high, low


@partial(jax.jit, static_argnums=2)
def _rounds(high: Words, low: Words, rotations: tuple[int, ...]) -> tuple[Words, Words]:
    for rotation in rotations:
        high = high + low
        low = high ^ ((low << rotation) | (low >> (32 - rotation)))
    return high, low


_UNROLLED = define_prng_impl(
    key_shape=(2,),
    seed=threefry_prng_impl.seed,
    split=threefry_prng_impl.split,
    random_bits=_random_bits,
    fold_in=threefry_prng_impl.fold_in,
    name="unrolled_threefry2x32",
    tag="utf",
)


@functools.cache
def direction_numbers(dimension: int, num_digits: int) -> np.ndarray:
    """V_jb for the digits b of an index, lowest first, (dimension, num_digits), in 32 bits.

    The highest bit is the first binary digit of a coordinate. They are those of Joe and Kuo (2008),
    as scipy has them, up to 21 201 dimensions.
    """
    from scipy.stats import qmc  # takes a second, and few filters need it

    points, numbers = qmc.Sobol(dimension, scramble=False, bits=_DIGITS), []
    for b in range(num_digits):
        # In the Gray code of its number, point 2^(b + 1) - 1 has the digit b alone.
        points.fast_forward(max(2**b - 1, 1))
        numbers.append(points.random(1)[0])
    return (np.transpose(numbers) * 2.0**_DIGITS).astype(np.uint32)


def sobol_points(
    indices: Int[Array, " n"], directions: UInt32[Array, "d digits"]
) -> UInt32[Array, "d n"]:
    """The points of these indices, a row for each dimension, in units of 2^-32.

    `directions` need as many digits as the largest index has.
    """
    indices = indices.astype(jnp.uint32)
    points = jnp.zeros((directions.shape[0], indices.shape[0]), jnp.uint32)
    for b in range(directions.shape[1]):
        # All ones where the digit is one.
        mask = jnp.uint32(0) - ((indices >> b) & 1)
        points = points ^ (mask[None] & directions[:, b][:, None])
    return points


def scramble(
    indices: Int[Array, " n"], seed: UInt32[Array, ""], num_digits: int
) -> UInt32[Array, " n"]:
    """The indices below 2^num_digits under a random permutation of these, another for each seed.

    It maps every block of 2^k from a multiple of 2^k on onto such a block: Owen's nested scramble
    of the index, by the hash of Laine and Karras (2011). So neighbours get points that are spread
    as evenly as before, but which of them gets which is drawn anew: of two point sets whose indices
    were shuffled, none is a function of the other.
    """
    digits = _reversed_bits(indices.astype(jnp.uint32)) + seed
    # The factors are even, so that each digit changes by those above it alone.
    for factor in (0x6C50B47C, 0xB82F1E52, 0xC7AFE638, 0x8D22F6E6):
        digits = digits ^ (digits * jnp.uint32(factor))
    return _reversed_bits(digits) & jnp.uint32((1 << num_digits) - 1)


def _reversed_bits(words: UInt32[Array, " n"]) -> UInt32[Array, " n"]:
    masks = (0xFFFF, 0x00FF00FF, 0x0F0F0F0F, 0x33333333, 0x55555555)
    for shift, mask in zip((16, 8, 4, 2, 1), map(jnp.uint32, masks), strict=True):
        words = ((words >> shift) & mask) | ((words & mask) << shift)
    return words


def scrambled_directions(
    key: Key[Array, ""], dimension: int, num_digits: int
) -> UInt32[Array, "d digits"]:
    """Direction numbers times a random lower triangular matrix of digits for each dimension.

    The linear matrix scramble of Matoušek (1998): digit k of a coordinate becomes itself plus a
    random sum of the digits before it. A net stays a net. With a random shift of all digits, each
    point is uniform, and any two have the joint law that they have in Owen's nested scramble.
    """
    directions = jnp.asarray(direction_numbers(dimension, num_digits))
    digit = jnp.uint32(1) << jnp.arange(_DIGITS - 1, -1, -1, dtype=jnp.uint32)
    before = ~(digit | (digit - 1))
    matrices = (bits(key, (dimension, _DIGITS)) & before[None]) | digit[None]
    parities = jax.lax.population_count(matrices[:, None] & directions[:, :, None]) & 1
    return jnp.sum(parities * digit[None, None], axis=2, dtype=jnp.uint32)
