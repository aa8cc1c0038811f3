"""Resampling within components: systematic, stratified, multinomial or residual."""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key, PyTree, Shaped

from mpfjax.checks import (
    check_callable,
    check_one_of,
    check_positive,
    check_share,
    check_whole,
    given,
)
from mpfjax.mixture import ParticleMixture
from mpfjax.moves.base import AbstractRejuvenation
from mpfjax.moves.slots import (
    Slots,
    deal_slots,
    place_slots,
)
from mpfjax.moves.transport import require_ott, transport
from mpfjax.operations.generator import uniform
from mpfjax.operations.gradients import add_gradient
from mpfjax.operations.indexing import take
from mpfjax.operations.prefix_sums import count_starts, sum_before
from mpfjax.operations.segments import (
    order_by_segment,
    segment_counts,
    segment_log_sum_exp,
    segment_sum,
    spread,
)
from mpfjax.operations.stored import stored, to_int, whole_blocks

# Up to so many components are resampled as they stand, each in a pass of its own.
FEW_ROWS = 4
GRADIENTS = ("none", "stop", "soft", "ot", "straight_through")


class Resample(AbstractRejuvenation):
    """Draw each component's particles anew in proportion to their weights w_i.

    Components are resampled independently of each other, which keeps the support of every mode
    (Vermaak et al. 2003, section 3). A component keeps its mass, and its new particles share it
    equally. The expected number of offspring of particle i is k_m w_i for every scheme, so the
    marginal likelihood stays unbiased.

    - `scheme`: "systematic" (the default: least noise, O(n)), "stratified", "multinomial" (the
      textbook's, most noise) or "residual".
    - `ess_threshold`: a component is resampled where its effective sample size is below this
      share of its particles; 1.0 resamples at every step. Under `vmap` an adaptive threshold
      saves noise, not time.
    - `particles_per_component`: None deals the slots equally to the living components that are
      resampled; a number k gives each living component k particles and leaves the rest of the
      slots empty, the paper's habit in section 5.2.
    - `sort_by`: maps the particles to a number each, (n,), by which they stand in line within
      their component. Systematic and stratified resampling of a sorted line change the
      distribution least (Kitagawa 1996), and neighbours in line are neighbours in space when
      `stratified_normal` spreads their noise, the array form of randomised quasi-Monte Carlo
      (L'Ecuyer, Lécot and Tuffin 2008). Worth its sort where masses or likelihoods must be exact:
      it cut the error of the modes' mass on the quadratic model by four or five.
    - `gradient`: what a derivative of the filter sees of the resampling, one of
        - "none": nothing. The indices that were drawn are taken for constants, and the derivative
          of the log marginal likelihood is NOT an estimate of the score: its bias does not go
          away with more particles, and may have the wrong sign.
        - "stop": new weights w_a / ⊥w_a times the old share, ⊥ being `stop_gradient` (Ścibior and
          Wood 2021, DPF-SGR). Values are the same to the bit; derivatives of Ẑ are unbiased.
          `Propagate` and `Partitioned` have it as well, for parameters of the dynamics.
        - "soft": draws from q = (1 - s) w + s / k and weighs by w / q, s the `softness` (Karkus,
          Hsu and Lee 2018). Noisier weights, and still biased: what is left out grows as s falls.
        - "ot": no draws: particles move to the barycentres of an entropy-regularised transport
          plan from the weights to equal ones (Corenflos et al. 2021), by ott-jax, the extra `ot`.
          Differentiable throughout, O(n²), and biased in value and gradient by the entropy.
        - "straight_through": resampling in value; the derivative is that of particles moved by
          Σ_j w_j ⊥x_j, as if every offspring were the component's mean (Bengio et al. 2013).
          Biased, and it may grow exponentially with t, as on the quadratic model.
      The masses of components carry their derivative in all of them. Component indicators are
      whole numbers and have none: what a parameter does to the grouping is not seen, which is
      no error, since regrouping does not change the distribution.
    - `softness`: s, in (0, 1]. `regularisation`: ε of the transport, positive, in units of the
      mean squared spread of a component's particles, as Corenflos et al. scale it.

    "soft" and "ot" are approximate: Ẑ is biased. Raises `ValueError` for an unknown scheme or
    gradient, a threshold outside [0, 1], k < 1, and s or ε out of range; `ImportError` for "ot"
    without ott-jax.
    """

    scheme: str = eqx.field(static=True, default="systematic")
    ess_threshold: float = eqx.field(static=True, default=1.0)
    particles_per_component: int | None = eqx.field(static=True, default=None)
    sort_by: Callable[[PyTree], Float[Array, " n"]] | None = eqx.field(static=True, default=None)
    gradient: str = eqx.field(static=True, default="none")
    softness: float = eqx.field(static=True, default=0.5)
    regularisation: float = eqx.field(static=True, default=0.5)

    def __check_init__(self) -> None:
        check_one_of(SCHEMES, scheme=self.scheme)
        check_share(ess_threshold=self.ess_threshold)
        check_whole(**given(particles_per_component=self.particles_per_component))
        check_callable("a function of the particles", **given(sort_by=self.sort_by))
        check_one_of(GRADIENTS, gradient=self.gradient)
        check_positive(softness=self.softness, regularisation=self.regularisation)
        check_share(softness=self.softness)
        if self.gradient == "ot":
            require_ott()

    @property
    def approximate(self) -> bool:
        """Whether the weights are normalised after soft draws, or the particles transported."""
        return self.gradient in ("soft", "ot")

    def is_due(self, mixture: ParticleMixture) -> Bool[Array, " m"]:
        """Which components of `mixture` the move would resample."""
        if self.ess_threshold == 1.0:
            return mixture.active
        counts = mixture.component_counts
        limit = self.ess_threshold * counts.astype(mixture.log_weights.dtype)
        due = mixture.component_effective_sample_sizes < limit
        if self.particles_per_component is not None:
            due = due | (counts != self.particles_per_component)
        return due & (counts > 0)

    def __call__(
        self, key: Key[Array, ""], mixture: ParticleMixture, observation: PyTree = None
    ) -> ParticleMixture:
        """Resample every component that is due."""
        due = self.is_due(mixture)
        drawn_from = self._drawn_from(mixture)
        # Who is drawn is a whole number, through which no derivative passes.
        drawn = self._draw(key, jax.lax.stop_gradient(drawn_from), due)
        slots = drawn.slots
        copies = _copies(mixture, drawn)
        num_slots = jnp.maximum(drawn.targets, 1).astype(mixture.log_weights.dtype)
        log_shares = mixture.log_mixture_weights - jnp.log(num_slots)
        redrawn = copies.replace(log_weights=spread(log_shares, slots.components))
        if self.gradient == "stop":
            log_weights = jax.lax.stop_gradient(redrawn.log_weights)
            redrawn = redrawn.replace(log_weights=add_gradient(log_weights, copies.log_weights))
        elif self.gradient == "soft":
            redrawn = _importance_weighted(redrawn, mixture, drawn_from, drawn)
        elif self.gradient == "straight_through":
            redrawn = _following_the_mean(redrawn, mixture)
        elif self.gradient == "ot":
            redrawn = self._transported(redrawn, mixture, drawn)
        if self.ess_threshold < 1.0:
            redrawn = _where(spread(due, slots.components), redrawn, copies)
        return redrawn.replace(log_weights=jnp.where(slots.filled, redrawn.log_weights, -jnp.inf))

    def _draw(
        self, key: Key[Array, ""], mixture: ParticleMixture, due: Bool[Array, " m"]
    ) -> "_Drawn":
        """Each slot's parent: drawn by weight where its component is due, itself elsewhere."""
        num_particles, num_components = mixture.num_particles, mixture.num_components
        # A component that keeps its particles needs them side by side, unless it has all slots.
        all_are_due = self.ess_threshold == 1.0
        as_they_stand = num_components == 1 or (num_components <= FEW_ROWS and all_are_due)
        as_they_stand &= self.sort_by is None
        as_they_stand &= self.gradient != "ot"  # which needs places without gaps
        line = _as_they_stand(mixture) if as_they_stand else self._side_by_side(mixture, due)
        # Where all that live are due, none keeps what it has.
        counts = due.astype(jnp.int32) if all_are_due else line.counts
        targets = deal_slots(counts, due, mixture, self.particles_per_component)
        if as_they_stand and num_components == 1:
            # What is not redrawn keeps its place, and there may be empty slots before it.
            targets = jnp.where(due, targets, num_particles)
        slots = place_slots(targets, num_particles)
        expected = line.weights * line.of_places(targets).astype(line.weights.dtype)
        before, total = jax.vmap(sum_before)(expected)
        starts = SCHEMES[self.scheme](key, expected, before, targets, slots, line)
        # Rounding must not leave a slot to those that stand past all weight.
        num_slots = line.num_slots(targets, num_particles)
        starts = jnp.minimum(starts, num_slots)
        starts = jnp.where(before < total[:, None], starts, num_slots) + line.first_slots(slots)
        parents = line.places_of(count_starts(starts, num_particles), slots)
        if not all_are_due:
            unmoved = line.places_by_rank(slots.ranks, slots)
            parents = jnp.where(spread(due, slots.components), parents, unmoved)
        parents = line.particles_at(jnp.clip(parents, 0, num_particles - 1))
        return _Drawn(parents, slots, targets, line)

    def _side_by_side(self, mixture: ParticleMixture, due: Bool[Array, " m"]) -> "_SideBySide":
        """One row of components, without particles that only a rounding error could draw.

        A weight may underflow to zero where its logarithm does not. Such a particle is left out of
        the row of a component that is resampled, and kept with one that is not.
        """
        m = mixture.num_components
        weights = mixture.component_weights
        stands = weights > 0
        if self.ess_threshold < 1.0:
            stands |= mixture.occupied & ~spread(due, mixture.component_indicators)
        labels = jnp.where(stands, mixture.component_indicators, m)
        if self.sort_by is None:
            order, counts = order_by_segment(_padded(labels, m), m)
        else:
            order = jnp.lexsort((self.sort_by(mixture.particles), labels)).astype(jnp.int32)
            order = _padded(order, mixture.num_particles - 1)
            counts = segment_counts(stands, mixture.component_indicators, m)
        num_standing = jnp.sum(counts, dtype=jnp.int32)
        is_filled = jnp.arange(order.shape[0], dtype=jnp.int32) < num_standing
        weights = jnp.where(is_filled, take(_padded(weights, 0.0), order), 0.0)
        components = take(_padded(mixture.component_indicators, 0), order)
        return _SideBySide(weights[None], counts, jnp.cumsum(counts) - counts, order, components)

    def _drawn_from(self, mixture: ParticleMixture) -> ParticleMixture:
        """The mixture whose weights the offspring are drawn in proportion to."""
        if self.gradient != "soft":
            return mixture
        counts = jnp.maximum(mixture.component_counts, 1).astype(mixture.log_weights.dtype)
        uniform = self.softness / spread(counts, mixture.component_indicators)
        softened = (1 - self.softness) * mixture.component_weights + uniform
        log_mass = spread(mixture.log_mixture_weights, mixture.component_indicators)
        occupied = mixture.occupied
        log_weights = jnp.log(softened) + jnp.where(occupied, log_mass, 0.0)
        return mixture.replace(log_weights=jnp.where(occupied, log_weights, -jnp.inf))

    def _transported(
        self, redrawn: ParticleMixture, mixture: ParticleMixture, drawn: "_Drawn"
    ) -> ParticleMixture:
        """The particles at the barycentres of the plan from the weights to equal ones."""
        slots, line = drawn.slots, drawn.line
        # Where a component changes its number of slots, its particles repeat or are skipped.
        counts, shares = line.counts, jnp.maximum(drawn.targets, 1)
        stretched = slots.ranks * spread(counts, slots.components)
        stretched //= spread(shares, slots.components)
        places = jnp.clip(line.places_by_rank(stretched, slots), 0, len(stretched) - 1)
        particles, nearest = transport(
            mixture,
            line.particles_at(places),
            slots.components,
            slots.filled,
            self.regularisation,
        )
        return redrawn.replace(
            particles=particles, ancestor_indices=take(mixture.ancestor_indices, nearest)
        )


class _Drawn(NamedTuple):
    """Who stands where after resampling."""

    parents: Int[Array, " n"]
    slots: Slots
    targets: Int[Array, " m"]  # how many slots each component has
    line: "_AsTheyStand | _SideBySide"


def _copies(mixture: ParticleMixture, drawn: _Drawn) -> ParticleMixture:
    """Every slot's parent as it was, with its weight."""
    is_one = mixture.num_components == 1
    return mixture.replace(
        particles=jax.tree.map(lambda leaf: take(leaf, drawn.parents), mixture.particles),
        log_weights=take(mixture.log_weights, drawn.parents),
        component_indicators=mixture.component_indicators if is_one else drawn.slots.components,
        ancestor_indices=take(mixture.ancestor_indices, drawn.parents),
    )


def _importance_weighted(
    redrawn: ParticleMixture,
    mixture: ParticleMixture,
    drawn_from: ParticleMixture,
    drawn: _Drawn,
) -> ParticleMixture:
    """Weights in proportion to w / q within each component, whose mass stays."""
    slots = drawn.slots
    log_ratios = mixture.log_component_weights - drawn_from.log_component_weights
    log_ratios = jnp.where(mixture.occupied, log_ratios, 0.0)
    log_ratios = jnp.where(slots.filled, take(log_ratios, drawn.parents), -jnp.inf)
    log_totals = segment_log_sum_exp(log_ratios, slots.components, mixture.num_components)
    log_mass = jnp.where(mixture.active, mixture.log_mixture_weights - log_totals, -jnp.inf)
    return redrawn.replace(log_weights=log_ratios + spread(log_mass, slots.components))


def _following_the_mean(redrawn: ParticleMixture, mixture: ParticleMixture) -> ParticleMixture:
    """The same particles, whose derivatives are also those of the component's mean by weight."""

    def follow(leaf: Array, drawn: Array) -> Array:
        if not jnp.issubdtype(leaf.dtype, jnp.floating):
            return drawn
        means = mixture.component_averages(jax.lax.stop_gradient(leaf))
        return add_gradient(drawn, spread(means, redrawn.component_indicators))

    return redrawn.replace(particles=jax.tree.map(follow, mixture.particles, redrawn.particles))


def _where(
    is_redrawn: Bool[Array, " n"], redrawn: ParticleMixture, copies: ParticleMixture
) -> ParticleMixture:
    """What was redrawn, and of the components that were not due the particles as they were."""

    def pick(new: Array, old: Array) -> Array:
        return jnp.where(is_redrawn.reshape(-1, *[1] * (new.ndim - 1)), new, old)

    if redrawn.particles is not copies.particles:
        redrawn = redrawn.replace(
            particles=jax.tree.map(pick, redrawn.particles, copies.particles),
            ancestor_indices=pick(redrawn.ancestor_indices, copies.ancestor_indices),
        )
    return redrawn.replace(log_weights=pick(redrawn.log_weights, copies.log_weights))


class _AsTheyStand(NamedTuple):
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

    def places_by_rank(self, ranks: Int[Array, " n"], slots: Slots) -> Int[Array, " n"]:
        """The place of a rank in each slot's component, which is the only one."""
        del slots
        return ranks

    def particles_at(self, places: Int[Array, " n"]) -> Int[Array, " n"]:
        """Which particles stand at these places."""
        return places


class _SideBySide(NamedTuple):
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

    def places_by_rank(self, ranks: Int[Array, " n"], slots: Slots) -> Int[Array, " n"]:
        """The place of a rank in each slot's component."""
        return spread(self.firsts, slots.components) + ranks

    def particles_at(self, places: Int[Array, " n"]) -> Int[Array, " n"]:
        """Which particles stand at these places."""
        return take(self.order, stored(places, self.order.shape[0]))


def _as_they_stand(mixture: ParticleMixture) -> _AsTheyStand:
    m = mixture.num_components
    is_member = mixture.component_indicators[None] == jnp.arange(m, dtype=jnp.int32)[:, None]
    weights = mixture.component_weights[None]
    if m > 1:
        weights = jnp.where(is_member, weights, 0.0)
    padded = jax.vmap(lambda row: _padded(row, 0.0))(weights)
    return _AsTheyStand(padded, mixture.component_counts)


def _padded(values: Array, fill: float) -> Array:
    n = values.shape[0]
    return jnp.pad(values, (0, whole_blocks(n) - n), constant_values=fill)


# A scheme gives the first slot of every particle's offspring, counted from the first slot of its
# row. It sees the expected offspring k_m w_i laid end to end in each row, and where each particle's
# stretch begins there, and places one point in each slot's share.


def _systematic(key, expected, before, targets, slots, line):
    shift = stored(uniform(key, targets.shape, expected.dtype))
    return _points_before(before, line.of_places(shift))


def _stratified(key, expected, before, targets, slots, line):
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


def _multinomial(key, expected, before, targets, slots, line):
    points = _sorted_points(key, slots, targets, expected.dtype)
    return _sorted_points_before(before, points, line.first_slots(slots))


def _residual(key, expected, before, targets, slots, line):
    # A weight of 1 / k comes out as a hair less in floating point, and is meant to be certain.
    whole = jnp.floor(expected * (1 + 16 * jnp.finfo(expected.dtype).eps))
    certain, _ = jax.vmap(sum_before)(whole)
    left = jnp.maximum(targets - line.sums(whole).astype(jnp.int32), 0)
    rest = place_slots(left, slots.components.shape[0])
    points = _sorted_points(key, rest, left, expected.dtype)
    rests_before, _ = jax.vmap(sum_before)(jnp.maximum(expected - whole, 0.0))
    drawn = _sorted_points_before(rests_before, points, line.first_slots(rest))
    return certain.astype(jnp.int32) + drawn


def _sorted_points_before(
    before: Float[Array, "rows p"], points: Float[Array, " n"], first_slots: Int[Array, "rows 1"]
) -> Int[Array, "rows p"]:
    """How many of the points of its row come before a particle's stretch."""
    found = jnp.searchsorted(points, before + first_slots.astype(before.dtype), side="left")
    return found.astype(jnp.int32) - first_slots


def _sorted_points(
    key: Key[Array, ""], slots: Slots, targets: Int[Array, " m"], dtype: jnp.dtype
) -> Float[Array, " n"]:
    """Independent uniform points on each component's stretch of slots, in ascending order."""
    shares = uniform(key, slots.components.shape, dtype)
    firsts = spread(slots.firsts, slots.components).astype(dtype)
    lengths = spread(targets, slots.components).astype(dtype)
    # Rounding must not take the last of them for the first of the next component.
    before_end = jnp.nextafter(firsts + lengths, jnp.zeros_like(firsts))
    points = jnp.minimum(firsts + lengths * shares, before_end)
    return jnp.sort(jnp.where(slots.filled, points, jnp.inf))


SCHEMES: dict[str, Callable[..., Int[Array, " n"]]] = {
    "systematic": _systematic,
    "stratified": _stratified,
    "multinomial": _multinomial,
    "residual": _residual,
}
