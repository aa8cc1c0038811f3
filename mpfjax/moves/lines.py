"""How particles stand in line to be resampled: a row for each component, or all in one row.

Imagine the particles along a line, each with a stretch as long as its expected number of offspring.
Every slot places a point on the line and takes the particle whose stretch holds it. With few
components, each has a line of its own, over all particles, as they stand (`AsTheyStand`). With
many, the particles are first put side by side, component by component, on one line (`SideBySide`).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Shaped

from mpfjax.mixture import ParticleMixture
from mpfjax.moves.slots import Slots
from mpfjax.moves.standing import SortBy, standing_order
from mpfjax.operations.indexing import take
from mpfjax.operations.segments import order_by_segment, segment_counts, segment_sum, spread
from mpfjax.operations.stored import stored, whole_blocks


class Stretches(NamedTuple):
    """For each place, where in its row the particles and the slots of its component are."""

    firsts: Int[Array, "rows p"]
    counts: Int[Array, "rows p"]  # how many places the component has
    first_slots: Int[Array, "rows p"]  # counted from the first slot of the row


class AsTheyStand(NamedTuple):
    """The particles as they stand, in a row for each component, where only its own have a weight.

    A row has p places, as many as make whole blocks for the prefix sums.
    """

    weights: Float[Array, "m p"]  # within the component, zero at another's place and an empty one
    counts: Int[Array, " m"]

    def of_places(self, values: Shaped[Array, " m"]) -> Shaped[Array, "m 1"]:
        """For each row the value of its component."""
        return values[:, None]

    def sums(self, values: Float[Array, "m p"]) -> Float[Array, " m"]:
        """The sum over each component's places."""
        return jnp.sum(values, axis=1)

    def first_slots(self, slots: Slots) -> Int[Array, "m 1"]:
        """Where the slots of each row begin."""
        return slots.firsts[:, None]

    def num_slots(self, targets: Int[Array, " m"], num_particles: int) -> Int[Array, "m 1"]:
        """How many slots each row has."""
        del num_particles
        return targets[:, None]

    def places_of(self, parents: Int[Array, " n"], slots: Slots) -> Int[Array, " n"]:
        """The place in its row of each slot's parent, counted over all rows."""
        return parents - self.weights.shape[1] * slots.components

    def stretches(self, slots: Slots) -> "Stretches":
        """Each row is the stretch of its component."""
        del slots
        zeros = jnp.zeros(self.weights.shape, jnp.int32)
        return Stretches(zeros, zeros + self.weights.shape[1], zeros)

    def places_by_rank(self, ranks: Int[Array, " n"], slots: Slots) -> Int[Array, " n"]:
        """The place of a rank in each slot's component, which is the only one."""
        del slots
        return ranks

    def particles_at(self, places: Int[Array, " n"]) -> Int[Array, " n"]:
        """Which particles stand at these places."""
        return places


class SideBySide(NamedTuple):
    """The particles in one row of p places, component by component, and empty places at the end."""

    weights: Float[Array, "1 p"]  # within the component, zero at an empty place
    counts: Int[Array, " m"]
    firsts: Int[Array, " m"]  # the place of each component's first particle
    order: Int[Array, " p"]  # which particle stands at each place
    components: Int[Array, " p"]

    def of_places(self, values: Shaped[Array, " m"]) -> Shaped[Array, "1 p"]:
        """At each place the value of its component."""
        return spread(values, self.components)[None]

    def sums(self, values: Float[Array, "1 p"]) -> Float[Array, " m"]:
        """The sum over each component's places."""
        return segment_sum(values[0], self.components, self.counts.shape[0])

    def first_slots(self, slots: Slots) -> Int[Array, "1 1"]:
        """Where the slots of the row begin."""
        del slots
        return jnp.zeros((1, 1), jnp.int32)

    def num_slots(self, targets: Int[Array, " m"], num_particles: int) -> Int[Array, "1 1"]:
        """How many slots the row has."""
        del targets
        return jnp.full((1, 1), num_particles, jnp.int32)

    def places_of(self, parents: Int[Array, " n"], slots: Slots) -> Int[Array, " n"]:
        """The place of each slot's parent; rounding must not cross a border of components."""
        firsts = spread(self.firsts, slots.components)
        return jnp.clip(parents, firsts, firsts + spread(self.counts, slots.components) - 1)

    def stretches(self, slots: Slots) -> "Stretches":
        """The components' particles and slots, side by side."""
        of_places = lambda values: spread(values, self.components)[None]  # noqa: E731
        return Stretches(of_places(self.firsts), of_places(self.counts), of_places(slots.firsts))

    def places_by_rank(self, ranks: Int[Array, " n"], slots: Slots) -> Int[Array, " n"]:
        """The place of a rank in each slot's component."""
        return spread(self.firsts, slots.components) + ranks

    def particles_at(self, places: Int[Array, " n"]) -> Int[Array, " n"]:
        """Which particles stand at these places."""
        return take(self.order, stored(places, self.order.shape[0]))


def as_they_are(mixture: ParticleMixture) -> AsTheyStand:
    """A row for each component, of all the particles."""
    m = mixture.num_components
    is_member = mixture.component_indicators[None] == jnp.arange(m, dtype=jnp.int32)[:, None]
    weights = mixture.component_weights[None]
    if m > 1:
        weights = jnp.where(is_member, weights, 0.0)
    return AsTheyStand(jax.vmap(lambda row: padded(row, 0.0))(weights), mixture.component_counts)


def side_by_side(
    mixture: ParticleMixture,
    stays: Bool[Array, " n"] | None,
    sort_by: SortBy | None,
) -> SideBySide:
    """One row of components, without particles that only a rounding error could draw.

    A weight may underflow to zero where its logarithm does not. Such a particle is left out of
    the row where its component is resampled, and kept where its component `stays` as it is.
    """
    m = mixture.num_components
    weights = mixture.component_weights
    stands = weights > 0
    if stays is not None:
        stands |= mixture.occupied & stays
    labels = jnp.where(stands, mixture.component_indicators, m)
    if sort_by is None:
        order, counts = order_by_segment(padded(labels, m), m)
    else:
        order = padded(standing_order(mixture, labels, sort_by), mixture.num_particles - 1)
        counts = segment_counts(stands, mixture.component_indicators, m)
    num_standing = jnp.sum(counts, dtype=jnp.int32)
    is_filled = jnp.arange(order.shape[0], dtype=jnp.int32) < num_standing
    weights = jnp.where(is_filled, take(padded(weights, 0.0), order), 0.0)
    components = take(padded(mixture.component_indicators, 0), order)
    return SideBySide(weights[None], counts, jnp.cumsum(counts) - counts, order, components)


def padded(values: Array, fill: float) -> Array:
    """The values, filled up to whole blocks of the prefix sums."""
    n = values.shape[0]
    return jnp.pad(values, (0, whole_blocks(n) - n), constant_values=fill)
