"""The schemes of resampling: systematic, stratified, multinomial, residual, SSP.

A scheme returns the first slot of every particle's offspring. Each particle has an interval of the
line, as long as its expected number of offspring k_m w_i. The scheme is given the start of each
interval, `before`, as a whole number of slots and a fraction, and places one point in the unit
interval of each slot. To add a scheme, write such a function and name it in `SCHEMES`.
"""

from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from mpfjax.moves.resampling.allocation import Slots, place_slots
from mpfjax.moves.resampling.layout import Stretches
from mpfjax.operations.generator import uniform
from mpfjax.operations.indexing import count_places, take
from mpfjax.operations.positions import Positions, last_before, random_positions
from mpfjax.operations.prefix_sums import count_upto
from mpfjax.operations.segments import spread
from mpfjax.operations.stored import stored, whole_blocks


def systematic(key, expected, before, targets, slots, line):
    shift = stored(uniform(key, targets.shape, expected.dtype))
    return _points_before(before, line.of_places(shift))


def stratified(key, expected, before, targets, slots, line):
    shift = uniform(key, slots.components.shape, expected.dtype)
    slot = jnp.clip(before.whole, 0, shift.shape[0] - 1)
    return _points_before(before, take(shift, slot))


def _points_before(before: Positions, shift: Float[Array, " #p"]) -> Int[Array, " p"]:
    """How many of the points s + shift, one in each slot s, come before a particle's interval."""
    return before.whole + (shift < before.fraction).astype(jnp.int32)


def multinomial(key, expected, before, targets, slots, line):
    return _random_points_before(key, before, slots, targets)


def residual(key, expected, before, targets, slots, line):
    # In floating point, k times a weight of 1 / k may be a little less than 1; it must count as 1.
    whole = jnp.floor(expected * (1 + 16 * jnp.finfo(expected.dtype).eps))
    copies = whole.astype(jnp.int32)
    certain = count_upto(copies, 2 * expected.shape[0]) - copies
    left = jnp.maximum(targets - line.sums(whole).astype(jnp.int32), 0)
    rest = place_slots(left, slots.components.shape[0])
    rests_before, _ = line.positions(jnp.maximum(expected - whole, 0.0), left, rest)
    return certain + _random_points_before(key, rests_before, rest, left)


def ssp(key, expected, before, targets, slots, line):
    """Srinivasan's process: fractions are paired until each is 0 or 1 (Gerber et al. 2019).

    Of two fractions with the sum s, one becomes 0 and the other s; or, if s >= 1, one becomes 1 and
    the other s - 1. The choice is random, such that each keeps its mean. Every particle thus has
    the floor or the ceiling of its expected number of offspring. The pairs form a tree over each
    component, and all pairs of a level are settled at once: O(log N) levels.
    """
    places = line.stretches(slots)
    whole = jnp.floor(expected * (1 + 16 * jnp.finfo(expected.dtype).eps))
    uniforms = uniform(key, expected.shape, expected.dtype)
    is_up = _settle(jnp.maximum(expected - whole, 0.0), uniforms, places)
    offspring = whole.astype(jnp.int32) + is_up.astype(jnp.int32)
    # Relative to the component's first, so that rounding errors stay within the component.
    earlier = jnp.cumsum(offspring) - offspring
    return earlier - take(earlier, places.firsts) + places.first_slots


def _settle(
    fractions: Float[Array, " p"], uniforms: Float[Array, " p"], places: Stretches
) -> Bool[Array, " p"]:
    """Which of the fractions become 1, where those of each component sum to a whole number."""
    p = fractions.shape[0]
    ranks = jnp.arange(p, dtype=jnp.int32) - places.firsts

    def at(values: Array, rank: Int[Array, " p"]) -> Array:
        return take(values, jnp.clip(places.firsts + rank, 0, p - 1))

    levels = []
    left_over, length = fractions, 1
    while length < p:
        # The pair of the blocks 2r and 2r + 1 of a component stands at its rank r.
        has_right = (2 * ranks + 1) * length < places.counts
        left = at(left_over, 2 * ranks)
        right = jnp.where(has_right, at(left_over, 2 * ranks + 1), 0.0)
        total = left + right
        one_is_up = total >= 1
        # The middle of a pair's interval belongs to no other pair.
        draw = at(uniforms, (2 * ranks + 1) * length) * jnp.where(one_is_up, 2.0 - total, total)
        left_stays = draw < jnp.where(one_is_up, 1 - left, left)
        levels.append((left_stays, one_is_up))
        left_over, length = total - one_is_up.astype(total.dtype), 2 * length
    is_up = left_over > 0.5
    for left_stays, one_is_up in reversed(levels):
        stays = at(left_stays, ranks // 2) == (ranks % 2 == 0)
        is_up = jnp.where(stays, at(is_up, ranks // 2), at(one_is_up, ranks // 2))
    return is_up & (ranks < places.counts)


def _random_points_before(
    key: Key[Array, ""], before: Positions, slots: Slots, targets: Int[Array, " m"]
) -> Int[Array, " p"]:
    """How many of independent points on the components' slots come before a particle's interval."""
    num_places, num_slots = before.whole.shape[0], slots.components.shape[0]
    points = random_points(key, slots, targets)
    parents = jnp.maximum(last_before(before, points, num_slots), 0)
    # The points of empty slots are in no particle's interval.
    places = jnp.where(slots.filled, parents, num_places)
    offspring = count_places(places, whole_blocks(num_places + 1))[:num_places]
    return count_upto(offspring, num_slots) - offspring


def random_points(key: Key[Array, ""], slots: Slots, targets: Int[Array, " m"]) -> Positions:
    """For each slot an independent uniform point on its component's interval of slots."""
    lengths = jnp.maximum(spread(targets, slots.components), 1)
    points = random_positions(key, lengths)
    return Positions(points.whole + spread(slots.firsts, slots.components), points.fraction)


SCHEMES: dict[str, Callable[..., Int[Array, " n"]]] = {
    "systematic": systematic,
    "stratified": stratified,
    "multinomial": multinomial,
    "residual": residual,
    "ssp": ssp,
}
