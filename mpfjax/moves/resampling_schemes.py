"""The schemes of resampling: systematic, stratified, multinomial, residual.

A scheme returns the first slot of every particle's offspring, counted from the first slot of its
row. Each particle has a stretch of its row, as long as its expected number of offspring k_m w_i.
The scheme knows where each stretch begins, and places one point in the share of each slot. To add
a scheme, write such a function and name it in `SCHEMES`.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key

from mpfjax.moves.slots import Slots, place_slots
from mpfjax.operations.generator import uniform
from mpfjax.operations.indexing import take
from mpfjax.operations.prefix_sums import sum_before
from mpfjax.operations.segments import spread
from mpfjax.operations.stored import stored, to_int


def systematic(key, expected, before, targets, slots, line):
    shift = stored(uniform(key, targets.shape, expected.dtype))
    return _points_before(before, line.of_places(shift))


def stratified(key, expected, before, targets, slots, line):
    shift = uniform(key, slots.components.shape, expected.dtype)
    slot = line.first_slots(slots) + before.astype(jnp.int32)
    slot = jnp.clip(slot, 0, shift.shape[0] - 1)
    return _points_before(before, take(shift, slot.reshape(-1)).reshape(slot.shape))


def _points_before(
    before: Float[Array, "rows p"], shift: Float[Array, "rows #p"]
) -> Int[Array, "rows p"]:
    """How many of the points s + shift, one in each slot s, come before a particle's stretch."""
    whole = jnp.floor(before)
    return to_int(whole, before.shape[-1]) + (shift < before - whole).astype(jnp.int32)


def multinomial(key, expected, before, targets, slots, line):
    points = sorted_points(key, slots, targets, expected.dtype)
    return _sorted_points_before(before, points, line.first_slots(slots))


def residual(key, expected, before, targets, slots, line):
    # In floating point, k times a weight of 1 / k may be a little less than 1; it must count as 1.
    whole = jnp.floor(expected * (1 + 16 * jnp.finfo(expected.dtype).eps))
    certain, _ = jax.vmap(sum_before)(whole)
    left = jnp.maximum(targets - line.sums(whole).astype(jnp.int32), 0)
    rest = place_slots(left, slots.components.shape[0])
    points = sorted_points(key, rest, left, expected.dtype)
    rests_before, _ = jax.vmap(sum_before)(jnp.maximum(expected - whole, 0.0))
    drawn = _sorted_points_before(rests_before, points, line.first_slots(rest))
    return certain.astype(jnp.int32) + drawn


def _sorted_points_before(
    before: Float[Array, "rows p"], points: Float[Array, " n"], first_slots: Int[Array, "rows 1"]
) -> Int[Array, "rows p"]:
    """How many of the points of its row come before a particle's stretch."""
    found = jnp.searchsorted(points, before + first_slots.astype(before.dtype), side="left")
    return found.astype(jnp.int32) - first_slots


def sorted_points(
    key: Key[Array, ""], slots: Slots, targets: Int[Array, " m"], dtype: jnp.dtype
) -> Float[Array, " n"]:
    """Independent uniform points on each component's stretch of slots, in ascending order."""
    shares = uniform(key, slots.components.shape, dtype)
    firsts = spread(slots.firsts, slots.components).astype(dtype)
    lengths = spread(targets, slots.components).astype(dtype)
    # Rounding must not move the last point into the next component.
    before_end = jnp.nextafter(firsts + lengths, jnp.zeros_like(firsts))
    points = jnp.minimum(firsts + lengths * shares, before_end)
    return jnp.sort(jnp.where(slots.filled, points, jnp.inf))


SCHEMES: dict[str, Callable[..., Int[Array, " n"]]] = {
    "systematic": systematic,
    "stratified": stratified,
    "multinomial": multinomial,
    "residual": residual,
}
