"""Prefix sums, the sums of all values before each, and from them the parent of each slot.

In numpy: `np.cumsum(values) - values` and `np.searchsorted(starts, slots, "right") - 1`. On a CPU,
XLA's own cumulative sum makes several passes over the values. Here blocks of them are multiplied
by a triangle of ones, in one pass. Resampling then needs no search and is O(N).

Of more than a hundred thousand particles, a place on the line of slots is a whole number and a
fraction of its own beside it. One float32 has 24 bits for both: of a million slots that leaves four
for the fraction, so that neighbours are drawn too often or too seldom. Apart, both are exact.
"""

from collections.abc import Sequence
from functools import partial, reduce
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key, Shaped, UInt32

from mpfjax.operations.random import bits, split, uniform
from mpfjax.operations.stored import (
    EXACT_IN_FLOAT32,
    block_size,
    count_places,
    on_platform,
    stored,
    take,
    to_int,
    whole,
    whole_blocks,
)

_ONE_BLOCK = 128
_LANES_OF_ROWS = 4
_FEWEST, _FEW = 16, 64
# A sum in float32 of more numbers than these has too few bits for the fraction. The limit is a
# number of particles, which is static: filters below it have the draws that they always had.
MOST_IN_ONE_FLOAT = 100_000
_HALF = 2.0**12  # fractions are whole multiples of 2^-24, in two halves of 12 bits


def sum_before(values: Float[Array, " n"]) -> tuple[Float[Array, " n"], Float[Array, ""]]:
    """The exclusive prefix sums c_i = v_0 + ... + v_{i-1}, shape (n,), and the sum of all.

    For values >= 0 the prefix sums never fall. Where v_i is zero, c_{i+1} is c_i to the bit, and
    after the last value above zero they are the sum of all. So rounding never gives a value of
    zero a share of the line. On a CPU, blocks are multiplied by a triangle of ones, which is
    several times faster than XLA's own cumulative sum. Other platforms use XLA's.
    """
    return on_platform(values, cpu=_blocked_sum_before, default=_scanned_sum_before)


def _scanned_sum_before(values: Float[Array, " n"]) -> tuple[Float[Array, " n"], Float[Array, ""]]:
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
    return to_int(upto).reshape(-1)[:n]


def few_upto(values: Shaped[Array, " n"]) -> Int[Array, " n"]:
    """`jnp.cumsum` of whole numbers or booleans that are few, such as one for each component.

    It compiles as one kernel of masked sums, where XLA's takes up to seven.
    """
    n = values.shape[0]
    if n > _FEW:
        return jnp.cumsum(values, dtype=jnp.int32)
    place = jnp.arange(n, dtype=jnp.int32)
    counts = values.astype(jnp.int32)
    # Over the first axis the sums run on vectors, but XLA repeats them for every use.
    sums = jnp.sum(jnp.where(place[:, None] <= place[None], counts[:, None], 0), 0, jnp.int32)
    return sums if n <= _FEWEST else stored(sums)


def count_starts(starts: Int[Array, "*rows n"], num_slots: int) -> Int[Array, " num_slots"]:
    """For each slot s, the last i with starts_i <= s, given starts in ascending order.

    Rows are one line, the first row first.

    If starts_i is the first slot of parent i, this is the parent of every slot, in O(n) and without
    a search: a one is added at each start, and the prefix sum counts them. A parent without
    offspring has the same start as the next one and gets no slot. Starts at or past `num_slots`
    are dropped. A slot before the first start gets -1.
    """
    # Dropped starts share one extra place.
    num_places = whole_blocks(num_slots + 1)
    dtype = jnp.float32 if starts.size < EXACT_IN_FLOAT32 else jnp.int32
    starts = stored(jnp.minimum(starts, num_slots))
    if starts.ndim == 1 or starts.shape[0] == 1:
        at_start = count_places(starts.reshape(-1), num_places, dtype)
    else:  # a row has long runs without offspring, where the other rows have theirs
        lane = jnp.arange(starts.shape[1], dtype=jnp.int32) % _LANES_OF_ROWS
        places = (starts + num_places * lane[None]).reshape(-1)
        lanes = count_places(places, _LANES_OF_ROWS * num_places, dtype)
        # Written out: on several threads, XLA's sum over these few rows takes ten times as long.
        at_start = reduce(jnp.add, lanes.reshape(_LANES_OF_ROWS, -1))
    return count_upto(at_start, starts.size)[:num_slots] - 1


class Positions(NamedTuple):
    """Places on the line, whole + fraction, the fraction in [0, 1)."""

    whole: Int[Array, "*shape"]
    fraction: Float[Array, "*shape"]

    def at(self, indices: Int[Array, " k"]) -> "Positions":
        """The positions of these indices, which are known to lie in range."""
        return Positions(take(self.whole, indices), take(self.fraction, indices))

    def after(self, start: "Positions") -> "Positions":
        """The distance from a start that is not after them."""
        fraction = self.fraction - start.fraction
        borrows = fraction < 0
        whole = self.whole - start.whole - borrows.astype(jnp.int32)
        return Positions(whole, fraction + borrows.astype(fraction.dtype))

    def moved_by(self, distance: Float[Array, "..."]) -> "Positions":
        """The positions so many slots and parts of one further on."""
        turns = jnp.floor(distance)
        fraction = self.fraction + (distance - turns)
        carried = jnp.floor(fraction)
        return Positions(self.whole + (turns + carried).astype(jnp.int32), fraction - carried)

    def as_float(self) -> Float[Array, "*shape"]:
        """The nearest floating point numbers."""
        return self.whole.astype(self.fraction.dtype) + self.fraction


def needs_two_parts(num_values: int, dtype: jnp.dtype) -> bool:
    """Whether sums of this many values of this type have no bits left for the fraction."""
    return num_values > MOST_IN_ONE_FLOAT and jnp.finfo(dtype).nmant < 32


def exact_sum_before(values: Float[Array, " n"]) -> tuple[Positions, Positions]:
    """The exclusive prefix sums of values >= 0, shape (n,), and the sum of all, shape (1,).

    Each value counts as the nearest multiple of 2^-24. Their sums are exact, so they never fall,
    do not depend on the order of summation, and stay as they are where a value is zero. The sum
    must not exceed twice the number of values.
    """
    whole = jnp.floor(values)
    parts = jnp.round((values - whole) * _HALF**2)
    if values.shape[0] >= EXACT_IN_FLOAT32:
        return _scanned(whole, parts)
    return on_platform(whole, parts, cpu=_blocked, default=_scanned)


def _scanned(whole: Float[Array, " n"], parts: Float[Array, " n"]) -> tuple[Positions, Positions]:
    """In integers of 32 bits: fractions wrap around at one, and each turn is carried."""
    is_one = parts == _HALF**2
    words = jnp.where(is_one, 0.0, parts).astype(jnp.uint32) << 8
    upto = jnp.cumsum(words, dtype=jnp.uint32)
    carried = (upto < words) | is_one
    whole_upto = jnp.cumsum(whole.astype(jnp.int32) + carried.astype(jnp.int32), dtype=jnp.int32)
    fractions = (upto >> 8).astype(whole.dtype) / _HALF**2
    before = Positions(jnp.pad(whole_upto[:-1], (1, 0)), jnp.pad(fractions[:-1], (1, 0)))
    return before, Positions(whole_upto[-1:], fractions[-1:])


def _blocked(whole: Float[Array, " n"], parts: Float[Array, " n"]) -> tuple[Positions, Positions]:
    """In float32: products of blocks with a triangle of ones, of numbers small enough to be exact.

    The fraction is in two halves of 12 bits, of which a block of 32 has sums below 2^18.
    """
    high = jnp.floor(parts / _HALF)
    before, total = _limbs_before((whole, high, parts - high * _HALF))
    bound = 2 * whole.shape[0]
    return _position(before, bound), _position(total, bound)


_Limbs = Sequence[Array]  # whole, high and low


def _limbs_before(limbs: _Limbs) -> tuple[_Limbs, _Limbs]:
    """The exclusive prefix sums of numbers in three parts, and their sum, shape (1,)."""
    n = limbs[0].shape[0]
    size = whole_blocks(n + 1) if n <= _ONE_BLOCK else block_size(n)
    padding = (0, -n % size)
    blocks = [jnp.pad(limb, padding).reshape(-1, size) for limb in limbs]
    triangle = jnp.triu(jnp.ones((size, size), limbs[0].dtype), 1)
    within = [block @ triangle for block in blocks]
    totals = _carried(
        tuple(sums[:, -1] + block[:, -1] for sums, block in zip(within, blocks, strict=True))
    )
    if n <= _ONE_BLOCK:
        return _carried(tuple(sums[0, :n] for sums in within)), totals
    before, total = _limbs_before(totals)
    upto = [start[:, None] + sums for start, sums in zip(before, within, strict=True)]
    return _carried(tuple(sums.reshape(-1)[:n] for sums in upto)), total


def _carried(limbs: _Limbs) -> _Limbs:
    """The same numbers with both halves of the fraction below 2^12."""
    whole, high, low = limbs
    turns = jnp.floor(low / _HALF)
    low, high = low - turns * _HALF, high + turns
    turns = jnp.floor(high / _HALF)
    return whole + turns, high - turns * _HALF, low


def _position(limbs: _Limbs, bound: int) -> Positions:
    whole, high, low = limbs
    return Positions(to_int(whole, bound), (high * _HALF + low) / _HALF**2)


def unit_shift(lengths: Int[Array, " m"], num_values: Int[Array, " m"]) -> Int[Array, " m"]:
    """The s for which each line is `num_values` units of 2^-s slots, or less, unless it is longer.

    Where few slots are filled from many values, a value has too few multiples of 2^-24 slots.
    """
    units = jnp.maximum(num_values // jnp.maximum(lengths, 1), 1)
    return 31 - jax.lax.clz(units)


def scales(
    sums: Float[Array, " m"], lengths: Int[Array, " m"], num_values: int
) -> Float[Array, " m"]:
    """The factors of the values with which each sum is a little less than its length."""
    longest = lengths.astype(sums.dtype)
    # The largest rounding error of the values and their sum.
    margin = longest * 2.0**-20 + num_values * 2.0**-25
    return jnp.maximum(longest - margin, longest / 2) / jnp.where(sums > 0, sums, 1.0)


def growths(totals: Positions, lengths: Int[Array, " m"]) -> Float[Array, " m"]:
    """The difference to each length, for every slot of the total."""
    total = totals.as_float()
    missing = (lengths - totals.whole).astype(total.dtype) - totals.fraction
    return jnp.maximum(missing, 0.0) / jnp.where(total > 0, total, 1.0)


def in_slots(
    positions: Positions, growth: Float[Array, "#n"], shift: Int[Array, "#n"]
) -> Positions:
    """Positions in units of 2^-shift slots, each shifted by its share of the gap to the length.

    Rounding errors, of the values and of the number that they were divided by, then do not add to
    the last particle alone. Equal positions stay equal, and the order does not change.
    """
    fraction = positions.fraction + growth * positions.as_float()
    turns = jnp.floor(fraction)
    units = positions.whole + turns.astype(jnp.int32)
    below = units & ((1 << shift) - 1)
    share = (below.astype(fraction.dtype) + (fraction - turns)) / (1 << shift).astype(
        fraction.dtype
    )
    turns = jnp.floor(share)  # by rounding
    return Positions((units >> shift) + turns.astype(jnp.int32), share - turns)


def random_positions(key: Key[Array, ""], lengths: Int[Array, " n"]) -> Positions:
    """Independent uniform points, one on each line of 0 to `length` > 0 slots.

    A point is the length times a uniform number of 32 + 23 bits: with 23 bits alone, a slot of four
    million would have only two points.
    """
    key_word, key_rest = split(key, 2)
    word = bits(key_word, lengths.shape)
    rest = uniform(key_rest, lengths.shape)
    whole, low = _wide_product(word, lengths.astype(jnp.uint32))
    fraction = low.astype(rest.dtype) * 2.0**-32 + rest * lengths.astype(rest.dtype) * 2.0**-32
    turns = jnp.floor(fraction)
    # Rounding must not reach the end of the line.
    below_one = np.nextafter(np.ones((), rest.dtype), np.zeros((), rest.dtype))
    whole = whole.astype(jnp.int32) + turns.astype(jnp.int32)
    is_end = whole >= lengths
    fraction = jnp.where(is_end, below_one, fraction - turns)
    return Positions(jnp.where(is_end, lengths - 1, whole), fraction)


def _wide_product(
    one: UInt32[Array, " n"], two: UInt32[Array, " n"]
) -> tuple[UInt32[Array, " n"], UInt32[Array, " n"]]:
    """The upper and the lower 32 bits of the product."""
    half = 0xFFFF
    low = (one & half) * (two & half)
    middle = (one >> 16) * (two & half) + (low >> 16)
    other = (one & half) * (two >> 16) + (middle & half)
    high = (one >> 16) * (two >> 16) + (middle >> 16) + (other >> 16)
    return high, one * two


def last_before(positions: Positions, points: Positions, num_slots: int) -> Int[Array, " n"]:
    """The last of the positions, in ascending order, that is not after each point; -1 for none.

    Integer parts are counted, and a search takes place only among the positions of one slot. It
    takes as many turns as the logarithm of the most positions in a slot. Points are in [0,
    num_slots).
    """
    num_positions = positions.whole.shape[0]
    at_slot = count_places(jnp.clip(positions.whole, 0, num_slots), whole_blocks(num_slots + 1))
    upto = count_upto(at_slot, num_positions)
    slot = jnp.clip(points.whole, 0, num_slots - 1)
    last = take(upto, slot)
    first = last - take(at_slot, slot)

    def halve(bounds: tuple[Array, Array]) -> tuple[Array, Array]:
        first, last = bounds
        middle = jnp.minimum((first + last) // 2, num_positions - 1)
        is_before = take(positions.fraction, middle) <= points.fraction
        seeks = first < last
        return (
            jnp.where(seeks & is_before, middle + 1, first),
            jnp.where(seeks & ~is_before, middle, last),
        )

    first, _ = jax.lax.while_loop(
        lambda bounds: jnp.any(bounds[0] < bounds[1]), halve, (first, last)
    )
    return first - 1
