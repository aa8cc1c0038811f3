"""Resampling within components: systematic, stratified, multinomial, residual or SSP."""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from mpfjax.checks import (
    check_callable,
    check_numbered,
    check_one_of,
    check_positive,
    check_share,
    check_whole,
    given,
)
from mpfjax.mixture import ParticleMixture
from mpfjax.moves.base import AbstractAdaptiveResampling
from mpfjax.moves.eve_indices import with_offspring
from mpfjax.moves.resampling.allocation import (
    Slots,
    allocate_slots,
    demands_by_variance,
    place_slots,
)
from mpfjax.moves.resampling.layout import InPlace, SideBySide, as_they_are, side_by_side
from mpfjax.moves.resampling.optimal_transport import require_ott, transport
from mpfjax.moves.resampling.ordering import SortBy, check_sort_by
from mpfjax.moves.resampling.schemes import SCHEMES
from mpfjax.operations.gradients import add_gradient
from mpfjax.operations.indexing import take
from mpfjax.operations.prefix_sums import count_starts
from mpfjax.operations.segments import segment_log_sum_exp, spread
from mpfjax.operations.stored import stored

ALLOCATIONS = ("variance", "equal")
GRADIENTS = ("none", "stop", "soft", "ot", "straight_through")


class Resample(AbstractAdaptiveResampling):
    """Draw each component's particles anew in proportion to their weights w_i.

    Components are resampled independently of each other, which keeps the support of every mode
    (Vermaak et al. 2003, section 3). A component keeps its mass, and its new particles share it
    equally. The expected number of offspring of particle i is k_m w_i for every scheme, so the
    marginal likelihood stays unbiased.

    - `scheme`: "systematic" (the default: least noise, O(n)), "stratified", "multinomial" (the
      textbook's, most noise), "residual" or "ssp" (Gerber, Chopin and Whiteley 2019: as even as
      systematic, and consistent in whatever order the particles stand; ten times slower than
      it, and several times faster than "multinomial").
    - `ess_threshold`: a component is resampled if its effective sample size is below this share of
      its particles. 1.0 resamples at every step. Under `vmap`, a lower threshold reduces the noise
      but not the time.
    - `particles_per_component`: None shares all slots among the living components that are
      resampled, as `allocation` says. A number k gives each living component k particles and
      leaves the other slots empty, as section 5.2 of the paper does.
    - `allocation`: how the components share the slots, where neither `particles_per_component` nor
      `share_by` says it. "variance" deals component m a number in proportion to
      (k_m Σ_{c_i = m} exp 2ℓ_i)^(1/2) = π_m (k_m / ESS_m)^(1/2), which leaves Ẑ the least variance
      (Neyman 1934), and shares a quarter to a half equally, so that every mode stays alive. Its
      masses are as exact as the plain filter's, or more so, and log Ẑ is in most scenes;
      docs/masses.md has the reasons. "equal" is the paper's: it keeps modes of little mass
      longest, and log Ẑ is less exact.
    - `share_by`: a function that gives each particle the whole number of its group, the same within
      a component. Groups with a component that is resampled share the slots equally, and so do the
      components within a group. None makes no groups. Use it where components are rival hypotheses
      about several objects, so that an object with many does not take the slots of the others.
    - `sort_by`: a function that gives each particle a number, (n,), or several, (n, d). Within
      their component the particles are resampled in the order of these numbers. Several numbers,
      up to 8, are standardised within the component, and the order is that along a Hilbert curve
      through them. "hilbert" takes all floating point numbers of the state. Systematic and
      stratified resampling in a good order change the distribution least (Kitagawa 1996). With
      the "rqmc" noise of `Propagate`, it is array randomised quasi-Monte Carlo (L'Ecuyer, Lécot
      and Tuffin 2008; Gerber and Chopin 2015). Use it where masses or likelihoods must be
      accurate and a sort is worth its time: on the quadratic model it made the error of the
      modes' masses four or five times smaller.
    - `gradient`: what a derivative of the filter sees of the resampling, one of
        - "none": nothing. The drawn indices are constants, and the derivative of the log marginal
          likelihood is NOT an estimate of the score: its bias stays however many particles there
          are, and it may have the wrong sign.
        - "stop": the new weights are w_a / ⊥w_a times the old share, where ⊥ is `stop_gradient`
          (Ścibior and Wood 2021, DPF-SGR). Values are the same to the bit; derivatives of Ẑ are
          unbiased. For parameters of the dynamics, `Propagate` and `Partitioned` have it too.
        - "soft": particles are drawn from q = (1 - s) w + s / k and weighted by w / q, where s is
          the `softness` (Karkus, Hsu and Lee 2018). The weights are noisier, and the derivative is
          still biased, the more the smaller s is.
        - "ot": nothing is drawn. Particles move to the barycentres of an entropy-regularised
          transport plan from the weights to equal ones (Corenflos et al. 2021), computed by
          ott-jax, the extra `ot`. It is differentiable throughout and O(n²); the entropy biases
          the value and the gradient.
        - "straight_through": the values are those of resampling. The derivative is that of
          particles moved by Σ_j w_j ⊥x_j, as if every offspring were the component's mean (Bengio
          et al. 2013). It is biased, and may grow exponentially with t, as on the quadratic model.
      The masses of the components have their derivative in all of these. Component indicators are
      whole numbers and have none. That is no error, since regrouping does not change the
      distribution.
    - `softness`: s, in (0, 1]. `regularisation`: ε of the transport, positive, in units of the
      mean squared spread of a component's particles, as Corenflos et al. scale it.

    "soft" and "ot" are approximate: Ẑ is biased. Raises `ValueError` for an unknown scheme or
    gradient or allocation, a threshold outside [0, 1], k < 1, k together with `share_by`, and s
    or ε out of range; `ImportError` for "ot" without ott-jax.
    """

    scheme: str = eqx.field(static=True, default="systematic")
    ess_threshold: float = eqx.field(static=True, default=1.0)
    particles_per_component: int | None = eqx.field(static=True, default=None)
    sort_by: SortBy | None = eqx.field(static=True, default=None)
    gradient: str = eqx.field(static=True, default="none")
    softness: float = eqx.field(static=True, default=0.5)
    regularisation: float = eqx.field(static=True, default=0.5)
    allocation: str = eqx.field(static=True, default="variance")
    share_by: Callable[[PyTree], Int[Array, " n"]] | None = eqx.field(static=True, default=None)

    def __check_init__(self) -> None:
        check_one_of(SCHEMES, scheme=self.scheme)
        check_share(ess_threshold=self.ess_threshold)
        check_whole(**given(particles_per_component=self.particles_per_component))
        check_sort_by(self.sort_by)
        check_one_of(GRADIENTS, gradient=self.gradient)
        check_one_of(ALLOCATIONS, allocation=self.allocation)
        check_callable("a function of the particles", **given(share_by=self.share_by))
        if self.share_by is not None and self.particles_per_component is not None:
            raise ValueError(
                "share_by: groups have no effect where particles_per_component is"
                f" {self.particles_per_component}"
            )
        check_positive(softness=self.softness, regularisation=self.regularisation)
        check_share(softness=self.softness)
        if self.gradient == "ot":
            require_ott()

    @property
    def approximate(self) -> bool:
        """Whether the weights are normalised after soft draws, or the particles transported."""
        return self.gradient in ("soft", "ot")

    @property
    def sorts(self) -> bool:
        """Whether particles are sorted, those that are not resampled as well."""
        return self.sort_by is not None

    def is_due(self, mixture: ParticleMixture) -> Bool[Array, " m"]:
        """Which components of `mixture` the move would resample."""
        if self.ess_threshold == 1.0:
            return mixture.active
        counts = mixture.component_counts
        least = self.ess_threshold * counts.astype(mixture.log_weights.dtype)
        due = mixture.component_effective_sample_sizes < least
        if self.particles_per_component is not None:
            due = due | (counts != self.particles_per_component)
        return due & (counts > 0)

    def __call__(
        self, key: Key[Array, ""], mixture: ParticleMixture, observation: PyTree = None
    ) -> ParticleMixture:
        """Resample every component that is due."""
        return self.redraw(key, mixture, self.is_due(mixture))

    def redraw(
        self, key: Key[Array, ""], mixture: ParticleMixture, due: Bool[Array, " m"]
    ) -> ParticleMixture:
        """Resample the components that are `due`; with `ess_threshold` 1 all living ones are."""
        drawn_from = self._drawn_from(mixture)
        # The drawn indices are whole numbers and have no derivative.
        drawn = self._draw(key, jax.lax.stop_gradient(drawn_from), due)
        slots = drawn.slots
        copies = _copies(mixture, drawn)
        num_slots = jnp.maximum(drawn.targets, 1).astype(mixture.log_weights.dtype)
        log_shares = self._log_masses(mixture, drawn.line) - jnp.log(num_slots)
        if mixture.num_components > 1:
            # A dead component has no slots; its share must be finite to be stored.
            log_shares = stored(jnp.where(log_shares == -jnp.inf, 0.0, log_shares))
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
        log_weights = jnp.where(slots.filled, redrawn.log_weights, -jnp.inf)
        redrawn = redrawn.replace(log_weights=log_weights)
        return with_offspring(redrawn, mixture, drawn.parents, drawn.targets, due)

    def _draw(
        self, key: Key[Array, ""], mixture: ParticleMixture, due: Bool[Array, " m"]
    ) -> "_Drawn":
        """Each slot's parent: drawn by weight where its component is due, itself elsewhere."""
        num_particles, num_components = mixture.num_particles, mixture.num_components
        all_are_due = self.ess_threshold == 1.0
        if num_components == 1 and self.sort_by is None and self.gradient != "ot":
            line = as_they_are(mixture)
        else:
            stays = None if all_are_due else ~spread(due, mixture.component_indicators)
            # Particles that stay by rank, or are transported, need their component's as neighbours.
            without_gaps = not all_are_due or self.gradient == "ot"
            line = side_by_side(mixture, stays, self.sort_by, without_gaps)
        # If all living components are due, none keeps its particles.
        counts = due.astype(jnp.int32) if all_are_due else line.counts
        targets = self.deal(mixture, due, counts, line if isinstance(line, SideBySide) else None)
        if isinstance(line, InPlace):
            # Particles that are not redrawn keep their places; empty slots may come before them.
            targets = jnp.where(due, targets, num_particles)
        slots = place_slots(targets, num_particles)
        expected = line.expected(targets)
        before, is_inside = line.positions(expected, targets, slots)
        starts = SCHEMES[self.scheme](key, expected, before, targets, slots, line)
        # Rounding must not give a slot to particles after the last weight.
        num_slots = line.num_slots(targets, num_particles)
        starts = jnp.where(is_inside, jnp.minimum(starts, num_slots), num_slots)
        parents = line.places_of(count_starts(starts, num_particles), slots)
        if not all_are_due:
            unmoved = line.places_by_rank(slots.ranks, slots)
            parents = jnp.where(spread(due, slots.components), parents, unmoved)
        parents = line.particles_at(jnp.clip(parents, 0, num_particles - 1))
        return _Drawn(parents, slots, targets, line)

    def deal(
        self,
        mixture: ParticleMixture,
        due: Bool[Array, " m"],
        counts: Int[Array, " m"],
        line: SideBySide | None = None,
    ) -> Int[Array, " m"]:
        """How many slots each component gets; those that are not `due` keep theirs, `counts`.

        Masses and effective sample sizes are those of the `line`, where there is one.
        """
        demands = None
        if self.share_by is not None:
            demands = _shares_of_groups(mixture, self.share_by(mixture.particles), due)
        elif self.allocation != "equal" and mixture.num_components > 1:
            if line is None:
                log_masses, present = mixture.log_mixture_weights, mixture.component_counts
                sample_sizes = mixture.component_effective_sample_sizes
            else:
                log_masses, present = line.log_masses, line.counts
                sample_sizes = line.effective_sample_sizes
            demands = demands_by_variance(
                log_masses, sample_sizes, present, due, mixture.num_usable_slots
            )
        return allocate_slots(counts, due, mixture, self.particles_per_component, demands)

    def _log_masses(
        self, mixture: ParticleMixture, line: InPlace | SideBySide
    ) -> Float[Array, " m"]:
        """The logarithm of each component's mass, reused from the layout where that has it."""
        if isinstance(line, InPlace) or self.gradient == "soft":
            return mixture.log_mixture_weights
        return add_gradient(line.log_masses, mixture.log_mixture_weights)

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
        slots, line, n = drawn.slots, drawn.line, mixture.num_particles
        check_numbered("entries of a transport plan up to", n * n, num_particles=n)
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


def _shares_of_groups(
    mixture: ParticleMixture, groups: Int[Array, " n"], due: Bool[Array, " m"]
) -> Float[Array, " m"]:
    """For each component, one over the number of components of its group that share slots."""
    group = jnp.round(mixture.component_averages(groups)).astype(jnp.int32)
    rivals = jnp.sum((group[:, None] == group[None]) & due[None], axis=1)
    return 1 / jnp.maximum(rivals, 1).astype(mixture.log_weights.dtype)


class _Drawn(NamedTuple):
    """The parents of the slots, and their weights, after resampling."""

    parents: Int[Array, " n"]
    slots: Slots
    targets: Int[Array, " m"]  # how many slots each component has
    line: InPlace | SideBySide


def _copies(mixture: ParticleMixture, drawn: _Drawn) -> ParticleMixture:
    """Every slot's parent unchanged, with its weight."""
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
    """The same particles, with the derivative of their component's weighted mean added."""

    def follow(leaf: Array, drawn: Array) -> Array:
        if not jnp.issubdtype(leaf.dtype, jnp.floating):
            return drawn
        means = mixture.component_averages(jax.lax.stop_gradient(leaf))
        return add_gradient(drawn, spread(means, redrawn.component_indicators))

    return redrawn.replace(particles=jax.tree.map(follow, mixture.particles, redrawn.particles))


def _where(
    is_redrawn: Bool[Array, " n"], redrawn: ParticleMixture, copies: ParticleMixture
) -> ParticleMixture:
    """The redrawn particles, or the old ones where a component was not due."""

    def pick(new: Array, old: Array) -> Array:
        return jnp.where(is_redrawn.reshape(-1, *[1] * (new.ndim - 1)), new, old)

    if redrawn.particles is not copies.particles:
        redrawn = redrawn.replace(
            particles=jax.tree.map(pick, redrawn.particles, copies.particles),
            ancestor_indices=pick(redrawn.ancestor_indices, copies.ancestor_indices),
        )
    return redrawn.replace(log_weights=pick(redrawn.log_weights, copies.log_weights))
