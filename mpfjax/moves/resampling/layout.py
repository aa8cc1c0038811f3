"""The layout of particles for resampling: on a line, component by component.

Imagine the particles on a line, each with an interval ("stretch") as long as its expected number of
offspring. Every slot has a point on the line and takes the particle whose interval holds it. The
particles of a component must be neighbours. After resampling they are, and until they are regrouped
nothing has to be sorted.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Shaped

from mpfjax.mixture import ParticleMixture
from mpfjax.moves.resampling.allocation import Slots
from mpfjax.moves.resampling.ordering import SortBy, sorted_order
from mpfjax.operations.choices import cond_if_any
from mpfjax.operations.indexing import take
from mpfjax.operations.logarithms import exp, finite_or_zero, log_or_nothing
from mpfjax.operations.positions import (
    Positions,
    as_positions,
    exact_sum_before,
    growths,
    in_slots,
    needs_two_parts,
    scales,
    unit_shift,
)
from mpfjax.operations.prefix_sums import sum_before
from mpfjax.operations.runs import Runs, runs_of, whole
from mpfjax.operations.segments import order_by_segment, segment_counts, spread
from mpfjax.operations.stored import stored


class Stretches(NamedTuple):
    """For each place, the part of the line that its component's particles and slots occupy."""

    firsts: Int[Array, " p"]
    counts: Int[Array, " p"]  # how many places the component has
    first_slots: Int[Array, " p"]


class InPlace(NamedTuple):
    """The particles of a single component, in their present order.

    The line has p places, a multiple of the block length of the prefix sums.
    """

    weights: Float[Array, " p"]  # zero at an empty place
    counts: Int[Array, " 1"]

    def of_places(self, values: Shaped[Array, " 1"]) -> Shaped[Array, " 1"]:
        """The component's value at each place."""
        return values

    def expected(self, targets: Int[Array, " 1"]) -> Float[Array, " p"]:
        """The expected number of offspring of each particle."""
        return self.weights * targets.astype(self.weights.dtype)

    def sums(self, values: Float[Array, " p"]) -> Float[Array, " 1"]:
        """The sum over all places."""
        return jnp.sum(values, keepdims=True)

    def positions(
        self, values: Float[Array, " p"], lengths: Int[Array, " 1"], slots: Slots
    ) -> tuple[Positions, Bool[Array, " p"]]:
        """The start of each interval, in slots, and which of them are not after the last slot.

        The values are the lengths of the intervals; they sum to the line's length up to rounding.
        """
        if not needs_two_parts(values.shape[0], values.dtype):
            return _sums_in_one_float(values)
        firsts, lasts = jnp.zeros(1, jnp.int32), jnp.full(1, values.shape[0] - 1, jnp.int32)
        return _sums_in_two_parts(self, values, lengths, slots.firsts, (firsts, lasts))

    def num_slots(self, targets: Int[Array, " 1"], num_particles: int) -> Int[Array, ""]:
        """How many slots are to be filled."""
        del num_particles
        return targets[0]

    def places_of(self, parents: Int[Array, " n"], slots: Slots) -> Int[Array, " n"]:
        """The place of each slot's parent."""
        del slots
        return parents

    def stretches(self, slots: Slots) -> Stretches:
        """The whole line belongs to the component."""
        del slots
        zeros = jnp.zeros(self.weights.shape, jnp.int32)
        return Stretches(zeros, zeros + self.weights.shape[0], zeros)

    def places_by_rank(self, ranks: Int[Array, " n"], slots: Slots) -> Int[Array, " n"]:
        """The place of a given rank in the component."""
        del slots
        return ranks

    def particles_at(self, places: Int[Array, " n"]) -> Int[Array, " n"]:
        """The particles at these places."""
        return places


class SideBySide(NamedTuple):
    """The particles in a line of p places, component by component."""

    relative_weights: Float[Array, " p"]  # over the component's largest; 0 at an empty place
    log_largest: Float[Array, " m"]  # the logarithm of that largest weight, or 0
    order: Int[Array, " p"]  # which particle stands at each place
    components: Int[Array, " p"]
    is_drawn: Bool[Array, " p"]  # at which places a particle may be drawn, or stays as it is
    runs: Runs

    @property
    def counts(self) -> Int[Array, " m"]:
        """How many places each component has."""
        return segment_counts(self.is_drawn, self.components, self.log_largest.shape[0])

    @property
    def totals(self) -> Float[Array, " m"]:
        """The sum of each component's relative weights, zero for a dead one."""
        return self.sums(self.relative_weights)

    @property
    def log_masses(self) -> Float[Array, " m"]:
        """The logarithm of each component's mass."""
        return log_or_nothing(self.totals) + self.log_largest

    @property
    def effective_sample_sizes(self) -> Float[Array, " m"]:
        """(Σ w)² / Σ w² of each component, zero for a dead one."""
        squares = self.sums(self.relative_weights**2)
        return self.totals**2 / jnp.where(squares > 0, squares, 1.0)

    def of_places(self, values: Shaped[Array, " m"]) -> Shaped[Array, " p"]:
        """The value of the component at each place."""
        return spread(values, self.components)

    def expected(self, targets: Int[Array, " m"]) -> Float[Array, " p"]:
        """The expected number of offspring of each particle."""
        totals = self.totals
        shares = targets.astype(totals.dtype) / jnp.where(totals > 0, totals, 1.0)
        return self.relative_weights * self.of_places(stored(shares))

    def sums(self, values: Float[Array, " p"]) -> Float[Array, " m"]:
        """The sum over each component's places."""
        return self.runs.sums(values)

    def positions(
        self, values: Float[Array, " p"], lengths: Int[Array, " m"], slots: Slots
    ) -> tuple[Positions, Bool[Array, " p"]]:
        """The start of each interval, in slots, and which of them are not after the last slot.

        The values are the lengths of the intervals; they sum to each component's length up to
        rounding.
        """
        if not needs_two_parts(values.shape[0], values.dtype):
            return _sums_in_one_float(values)
        extents = self._extents(jnp.ones_like(self.is_drawn))
        return _sums_in_two_parts(self, values, lengths, slots.firsts, extents)

    def num_slots(self, targets: Int[Array, " m"], num_particles: int) -> Int[Array, ""]:
        """How many slots are to be filled; the last ones may stay empty."""
        del targets
        return jnp.asarray(num_particles, jnp.int32)

    def places_of(self, parents: Int[Array, " n"], slots: Slots) -> Int[Array, " n"]:
        """The place of each slot's parent; rounding must not cross a border of components."""
        firsts, lasts = self._extents(self.is_drawn)
        return jnp.clip(parents, spread(firsts, slots.components), spread(lasts, slots.components))

    def stretches(self, slots: Slots) -> Stretches:
        """The parts of the line of the components' particles and slots."""
        # Includes particles that are never drawn, so that every place has a rank from 0 on.
        firsts, lasts = self._extents(jnp.ones_like(self.is_drawn))
        counts = lasts - firsts + 1
        return Stretches(*map(self.of_places, (firsts, counts, slots.firsts)))

    def places_by_rank(self, ranks: Int[Array, " n"], slots: Slots) -> Int[Array, " n"]:
        """The place of a rank in each slot's component."""
        firsts, _ = self._extents(self.is_drawn)
        return spread(firsts, slots.components) + ranks

    def particles_at(self, places: Int[Array, " n"]) -> Int[Array, " n"]:
        """The particles at these places."""
        return take(self.order, stored(places))

    def _extents(self, mask: Bool[Array, " p"]) -> tuple[Int[Array, " m"], Int[Array, " m"]]:
        firsts, lasts = stored(jnp.stack(self.runs.extents(mask)))
        return firsts, lasts


def _sums_in_one_float(values: Float[Array, " p"]) -> tuple[Positions, Bool[Array, " p"]]:
    """The sums over all places, across components."""
    before, total = sum_before(values)
    return as_positions(before), before < total


def _sums_in_two_parts(
    line: InPlace | SideBySide,
    values: Float[Array, " p"],
    lengths: Int[Array, " m"],
    first_slots: Int[Array, " m"],
    extents: tuple[Int[Array, " m"], Int[Array, " m"]],
) -> tuple[Positions, Bool[Array, " p"]]:
    """The sums from each component's own first slot, without the rounding errors of others."""
    num_places = values.shape[0]
    firsts, lasts = extents
    shift = unit_shift(lengths, lasts - firsts + 1)
    scale = scales(line.sums(values), lengths << shift, num_places)
    before, total = exact_sum_before(values * line.of_places(stored(scale)))
    starts, nexts = before.at(firsts), before.at(jnp.minimum(lasts + 1, num_places - 1))
    is_end = lasts == num_places - 1
    ends = Positions(*(jnp.where(is_end, *pair) for pair in zip(total, nexts, strict=True)))
    growth = growths(ends.after(starts), lengths << shift)
    starts = Positions(*map(line.of_places, starts))
    within = in_slots(before.after(starts), line.of_places(growth), line.of_places(shift))
    is_inside = (before.whole < total.whole) | (before.fraction < total.fraction)
    positions = Positions(within.whole + line.of_places(first_slots), within.fraction)
    # A place after a component's last weight is exactly at its end.
    ends = Positions(*map(line.of_places, ends))
    is_after = (before.whole == ends.whole) & (before.fraction == ends.fraction)
    end = line.of_places(first_slots + lengths)
    whole = jnp.where(is_after, end, positions.whole)
    return Positions(whole, jnp.where(is_after, 0.0, positions.fraction)), is_inside


def as_they_are(mixture: ParticleMixture) -> InPlace:
    """All particles of the only component."""
    return InPlace(whole(mixture.component_weights, 0.0), mixture.component_counts)


def side_by_side(
    mixture: ParticleMixture,
    stays: Bool[Array, " n"] | None,
    sort_by: SortBy | None,
    without_gaps: bool,
) -> SideBySide:
    """The components in a line.

    If `without_gaps`, the particles of a component that can be drawn are neighbours. A weight may
    underflow to zero where its logarithm does not. Such a particle is not drawn where its component
    is resampled, and is kept where its component `stays` as it is.
    """
    m = mixture.num_components
    labels = mixture.component_indicators
    if without_gaps or sort_by is not None:
        stands = mixture.component_weights > 0
        if stays is not None:
            stands |= mixture.occupied & stays
        labels = jnp.where(stands, labels, m)
    log_weights, labels = whole(mixture.log_weights, -jnp.inf), whole(labels, m)

    def in_line(order: Int[Array, " p"]) -> tuple[Array, Array, Array]:
        own = take(labels, order)
        # Labels without particles come last.
        return order, jnp.where(own < m, take(log_weights, order), -jnp.inf), own

    def by_component() -> tuple[Array, Array, Array]:
        return in_line(order_by_segment(labels, m)[0])

    def as_they_are() -> tuple[Array, Array, Array]:
        return jnp.arange(labels.shape[0], dtype=jnp.int32), log_weights, labels

    if sort_by is None:
        is_mixed = jnp.any(labels[1:] < labels[:-1])
        order, log_weights, labels = cond_if_any(is_mixed, by_component, as_they_are)
    else:
        order = sorted_order(mixture, labels[: mixture.num_particles], sort_by)
        order, log_weights, labels = in_line(whole(order, labels.shape[0] - 1))
    runs = runs_of(labels, m)
    labels = jnp.minimum(labels, m - 1)
    log_largest = finite_or_zero(runs.maxima(log_weights))
    relative = exp(log_weights - spread(stored(log_largest), labels))
    is_drawn = relative > 0
    if stays is not None:
        is_drawn |= (log_weights > -jnp.inf) & take(whole(stays, False), order)
    return SideBySide(relative, log_largest, order, labels, is_drawn, runs)
