"""Sobol points, randomised so that each is uniform: `scipy.stats.qmc.Sobol` as a JAX function.

Point i of dimension j has the binary digits ⊕_b i_b V_jb, where i_b are the digits of i and V_jb
the direction numbers (Sobol 1967). The first 2^m points have one in each cell of many grids of
2^m equal cells (a net), and so have the points from any multiple of 2^m on.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, Key, UInt32

from mpfjax.operations.generator import bits

# Joe and Kuo (2008), "Constructing Sobol sequences with better two-dimensional projections", the
# set new-joe-kuo-6. For each dimension after the first: a, the inner coefficients of a primitive
# polynomial of degree s as binary digits, and m_1 to m_s.
_JOE_KUO = """
    0 1; 1 1 3; 1 1 3 1; 2 1 1 1; 1 1 1 3 3; 4 1 3 5 13; 2 1 1 5 5 17; 4 1 1 5 5 5;
    7 1 1 7 11 19; 11 1 1 5 1 1; 13 1 1 1 3 11; 14 1 3 5 5 31; 1 1 3 3 9 7 49; 13 1 1 1 15 21 21;
    16 1 3 1 13 27 49; 19 1 1 1 15 7 5; 22 1 3 1 15 13 25; 25 1 1 5 5 19 61;
    1 1 3 7 11 23 15 103; 4 1 3 7 13 13 15 69; 7 1 1 3 13 7 35 63; 8 1 3 5 9 1 25 53;
    14 1 3 1 13 9 35 107; 19 1 3 1 5 27 61 31; 21 1 1 5 11 19 41 61; 28 1 3 5 3 3 13 69;
    31 1 1 7 13 1 19 1; 32 1 3 7 5 13 19 59; 37 1 1 3 9 25 29 41; 41 1 3 5 13 23 1 55;
    42 1 3 7 3 13 59 17; 50 1 3 1 3 5 53 69; 55 1 1 5 5 23 33 13; 56 1 1 7 7 1 61 123;
    59 1 1 7 9 13 61 49; 62 1 3 3 5 3 55 33; 14 1 3 1 15 31 13 49 245; 21 1 3 5 15 31 59 63 97;
    22 1 3 1 11 11 11 77 249; 38 1 3 1 11 27 43 71 9; 47 1 1 7 15 21 11 81 45;
    49 1 3 7 3 25 31 65 79; 50 1 3 1 1 19 11 3 205; 52 1 1 5 9 19 21 29 157;
    56 1 3 7 11 1 33 89 185; 67 1 3 3 3 15 9 79 71; 70 1 3 7 11 15 39 119 27;
    84 1 1 3 1 11 31 97 225; 97 1 1 1 3 23 43 57 177; 103 1 3 7 7 17 17 37 71;
    115 1 3 1 5 27 63 123 213; 122 1 1 3 5 11 43 53 133; 8 1 3 5 5 29 17 47 173 479;
    13 1 3 3 11 3 1 109 9 69; 16 1 1 1 5 17 39 23 5 343; 22 1 3 1 5 25 15 31 103 499;
    25 1 1 1 11 11 17 63 105 183; 44 1 1 5 11 9 29 97 231 363; 47 1 1 5 15 19 45 41 7 383;
    52 1 3 7 7 31 19 83 137 221; 55 1 1 1 3 23 15 111 223 83; 59 1 1 5 13 31 15 55 25 161;
    62 1 1 3 13 25 47 39 87 257
"""
_ROWS = tuple(tuple(map(int, row.split())) for row in _JOE_KUO.replace("\n", " ").split(";"))
MOST_DIMENSIONS = 1 + len(_ROWS)
_DIGITS = 32


@functools.cache
def direction_numbers(dimension: int, num_digits: int = _DIGITS) -> np.ndarray:
    """V_jb for the digits b of an index, lowest first, (dimension, num_digits), in 32 bits.

    The highest bit is the first binary digit of a coordinate. Raises `ValueError` for more
    dimensions than the table holds.
    """
    if not 1 <= dimension <= MOST_DIMENSIONS:
        raise ValueError(
            f"noise_dimension: {dimension} is not in 1, ..., {MOST_DIMENSIONS}, the dimensions"
            " that the table of direction numbers holds"
        )
    first = [1] * num_digits
    numbers = [first, *(_recurrence(row, num_digits) for row in _ROWS[: dimension - 1])]
    shifts = np.arange(_DIGITS - 1, _DIGITS - 1 - num_digits, -1, dtype=np.uint32)
    return np.array(numbers, np.uint32) << shifts[None]


def _recurrence(row: tuple[int, ...], num_digits: int) -> list[int]:
    """m_1, ..., m_num_digits of a dimension, from the first of them and its polynomial."""
    inner, *numbers = row
    degree = len(numbers)
    for k in range(degree, num_digits):
        value = numbers[k - degree] ^ (numbers[k - degree] << degree)
        for i in range(1, degree):
            if inner >> (degree - 1 - i) & 1:
                value ^= numbers[k - i] << i
        numbers.append(value)
    return numbers[:num_digits]


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


def shuffled(
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
    own = jnp.uint32(1) << jnp.arange(_DIGITS - 1, -1, -1, dtype=jnp.uint32)
    before = ~(own | (own - 1))
    matrices = (bits(key, (dimension, _DIGITS)) & before[None]) | own[None]
    parities = jax.lax.population_count(matrices[:, None] & directions[:, :, None]) & 1
    return jnp.sum(parities * own[None, None], axis=2, dtype=jnp.uint32)
