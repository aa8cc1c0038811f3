"""The order of the particles for resampling, component by component.

The particles are arranged on a line, each with an interval as long as its expected number of
offspring. Every slot has a point on the line, and its parent is the particle whose interval
contains the point. The particles of a component must be neighbours. After resampling they are, and
until they are regrouped nothing has to be sorted. Within a component their order is arbitrary, or
sorted along a Hilbert curve of their state.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Shaped, UInt32

from mpfjax.mixture import ParticleMixture, points
from mpfjax.moves.resampling.sorting import (
    BITS,
    MOST_DIMENSIONS,
    hilbert_index,
    order_by_key,
    order_by_segment,
    sortable_bits,
)
from mpfjax.operations.logarithms import exp, finite_or_zero, log_or_nothing, softmax
from mpfjax.operations.prefix_sums import Positions, needs_units, sum_before, to_units, unit_bits
from mpfjax.operations.segments import column_sums, segment_counts, segment_reduce, spread
from mpfjax.operations.stored import cond_if_any, stored, take, whole

_NUM_PRINCIPAL = 3  # more bits of fewer coordinates order a few hundred particles better
_STEEPNESS = 1.702  # the logistic function of this multiple is nearly the normal CDF


class Line(NamedTuple):
    """The particles in a line of p places, those of a component side by side.

    p is a multiple of the block length of the prefix sums. The particles of a single component
    that nothing sorts stand where they are: `order` and `labels` are then None.
    """

    num_particles: int
    weights: Float[Array, " p"]  # in a unit of the component's own, zero at an empty place
    totals: Float[Array, " m"]  # of the weights, zero for a dead component
    log_units: Float[Array, " m"]
    is_drawn: Bool[Array, " p"]  # at which places a particle may be drawn, or stays as it is
    order: Int[Array, " p"] | None  # which particle stands at each place
    labels: Int[Array, " p"] | None  # the component of each place, M where it is empty

    @property
    def components(self) -> Int[Array, " p"]:
        """The component of each place, any where it is empty."""
        assert self.labels is not None
        return jnp.minimum(self.labels, self.totals.shape[0] - 1)

    @property
    def counts(self) -> Int[Array, " m"]:
        """How many places each component has."""
        if self.labels is None:
            return jnp.full(1, self.num_particles, jnp.int32)
        return segment_counts(self.is_drawn, self.components, self.totals.shape[0])

    @property
    def log_masses(self) -> Float[Array, " m"]:
        """The logarithm of each component's mass."""
        return log_or_nothing(self.totals) + self.log_units

    @property
    def effective_sample_sizes(self) -> Float[Array, " m"]:
        """(Σ w)² / Σ w² of each component, zero for a dead one."""
        squares = self.sums(self.weights**2)
        return self.totals**2 / jnp.where(squares > 0, squares, 1.0)

    def sums(self, values: Float[Array, " p"]) -> Float[Array, " m"]:
        """The sum over each component's places."""
        if self.labels is None:
            return jnp.sum(values, keepdims=True)
        return segment_reduce("add", values, self.labels, self.totals.shape[0])

    def of_places(self, values: Shaped[Array, " m"]) -> Shaped[Array, " #p"]:
        """The value of the component at each place."""
        return values if self.labels is None else spread(values, self.components)

    def place_of(self, particle: Int[Array, ""]) -> tuple[Int[Array, ""], Int[Array, ""]]:
        """The place of a particle, and its component."""
        if self.order is None:
            return particle, jnp.zeros((), jnp.int32)
        place = jnp.argmax(self.order == particle).astype(jnp.int32)
        return place, self.components[place]

    def extents(self, drawn: bool) -> tuple[Int[Array, " m"], Int[Array, " m"]]:
        """The first and the last place of each component: of those `drawn` from, or of all."""
        last = self.weights.shape[0] - 1
        if self.labels is None:
            return jnp.zeros(1, jnp.int32), jnp.full(1, last, jnp.int32)
        places = jnp.arange(last + 1, dtype=jnp.int32)
        # The last place is the least of the negative ones: one minimum finds both.
        signed = jnp.stack([places, -places])
        signed = jnp.where(self.is_drawn, signed, last) if drawn else signed
        num = self.totals.shape[0]
        least = partial(segment_reduce, "min", segments=self.labels, num_segments=num, nothing=last)
        firsts, lasts = stored(jax.vmap(least)(signed))
        return firsts, jnp.maximum(-lasts, 0)

    def positions(
        self,
        values: Float[Array, " p"],
        lengths: Int[Array, " m"],
        first_slots: Int[Array, " m"],
        num_slots: int,
    ) -> tuple[Positions, Bool[Array, " p"]]:
        """The start of each interval, in slots, and which of them are not after the last slot.

        The values are the lengths of the intervals; they sum to each component's length up to
        rounding.
        """
        num_places, dtype = values.shape[0], values.dtype
        if needs_units(num_places, dtype):
            num_bits = unit_bits(max(num_places, num_slots))
            units = to_units(values, num_bits)
            upto = jnp.cumsum(units, dtype=jnp.int32)
            # From each component's own first slot, without the rounding errors of others.
            before = upto - units
            within = before - self.of_places(take(before, self.extents(drawn=False)[0]))
            within = jnp.minimum(within, self.of_places(lengths << num_bits))
            places = within + self.of_places(first_slots << num_bits)
            fraction = (places & ((1 << num_bits) - 1)).astype(dtype) * 2.0**-num_bits
            return Positions(places >> num_bits, fraction), before < upto[-1]
        before, total = sum_before(values)
        whole_parts = jnp.floor(before)
        positions = Positions(whole_parts.astype(jnp.int32), before - whole_parts)
        return positions, before < total


def in_line(mixture: ParticleMixture, stays: Bool[Array, " n"] | None, along_curve: bool) -> Line:
    """The particles in line, within each component along a Hilbert curve or as they are.

    A weight may underflow to zero where its logarithm does not. Such a particle is not drawn where
    its component is resampled, and has a place among its component's where it `stays` as it is.
    """
    n, m = mixture.num_particles, mixture.num_components
    if m == 1 and not along_curve:
        weights = whole(mixture.component_weights, 0.0)
        log_masses = mixture.log_mixture_weights
        one = jnp.ones(1, weights.dtype)
        return Line(n, weights, one, log_masses, weights > 0, order=None, labels=None)
    labels = mixture.component_indicators
    if stays is not None or along_curve:
        # Particles that stay by rank need their component's as neighbours.
        stands = mixture.component_weights > 0
        if stays is not None:
            stands |= mixture.occupied & stays
        labels = jnp.where(stands, labels, m)
    log_weights, labels = whole(mixture.log_weights, -jnp.inf), whole(labels, m)

    def in_order(order: Int[Array, " p"]) -> tuple[Array, Array, Array]:
        in_turn = take(labels, order)
        # Labels without particles come last.
        return order, jnp.where(in_turn < m, take(log_weights, order), -jnp.inf), in_turn

    if along_curve:
        order = sorted_order(mixture, labels[:n])
        order, log_weights, labels = in_order(whole(order, labels.shape[0] - 1))
    else:
        is_mixed = jnp.any(labels[1:] < labels[:-1])
        order, log_weights, labels = cond_if_any(
            is_mixed,
            lambda: in_order(order_by_segment(labels, m)),
            lambda: (jnp.arange(labels.shape[0], dtype=jnp.int32), log_weights, labels),
        )
    log_largest = finite_or_zero(segment_reduce("max", log_weights, labels, m, -jnp.inf))
    relative = exp(log_weights - spread(log_largest, jnp.minimum(labels, m - 1)))
    is_drawn = relative > 0
    if stays is not None:
        is_drawn |= (log_weights > -jnp.inf) & take(whole(stays, False), order)
    totals = segment_reduce("add", relative, labels, m)
    return Line(n, relative, totals, log_largest, is_drawn, order, labels)


def sorted_order(mixture: ParticleMixture, labels: Int[Array, " n"]) -> Int[Array, " n"]:
    """The indices of the particles by label, in [0, M], and in each along a Hilbert curve.

    A single coordinate is sorted by its value. Several are standardised by the mean and deviation
    of the particle's component. More than 8 are reduced to their first principal components.
    """
    rows = _coordinates(mixture)
    if rows.shape[0] > MOST_DIMENSIONS:
        rows = _principal(rows, mixture)
    if rows.shape[0] == 1:
        keys = sortable_bits(rows[0])
    else:
        num_bits = BITS // rows.shape[0]
        keys = hilbert_index(_cells(rows, mixture, num_bits), num_bits)
    return order_by_key(keys, labels, mixture.num_components + 1)


def _coordinates(mixture: ParticleMixture) -> Float[Array, "d n"]:
    """The floating point numbers of the states, a row for each."""
    leaves = [
        leaf.reshape(mixture.num_particles, -1)
        for leaf in jax.tree.leaves(points(mixture.particles))
        if jnp.issubdtype(leaf.dtype, jnp.floating)
    ]
    if sum(leaf.shape[1] for leaf in leaves) == 0:
        which = "sorts by the state's floating point numbers, and it has none"
        raise ValueError(f"along_curve: true, as with noise='rqmc', {which}")
    dtype = jnp.result_type(*leaves)
    return jnp.concatenate([leaf.astype(dtype).T for leaf in leaves])


def _principal(rows: Float[Array, "d n"], mixture: ParticleMixture) -> Float[Array, "k n"]:
    """The first principal components of all particles, with each coordinate standardised."""
    rows = jax.lax.stop_gradient(jnp.where(mixture.occupied[None], rows, 0.0))
    weights = softmax(mixture.log_weights).astype(rows.dtype)[None]
    centred = rows - jnp.sum(weights * rows, axis=1, keepdims=True)
    variances = jnp.sum(weights * centred**2, axis=1, keepdims=True)
    standardised = centred / jnp.sqrt(jnp.where(variances > 0, variances, 1.0))
    correlations = jnp.matmul(weights * standardised, standardised.T, precision="highest")
    axes = jnp.linalg.eigh(jnp.nan_to_num(correlations))[1][:, -_NUM_PRINCIPAL:]
    return jnp.matmul(axes.T, standardised, precision="highest")


def _cells(
    rows: Float[Array, "d n"], mixture: ParticleMixture, num_bits: int
) -> UInt32[Array, "d n"]:
    """The cell of each coordinate, of 2^num_bits cells that hold about equally many particles."""
    labels, m = mixture.component_indicators, mixture.num_components
    rows = jnp.where(mixture.occupied[None], rows, 0.0)
    weights = mixture.component_weights.astype(rows.dtype)

    def averages(rows: Float[Array, "d n"]) -> Float[Array, "m d"]:
        return column_sums(weights[None] * rows, labels, m)

    def of_particles(values: Float[Array, "m d"]) -> Float[Array, "d n"]:
        columns = [spread(column, labels) for column in jnp.nan_to_num(values).T]
        # The result of a gather is stored: operations fused with it would not be vectorised.
        return stored(jnp.stack(columns))

    centred = rows - of_particles(averages(rows))
    variances = averages(centred**2)
    # Particles at a single point are all in the same cell.
    is_spread = (variances > 0) & (variances < jnp.inf)
    scales = of_particles(jnp.where(is_spread, _STEEPNESS / jnp.sqrt(variances), 1.0))
    shares = jax.nn.sigmoid(centred * scales)
    size = float(1 << num_bits)
    return jnp.clip(jnp.nan_to_num(shares) * size, 0.0, size - 1).astype(jnp.uint32)
