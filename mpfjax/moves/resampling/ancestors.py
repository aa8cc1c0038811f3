"""Sampling of ancestors: the parent of each slot, by one of several schemes.

A scheme returns the first slot of every particle's offspring. Each particle has an interval of the
line, as long as its expected number of offspring k_m w_i, and the scheme places one point in the
unit interval of each slot and counts those before the particle's. To add a scheme, write such a
function and name it in `SCHEMES`.

A particle may be retained, as in conditional SMC, if the scheme is multinomial: one slot of its
component, each with equal probability, has it as its parent, and the others are drawn as usual.
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


class Dealt(NamedTuple):
    """What a scheme draws from: a line, and the slots that its components have."""

    line: Line
    targets: Int[Array, " m"]  # how many slots
    slots: Slots
    expected: Float[Array, " p"]  # the expected number of offspring of each particle
    before: Positions  # the start of its interval


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
    particle `keep` has an offspring whatever is drawn, by the multinomial scheme; it must be drawn
    from, or stay, in `line`.
    """
    slots = place_slots(targets, num_slots)
    shares = targets.astype(line.totals.dtype) / jnp.where(line.totals > 0, line.totals, 1.0)
    expected = line.weights * line.of_places(shares)
    before, is_inside = line.positions(expected, targets, slots.firsts, num_slots)
    if keep is not None:
        key, key_kept = split(key, 2)
    starts = SCHEMES[scheme](key, Dealt(line, targets, slots, expected, before))
    # Rounding must not give a slot to particles after the last weight, nor cross a border.
    num_filled = jnp.sum(targets, dtype=jnp.int32)
    starts = jnp.where(is_inside, jnp.minimum(starts, num_filled), num_filled)
    first_places, last_places = line.extents(drawn=True)
    firsts, lasts = spread(first_places, slots.components), spread(last_places, slots.components)
    parents = jnp.clip(count_starts(starts, num_slots), firsts, lasts)
    if due is not None:
        parents = jnp.where(spread(due, slots.components), parents, firsts + slots.ranks)
    slot = None
    if keep is not None:
        place, component = line.place_of(keep)
        most = jnp.maximum(targets[component] - 1, 0)
        share = uniform(key_kept, (), expected.dtype) * targets[component].astype(expected.dtype)
        rank = share.astype(jnp.int32)
        if due is not None:
            rank = jnp.where(due[component], rank, place - first_places[component])
        slot = slots.firsts[component] + jnp.clip(rank, 0, most)
        parents = parents.at[slot].set(place)
    particles = jnp.clip(parents, 0, line.num_particles - 1)
    if line.order is not None:
        particles = take(line.order, stored(particles))
    return Ancestors(particles, slots, slot)


def systematic(key: Key[Array, ""], dealt: Dealt) -> Int[Array, " p"]:
    shift = stored(uniform(key, dealt.targets.shape, dealt.expected.dtype))
    comes_before = dealt.line.of_places(shift) < dealt.before.fraction
    return dealt.before.whole + comes_before.astype(jnp.int32)


def stratified(key: Key[Array, ""], dealt: Dealt) -> Int[Array, " p"]:
    shift = uniform(key, dealt.slots.components.shape, dealt.expected.dtype)
    slot = jnp.clip(dealt.before.whole, 0, shift.shape[0] - 1)
    comes_before = take(shift, slot) < dealt.before.fraction
    return dealt.before.whole + comes_before.astype(jnp.int32)


def multinomial(key: Key[Array, ""], dealt: Dealt) -> Int[Array, " p"]:
    slots, num_places = dealt.slots, dealt.expected.shape[0]
    num_slots = slots.components.shape[0]
    num_bits = unit_bits(num_slots)
    lengths = jnp.maximum(spread(dealt.targets, slots.components), 1) << num_bits
    points = below(key, lengths) + (spread(slots.firsts, slots.components) << num_bits)
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
