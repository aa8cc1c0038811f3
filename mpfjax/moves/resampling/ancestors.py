"""Drawing ancestors: the particle that each slot takes, by one of several schemes.

A scheme returns the first slot of every particle's offspring. Each particle has an interval of the
line, as long as its expected number of offspring k_m w_i, and the scheme places one point in the
unit interval of each slot and counts those before the particle's. To add a scheme, write such a
function and name it in `SCHEMES`.

A particle may be kept, as conditional SMC does: it then has one offspring at least. The offspring
of all have their ordinary law, given that one slot of its component, each with equal probability,
has the kept particle for its parent. So the numbers of offspring have their ordinary law weighed by
that of the kept particle, and its slot is any of its offspring. Points get this law if one of them
is drawn uniformly from the particle's own interval.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from mpfjax.moves.resampling.allocation import Slots, place_slots
from mpfjax.moves.resampling.line import Line
from mpfjax.operations.prefix_sums import (
    Positions,
    count_starts,
    count_upto,
    last_before,
    random_positions,
)
from mpfjax.operations.random import split, uniform
from mpfjax.operations.segments import spread
from mpfjax.operations.stored import count_places, stored, take, whole_blocks

_MOST_LEVELS = 31  # of the pairs of a component, whose particles are counted in 31 bits


class Ancestors(NamedTuple):
    """The particle that each slot takes."""

    particles: Int[Array, " n"]
    slots: Slots
    kept: Int[Array, ""] | None  # the slot of the offspring that was to be kept


class Kept(NamedTuple):
    """A particle that has one offspring at least."""

    place: Int[Array, ""]
    component: Int[Array, ""]
    shares: Float[Array, " levels"]  # independent uniform numbers

    def point(self, before: Positions, distance: Float[Array, ""]) -> Positions:
        """The point at a distance from the start of its interval."""
        start = Positions(before.whole[self.place], before.fraction[self.place])
        return start.moved_by(distance)


class Dealt(NamedTuple):
    """What a scheme draws from: a line, and the slots that its components have."""

    line: Line
    targets: Int[Array, " m"]  # how many slots
    slots: Slots
    expected: Float[Array, " p"]  # the expected number of offspring of each particle
    before: Positions  # the start of its interval
    kept: Kept | None


def draw_ancestors(
    key: Key[Array, ""],
    line: Line,
    targets: Int[Array, " m"],
    scheme: str,
    *,
    num_slots: int,
    due: Bool[Array, " m"] | None = None,
    keep: Int[Array, ""] | None = None,
) -> Ancestors:
    """The parents of the slots: `targets` of each component, side by side, the empty ones last.

    Where a component is not `due`, its particles stay as they are; None resamples every one. The
    particle `keep` has an offspring whatever is drawn; it must be drawn from, or stay, in `line`.
    """
    slots = place_slots(targets, num_slots)
    shares = targets.astype(line.totals.dtype) / jnp.where(line.totals > 0, line.totals, 1.0)
    expected = line.weights * line.of_places(shares)
    before, is_inside = line.positions(expected, targets, slots.firsts)
    kept = None
    if keep is not None:
        key, key_kept = split(key, 2)
        place, component = keep, jnp.zeros((), jnp.int32)
        if line.order is not None and line.components is not None:
            place = jnp.argmax(line.order == keep).astype(jnp.int32)
            component = line.components[place]
        kept = Kept(place, component, uniform(key_kept, (_MOST_LEVELS + 2,), expected.dtype))
    starts = SCHEMES[scheme](key, Dealt(line, targets, slots, expected, before, kept))
    # Rounding must not give a slot to particles after the last weight, nor cross a border.
    num_filled = jnp.sum(targets, dtype=jnp.int32)
    starts = jnp.where(is_inside, jnp.minimum(starts, num_filled), num_filled)
    firsts, lasts = line.extents(drawn=True)
    firsts, lasts = spread(firsts, slots.components), spread(lasts, slots.components)
    parents = jnp.clip(count_starts(starts, num_slots), firsts, lasts)
    if due is not None:
        parents = jnp.where(spread(due, slots.components), parents, firsts + slots.ranks)
    slot = None
    if kept is not None:
        # Rounding may leave it without any: it then takes the slot where its interval starts.
        is_own = slots.filled & (parents == kept.place)
        number = jnp.sum(is_own, dtype=jnp.int32)
        choice = (kept.shares[-1] * number.astype(expected.dtype)).astype(jnp.int32)
        slot = jnp.argmax(is_own).astype(jnp.int32) + jnp.minimum(choice, number - 1)
        slot = jnp.where(number > 0, slot, starts[kept.place])
        first, most = slots.firsts[kept.component], targets[kept.component]
        slot = jnp.clip(slot, first, first + jnp.maximum(most, 1) - 1)
        parents = parents.at[slot].set(kept.place)
    particles = jnp.clip(parents, 0, line.num_particles - 1)
    if line.order is not None:
        particles = take(line.order, stored(particles))
    return Ancestors(particles, slots, slot)


def systematic(key: Key[Array, ""], dealt: Dealt) -> Int[Array, " p"]:
    shift = stored(uniform(key, dealt.targets.shape, dealt.expected.dtype))
    if dealt.kept is not None:
        shift = shift.at[dealt.kept.component].set(_own_point(dealt).fraction)
    comes_before = dealt.line.of_places(shift) < dealt.before.fraction
    return dealt.before.whole + comes_before.astype(jnp.int32)


def stratified(key: Key[Array, ""], dealt: Dealt) -> Int[Array, " p"]:
    shift = uniform(key, dealt.slots.components.shape, dealt.expected.dtype)
    if dealt.kept is not None:
        own = _own_point(dealt)
        shift = shift.at[own.whole].set(own.fraction, mode="drop")
    slot = jnp.clip(dealt.before.whole, 0, shift.shape[0] - 1)
    comes_before = take(shift, slot) < dealt.before.fraction
    return dealt.before.whole + comes_before.astype(jnp.int32)


def _own_point(dealt: Dealt) -> Positions:
    """A point drawn uniformly from the interval of the kept particle."""
    assert dealt.kept is not None
    return dealt.kept.point(dealt.before, dealt.kept.shares[0] * dealt.expected[dealt.kept.place])


def multinomial(key: Key[Array, ""], dealt: Dealt) -> Int[Array, " p"]:
    points = random_points(key, dealt.slots, dealt.targets)
    if dealt.kept is not None:
        points = _with_point(points, _own_point(dealt), dealt.slots.firsts[dealt.kept.component])
    return _random_points_before(points, dealt.before, dealt.slots)


def residual(key: Key[Array, ""], dealt: Dealt) -> Int[Array, " p"]:
    _, targets, slots, expected, _, kept = dealt
    whole = _certain(expected)
    copies = whole.astype(jnp.int32)
    certain = count_upto(copies, 2 * expected.shape[0]) - copies
    left = jnp.maximum(targets - dealt.line.sums(whole).astype(jnp.int32), 0)
    rest = place_slots(left, slots.components.shape[0])
    rests_before, _ = dealt.line.positions(jnp.maximum(expected - whole, 0.0), left, rest.firsts)
    points = random_points(key, rest, left)
    if kept is not None:
        # Its offspring is one of the certain ones, or one of those that are drawn.
        distance = kept.shares[0] * expected[kept.place] - whole[kept.place]
        is_drawn = (distance >= 0) & (left[kept.component] > 0)
        point = kept.point(rests_before, jnp.maximum(distance, 0.0))
        nowhere = slots.components.shape[0]
        slot = jnp.where(is_drawn, rest.firsts[kept.component], nowhere)
        points = _with_point(points, point, slot)
    return certain + _random_points_before(points, rests_before, rest)


def _certain(expected: Float[Array, " p"]) -> Float[Array, " p"]:
    """The whole part of each expected number of offspring."""
    # In floating point, k times a weight of 1 / k may be a little less than 1; it must count as 1.
    return jnp.floor(expected * (1 + 16 * jnp.finfo(expected.dtype).eps))


def ssp(key: Key[Array, ""], dealt: Dealt) -> Int[Array, " p"]:
    """Srinivasan's process: fractions are paired until each is 0 or 1 (Gerber et al. 2019).

    Of two fractions with the sum s, one becomes 0 and the other s; or, if s >= 1, one becomes 1 and
    the other s - 1. The choice is random, such that each keeps its mean. Every particle thus has
    the floor or the ceiling of its expected number of offspring. The pairs form a tree over each
    component, and all pairs of a level are settled at once: O(log N) levels.
    """
    line, expected, kept = dealt.line, dealt.expected, dealt.kept
    # Includes particles that are never drawn, so that every place has a rank from 0 on.
    firsts, lasts = line.extents(drawn=False)
    firsts, counts = map(line.of_places, (firsts, lasts - firsts + 1))
    whole = _certain(expected)
    uniforms = uniform(key, expected.shape, expected.dtype)
    # The fraction of the kept particle becomes 1, unless its offspring is one of the certain ones.
    is_due = None if kept is None else kept.shares[0] * expected[kept.place] >= whole[kept.place]
    rest = jnp.maximum(expected - whole, 0.0)
    is_up = _settle(rest, uniforms, firsts, counts, kept, is_due)
    offspring = whole.astype(jnp.int32) + is_up.astype(jnp.int32)
    # Relative to the component's first, so that rounding errors stay within the component.
    earlier = jnp.cumsum(offspring) - offspring
    return earlier - take(earlier, firsts) + line.of_places(dealt.slots.firsts)


def _settle(
    fractions: Float[Array, " p"],
    uniforms: Float[Array, " p"],
    firsts: Int[Array, " #p"],
    counts: Int[Array, " #p"],
    kept: Kept | None,
    is_due: Bool[Array, ""] | None,
) -> Bool[Array, " p"]:
    """Which of the fractions become 1, where those of each component sum to a whole number.

    The components' places start at `firsts`, so many for each. The `kept` one is 1 if that is due.
    """
    p = fractions.shape[0]
    ranks = jnp.arange(p, dtype=jnp.int32) - firsts

    def at(values: Array, rank: Int[Array, " p"]) -> Array:
        return take(values, jnp.clip(firsts + rank, 0, p - 1))

    levels = []
    left_over, length = fractions, 1
    while length < p:
        # The pair of the blocks 2r and 2r + 1 of a component stands at its rank r.
        has_right = (2 * ranks + 1) * length < counts
        left = at(left_over, 2 * ranks)
        right = jnp.where(has_right, at(left_over, 2 * ranks + 1), 0.0)
        total = left + right
        one_is_up = total >= 1
        # The middle of a pair's interval belongs to no other pair.
        draw = at(uniforms, (2 * ranks + 1) * length) * jnp.where(one_is_up, 2.0 - total, total)
        left_stays = draw < jnp.where(one_is_up, 1 - left, left)
        if kept is not None and is_due is not None:
            # Its own block becomes 1 at once, or stays with what is left over; but never 0.
            rank, share = ranks[kept.place], kept.shares[1 + len(levels)]
            is_left = (rank // length) % 2 == 0
            own, other = jnp.where(is_left, left, right), jnp.where(is_left, right, left)
            leaves = one_is_up & (share * own * (2 - total) < 1 - other)
            pair = kept.place - rank + rank // (2 * length)
            is_pair = is_due & (jnp.arange(p, dtype=jnp.int32) == pair)
            left_stays = jnp.where(is_pair, leaves != is_left, left_stays)
            is_due = is_due & ~leaves[pair]
        levels.append((left_stays, one_is_up))
        left_over, length = total - one_is_up.astype(total.dtype), 2 * length
    is_up = left_over > 0.5
    for left_stays, one_is_up in reversed(levels):
        stays = at(left_stays, ranks // 2) == (ranks % 2 == 0)
        is_up = jnp.where(stays, at(is_up, ranks // 2), at(one_is_up, ranks // 2))
    return is_up & (ranks < counts)


def random_points(key: Key[Array, ""], slots: Slots, targets: Int[Array, " m"]) -> Positions:
    """For each slot an independent uniform point on its component's interval of slots."""
    lengths = jnp.maximum(spread(targets, slots.components), 1)
    points = random_positions(key, lengths)
    return Positions(points.whole + spread(slots.firsts, slots.components), points.fraction)


def _with_point(points: Positions, point: Positions, slot: Int[Array, ""]) -> Positions:
    """The points with another one for a slot."""
    return Positions(
        points.whole.at[slot].set(point.whole, mode="drop"),
        points.fraction.at[slot].set(point.fraction, mode="drop"),
    )


def _random_points_before(points: Positions, before: Positions, slots: Slots) -> Int[Array, " p"]:
    """How many of the points come before a particle's interval."""
    num_places, num_slots = before.whole.shape[0], slots.components.shape[0]
    parents = jnp.maximum(last_before(before, points, num_slots), 0)
    # The points of empty slots are in no particle's interval.
    places = jnp.where(slots.filled, parents, num_places)
    offspring = count_places(places, whole_blocks(num_places + 1))[:num_places]
    return count_upto(offspring, num_slots) - offspring


SCHEMES: dict[str, Callable[[Key[Array, ""], Dealt], Int[Array, " p"]]] = {
    "systematic": systematic,
    "stratified": stratified,
    "multinomial": multinomial,
    "residual": residual,
    "ssp": ssp,
}
