"""Resampling within components: systematic, stratified or multinomial."""

import dataclasses
from typing import Annotated, Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, Key

from mpfjax.checks import Count, Share, one_of
from mpfjax.memory import Offspring, after_resampling, reference_slot
from mpfjax.mixture import ParticleMixture
from mpfjax.moves.base import AbstractResampling, Gradient, Groups, Step
from mpfjax.moves.resampling.allocation import (
    allocate_slots,
    demands_by_variance,
    demands_of_groups,
)
from mpfjax.moves.resampling.ancestors import SCHEMES, Ancestors, draw_ancestors
from mpfjax.moves.resampling.line import Line, in_line
from mpfjax.operations.logarithms import add_gradient, scaled_exp
from mpfjax.operations.segments import spread
from mpfjax.operations.stored import stored, take

Scheme = Annotated[str, one_of(SCHEMES)]
Allocation = Literal["variance", "equal", "root"]
_POWER = 0.25  # of a component's weight, by which "root" allocates slots


class Resample(AbstractResampling):
    """Redraw each component's particles in proportion to their weights w_i.

    Components are resampled independently of each other, which preserves the support of every mode
    (Vermaak et al. 2003, section 3). A component keeps its weight, and its new particles share it
    equally. The expected number of offspring of particle i is k_m w_i for every scheme, so the
    marginal likelihood remains unbiased.

    - `scheme`: "systematic" (the default: least noise, least work), "stratified", or "multinomial"
      (the textbook scheme, most noise).
    - `ess_threshold`: a component is resampled if its effective sample size is below this fraction
      of its number of particles. 1.0 resamples at every step. Under `vmap`, a lower value saves no
      time.
    - `particles_per_component`: None divides all slots among the active components that are
      resampled, according to `allocation`. A number k assigns k particles to each active component
      and leaves the other slots empty, as in section 5.2 of the paper.
    - `allocation`: how the components share the slots, unless `particles_per_component` or `group`
      determines it. "variance" minimises the variance of Ẑ (Neyman 1934): the share of component m
      is in proportion to the root of π_m² k_m / ESS_m. A quarter to a half of the slots is divided
      equally, so that every mode is retained (see docs/masses.md). "equal" is the paper's: it
      retains improbable modes longest, and log Ẑ is less accurate. "root" is between the two, in
      proportion to the fourth root of π_m, for many components.
    - `group`: a function that returns the number of each particle's group, the same within a
      component. Groups with a component that is resampled share the slots equally, and so do the
      components within a group. None makes no groups. Use it if components are rival hypotheses
      about several objects, so that an object with many hypotheses does not take the slots of the
      others.
    - `along_curve`: whether the particles of a component are resampled in the order of a Hilbert
      curve of their state, of which all floating-point components are standardised within the
      component, and more than 8 reduced to their first principal components. Systematic and
      stratified resampling in a good order change the distribution least (Kitagawa 1996). With the
      "rqmc" noise of `Propagate`, the filter is array randomised quasi-Monte Carlo (L'Ecuyer, Lécot
      and Tuffin 2008; Gerber and Chopin 2015); `with_quasi_monte_carlo` sets both. Use it if
      mixture weights or likelihoods must be accurate.
    - `gradient`: how a derivative of the filter treats the resampling.
        - "none": it is ignored. The drawn indices are constants, and the derivative of the log
          marginal likelihood is NOT an estimate of the score: its bias does not decrease with the
          number of particles, and it may have the wrong sign.
        - "stop": the new weights are w_a / ⊥w_a times the old share, where ⊥ is `stop_gradient`
          (Ścibior and Wood 2021, DPF-SGR). Values are identical to the bit; derivatives of Ẑ are
          unbiased. For parameters of the dynamics, `Propagate` and `Partitioned` have it too.
      The weights of the components are differentiated in both cases. Indicators have no derivative,
      and need none, because regrouping does not change the distribution.

    Raises `ValueError` for an unknown scheme or gradient or allocation, a threshold outside [0, 1],
    k < 1, and k together with `group`.
    """

    scheme: Scheme = eqx.field(static=True, default="systematic")
    ess_threshold: Share = eqx.field(static=True, default=1.0, kw_only=True)
    particles_per_component: Count | None = eqx.field(static=True, default=None, kw_only=True)
    along_curve: bool = eqx.field(static=True, default=False, kw_only=True)
    gradient: Gradient = eqx.field(static=True, default="none", kw_only=True)
    allocation: Allocation = eqx.field(static=True, default="variance", kw_only=True)
    group: Groups | None = eqx.field(static=True, default=None, kw_only=True)

    def __check_init__(self) -> None:
        if self.group is not None and self.particles_per_component is not None:
            raise ValueError("group: groups have no effect together with particles_per_component")

    approximate = False
    biases_score = property(lambda self: self.gradient == "none" and self.ess_threshold > 0)
    keeps_families = True
    """it updates the memory of Eve indices."""

    def check(self, now: Step, num_particles: int, num_components: int) -> None:
        """Raise a `ValueError` for fewer slots than each component requires."""
        each = self.particles_per_component or 1
        if each * num_components > num_particles:
            which = f"particles_per_component, {each}, for each of num_components, {num_components}"
            raise ValueError(f"num_particles: {num_particles} is less than {which}")

    def around(self, reference: Any) -> "Resample":
        """The move by the multinomial scheme, which finds the trajectory's slot in the memory."""
        return dataclasses.replace(self, scheme="multinomial")

    def due(self, mixture: ParticleMixture) -> Bool[Array, " m"]:
        """Which components are to be resampled."""
        due = mixture.active
        if self.ess_threshold < 1.0:
            counts = mixture.component_counts
            least = self.ess_threshold * counts.astype(mixture.log_weights.dtype)
            is_poor = mixture.component_effective_sample_sizes < least
            if self.particles_per_component is not None:
                is_poor |= counts != self.particles_per_component
            due = is_poor & (counts > 0)
        return due if mixture.waits is None else due & ~mixture.waits

    def resample(self, key: Key[Array, ""], mixture: ParticleMixture) -> ParticleMixture:
        """The mixture with every component resampled that is due."""
        return self.redraw(key, mixture, self.due(mixture))[0]

    def redraw(
        self, key: Key[Array, ""], mixture: ParticleMixture, due: Bool[Array, " m"]
    ) -> tuple[ParticleMixture, Ancestors]:
        """Resample the components that are `due`; with `ess_threshold` 1 all active ones are.

        In conditional SMC one slot of the retained trajectory's component, each with equal
        probability, has it as its parent.
        """
        n, m = mixture.num_particles, mixture.num_components
        all_are_due = self.ess_threshold == 1.0
        stays = None if all_are_due else ~spread(due, mixture.component_indicators)
        keep = reference_slot(mixture.memory)
        if keep is not None:
            is_kept = jnp.arange(n, dtype=jnp.int32) == keep
            stays = is_kept if stays is None else stays | is_kept
        # The drawn indices are whole numbers and have no derivative.
        line = in_line(jax.lax.stop_gradient(mixture), stays, self.along_curve)
        targets = self.deal(mixture, line, due)
        ancestors = draw_ancestors(
            key, line, targets, self.scheme,
            num_slots=n, due=None if all_are_due else due, keep=keep,
        )  # fmt: skip
        slots, parents = ancestors.slots, ancestors.particles
        num_drawn = jnp.maximum(targets, 1).astype(mixture.log_weights.dtype)
        log_masses = add_gradient(line.log_masses, mixture.log_mixture_weights)
        log_shares = log_masses - jnp.log(num_drawn)
        if m > 1:
            # A dead component has no slots; its share must be finite to be stored.
            log_shares = stored(jnp.where(log_shares == -jnp.inf, 0.0, log_shares))
        log_weights, old = spread(log_shares, slots.components), take(mixture.log_weights, parents)
        if self.gradient == "stop":
            log_weights = add_gradient(jax.lax.stop_gradient(log_weights), old)
        if not all_are_due:
            log_weights = jnp.where(spread(due, slots.components), log_weights, old)
        redrawn = (
            mixture.with_resampled(due)
            .at(parents)
            .replace(
                log_weights=jnp.where(slots.filled, log_weights, -jnp.inf),
                component_indicators=slots.components if m > 1 else mixture.component_indicators,
            )
            .with_order(self.along_curve)
        )
        offspring = Offspring(parents, targets, due, ancestors.reference)
        return after_resampling(mixture, redrawn, offspring), ancestors

    def deal(
        self, mixture: ParticleMixture, line: Line, due: Bool[Array, " m"]
    ) -> Int[Array, " m"]:
        """How many slots each component receives; components that are not `due` keep theirs."""
        num_slots, demands = mixture.num_usable_slots, jnp.ones_like(line.totals)
        if self.group is not None:
            demands = demands_of_groups(mixture, self.group(mixture.particles), due)
        elif self.allocation == "root":
            demands, _ = scaled_exp(jnp.where(due, _POWER * line.log_masses, -jnp.inf))
        elif self.allocation == "variance" and mixture.num_components > 1:
            demands = demands_by_variance(
                line.log_masses, line.effective_sample_sizes, line.counts, due, num_slots
            )
        # If all living components are due, none keeps its particles.
        counts = jnp.zeros_like(due, jnp.int32)
        if self.ess_threshold < 1.0:
            counts = jnp.where(due, 0, line.counts)
        return allocate_slots(counts, due, num_slots, self.particles_per_component, demands)
