"""Sampling of ancestors: the parent of each slot, by one of several schemes.

A scheme returns the first slot of every particle's offspring. Each particle has an interval of the
line, as long as its expected number of offspring k_m w_i, and the scheme places one point in the
unit interval of each slot and counts those before the particle's. To add a scheme, write such a
function and name it in `SCHEMES`.

A particle may be retained, as in conditional SMC: it then has at least one offspring. The offspring
of all have their ordinary distribution, given that one slot of its component, each with equal
probability, has the retained particle as its parent. So the numbers of offspring have their
ordinary distribution weighted by the number of the retained particle, and its slot is any of its
offspring. Points have this distribution if one of them is drawn uniformly from the particle's own
interval.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from mpfjax.moves.resampling.allocation import Slots, place_slots
from mpfjax.moves.resampling.line import Line
from mpfjax.operations.prefix_sums import Positions, count_starts, count_upto, unit_bits
from mpfjax.operations.random import below, split, uniform
from mpfjax.operations.segments import spread
from mpfjax.operations.stored import count_places, stored, take, whole_blocks


class Ancestors(NamedTuple):
    """The particle that each slot takes."""

    particles: Int[Array, " n"]
    slots: Slots
    reference: Int[Array, ""] | None  # the slot of the offspring that was to be kept


class ReferenceParticle(NamedTuple):
    """A particle that has one offspring at least."""

    place: Int[Array, ""]
    component: Int[Array, ""]
    shares: Float[Array, "2"]  # independent uniform numbers, for its point and its slot


class Dealt(NamedTuple):
    """What a scheme draws from: a line, and the slots that its components have."""

    line: Line
    targets: Int[Array, " m"]  # how many slots
    slots: Slots
    expected: Float[Array, " p"]  # the expected number of offspring of each particle
    before: Positions  # the start of its interval
    reference: ReferenceParticle | None


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
    before, is_inside = line.positions(expected, targets, slots.firsts, num_slots)
    reference = None
    if keep is not None:
        key, key_kept = split(key, 2)
        place, component = keep, jnp.zeros((), jnp.int32)
        if line.order is not None and line.labels is not None:
            place = jnp.argmax(line.order == keep).astype(jnp.int32)
            component = line.components[place]
        reference = ReferenceParticle(place, component, uniform(key_kept, (2,), expected.dtype))
    starts = SCHEMES[scheme](key, Dealt(line, targets, slots, expected, before, reference))
    # Rounding must not give a slot to particles after the last weight, nor cross a border.
    num_filled = jnp.sum(targets, dtype=jnp.int32)
    starts = jnp.where(is_inside, jnp.minimum(starts, num_filled), num_filled)
    firsts, lasts = line.extents(drawn=True)
    firsts, lasts = spread(firsts, slots.components), spread(lasts, slots.components)
    parents = jnp.clip(count_starts(starts, num_slots), firsts, lasts)
    if due is not None:
        parents = jnp.where(spread(due, slots.components), parents, firsts + slots.ranks)
    slot = None
    if reference is not None:
        # Rounding may leave it without any: it then takes the slot where its interval starts.
        is_own = slots.filled & (parents == reference.place)
        number = jnp.sum(is_own, dtype=jnp.int32)
        choice = (reference.shares[1] * number.astype(expected.dtype)).astype(jnp.int32)
        slot = jnp.argmax(is_own).astype(jnp.int32) + jnp.minimum(choice, number - 1)
        slot = jnp.where(number > 0, slot, starts[reference.place])
        first, most = slots.firsts[reference.component], targets[reference.component]
        slot = jnp.clip(slot, first, first + jnp.maximum(most, 1) - 1)
        parents = parents.at[slot].set(reference.place)
    particles = jnp.clip(parents, 0, line.num_particles - 1)
    if line.order is not None:
        particles = take(line.order, stored(particles))
    return Ancestors(particles, slots, slot)


def systematic(key: Key[Array, ""], dealt: Dealt) -> Int[Array, " p"]:
    shift = stored(uniform(key, dealt.targets.shape, dealt.expected.dtype))
    if dealt.reference is not None:
        shift = shift.at[dealt.reference.component].set(_reference_point(dealt).fraction)
    comes_before = dealt.line.of_places(shift) < dealt.before.fraction
    return dealt.before.whole + comes_before.astype(jnp.int32)


def stratified(key: Key[Array, ""], dealt: Dealt) -> Int[Array, " p"]:
    shift = uniform(key, dealt.slots.components.shape, dealt.expected.dtype)
    if dealt.reference is not None:
        point = _reference_point(dealt)
        shift = shift.at[point.whole].set(point.fraction, mode="drop")
    slot = jnp.clip(dealt.before.whole, 0, shift.shape[0] - 1)
    comes_before = take(shift, slot) < dealt.before.fraction
    return dealt.before.whole + comes_before.astype(jnp.int32)


def _reference_point(dealt: Dealt) -> Positions:
    """A point drawn uniformly from the interval of the kept particle."""
    assert dealt.reference is not None
    before, place = dealt.before, dealt.reference.place
    start = Positions(before.whole[place], before.fraction[place])
    return start.shift(dealt.reference.shares[0] * dealt.expected[place])


def multinomial(key: Key[Array, ""], dealt: Dealt) -> Int[Array, " p"]:
    slots, num_places = dealt.slots, dealt.expected.shape[0]
    num_slots = slots.components.shape[0]
    num_bits = unit_bits(num_slots)
    lengths = jnp.maximum(spread(dealt.targets, slots.components), 1) << num_bits
    points = below(key, lengths) + (spread(slots.firsts, slots.components) << num_bits)
    if dealt.reference is not None:
        point = _reference_point(dealt).in_units(num_bits)
        points = points.at[slots.firsts[dealt.reference.component]].set(point, mode="drop")
    parents = jnp.searchsorted(dealt.before.in_units(num_bits), points, side="right") - 1
    # The points of empty slots are in no particle's interval.
    places = jnp.where(slots.filled, jnp.maximum(parents, 0).astype(jnp.int32), num_places)
    offspring = count_places(places, whole_blocks(num_places + 1))[:num_places]
    return count_upto(offspring, num_slots) - offspring


SCHEMES: dict[str, Callable[[Key[Array, ""], Dealt], Int[Array, " p"]]] = {
    "systematic": systematic,
    "stratified": stratified,
    "multinomial": multinomial,
}
