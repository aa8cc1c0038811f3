"""Restarts: hypotheses that the state is anywhere where it may begin, at every step."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key, PyTree

from mpfjax.checks import Count, InnerShare, shown
from mpfjax.mixture import ParticleMixture, single_component
from mpfjax.moves.base import AbstractMove, AbstractRegrouping, Regrouped
from mpfjax.moves.initial import chosen, sample_initial, two_looks
from mpfjax.operations.logarithms import log_sum_exp
from mpfjax.operations.random import split
from mpfjax.operations.stored import take

SURPRISE = "log_evidence_against_hypotheses"
# The cumulative sum at which the hypotheses are taken to be wrong, as a log Bayes factor.
ALARM = 5.0
# Of the slots for restarts, while nothing speaks against the hypotheses.
QUIET_PART = 1 / 16


class Restart(AbstractMove):
    """Resample for x_{t-1} ~ (1 - p) δ + p p_0: with probability p the state begins anew.

    The state of a robot that is carried away, or of a target that is lost and found, is drawn from
    the law of x_0 again. The kernel is stratified: most slots hold particles that are resampled, of
    mass 1 - p; the last ones hold draws of x_0, of mass p, in a component of their own, the last
    label. These are chosen among K draws for each slot by two looks at y_t, as `SelectInitial`
    chooses x_0, and Ẑ is unbiased for the kernel.

    What the draws of the step before have become joins a free component, or the lightest. How much
    they speak against all other hypotheses is their mass beside the others', over p / (1 - p).
    Where the cumulative sum of its logarithm exceeds 5, restarts take all of their share; elsewhere
    a sixteenth of it, so that they cost little.

    - `resample`: the chain's resampling, a `Resample` or `AuxiliaryResample` at every step.
    - `propagation`: draws x_t, and weighs it: usually the filter's own.
    - `probability`: p.
    - `share`: the most of the slots that restarts take.
    - `num_draws`: K.

    `with_restarts` makes a filter with it. Raises `ValueError` for another resampling or
    propagation, and for numbers out of their range.
    """

    resample: Any
    propagation: Any
    probability: InnerShare = eqx.field(static=True, default=1e-3)
    share: InnerShare = eqx.field(static=True, default=1 / 4)
    num_draws: Count = eqx.field(static=True, default=4)

    resamples = True
    keeps_parents = False
    """a draw of x_0 has no parent."""
    keeps_families = False

    def __check_init__(self) -> None:
        plain = getattr(self.resample, "resampling", None)
        fixed = plain is None or plain.ess_threshold < 1 or plain.particles_per_component
        if fixed:
            what = "is no Resample of all components at every step, which leaves slots"
            raise ValueError(f"resample: {shown(self.resample)} {what}")
        if not getattr(self.propagation, "draws_each", False):
            who = f"propagation: {shown(self.propagation)}"
            raise ValueError(f"{who} does not draw x_t of each x_(t-1)")

    def map_inner(self, change: Callable[[Any], Any]) -> "Restart":
        """The same with another resampling and another propagation."""
        inner = change(self.resample), change(self.propagation)
        return Restart(*inner, self.probability, self.share, self.num_draws)

    def initial_memory(self, num_components: int) -> dict[str, PyTree]:
        """How much has spoken against the hypotheses: a cumulative sum of log Bayes factors."""
        del num_components
        return {SURPRISE: jnp.zeros(())}

    def would_resample(
        self, mixture: ParticleMixture, observation: PyTree = None
    ) -> Bool[Array, " m"]:
        """What the resampling would."""
        return self.resample.would_resample(mixture, observation)

    def predict(self, key: Key[Array, ""], mixture: ParticleMixture) -> ParticleMixture:
        """The same where y_t is missing, with any draws of x_0."""
        return self(key, mixture, None)

    def __call__(
        self, key: Key[Array, ""], mixture: ParticleMixture, observation: PyTree
    ) -> ParticleMixture:
        """Resample, with draws of x_0 that y_t speaks for in the last slots."""
        key_resample, key_drawn, key_look, key_chosen = split(key, 4)
        n, last = mixture.num_particles, mixture.num_components - 1
        # The cumulative sum after the step before; bounded, so that it ends when they are right.
        against = self.evidence_against(mixture, observation, jnp.zeros(()))
        surprise = jnp.clip(mixture.memory[SURPRISE] + against, 0.0, 2 * ALARM)
        most = max(1, round(self.share * n))
        least = max(1, round(QUIET_PART * most))
        number = jnp.where(surprise > ALARM, most, least).astype(jnp.int32)
        first = jnp.asarray(mixture.num_usable_slots, jnp.int32) - number

        survivors = self._resampled(key_resample, mixture.replace(usable_slots=first), observation)
        drawn = sample_initial(key_drawn, self.propagation.model, self.num_draws * most)
        if observation is None:
            log_factors = jnp.zeros((2, self.num_draws * most))
        else:
            log_factors = two_looks(key_look, self.propagation, drawn, observation)
        anew = chosen(key_chosen, drawn, log_factors, most, number=number)

        slot = jnp.arange(n, dtype=jnp.int32) - first
        is_new, rank = (slot >= 0) & (slot < number), jnp.clip(slot, 0, most - 1)

        def pick(new: Array, old: Array) -> Array:
            return jnp.where(is_new.reshape(-1, *[1] * (old.ndim - 1)), take(new, rank), old)

        log_weights = jnp.log(self.probability) + anew.log_scale + anew.log_weights
        return survivors.replace(
            particles=jax.tree.map(pick, anew.particles, survivors.particles),
            log_weights=pick(log_weights, jnp.log1p(-self.probability) + survivors.log_weights),
            component_indicators=jnp.where(is_new, last, survivors.component_indicators),
            ancestor_indices=jnp.where(is_new, -1, survivors.ancestor_indices),
            usable_slots=mixture.usable_slots,
            memory=survivors.memory | {SURPRISE: surprise},
        )

    def _resampled(
        self, key: Key[Array, ""], mixture: ParticleMixture, observation: PyTree
    ) -> ParticleMixture:
        """The mixture after the resampling, without restarts of the step before as such."""
        last = mixture.num_components - 1
        if observation is None:
            survivors = self.resample.resampling(key, mixture)
        else:
            survivors = self.resample(key, mixture, observation)
        # A free label, or that of the lightest component.
        joined = jnp.argmin(mixture.log_mixture_weights[:last]).astype(jnp.int32)
        labels = survivors.component_indicators
        return survivors.replace(component_indicators=jnp.where(labels == last, joined, labels))

    def evidence_against(
        self, mixture: ParticleMixture, observation: PyTree, increment: Float[Array, ""]
    ) -> Float[Array, ""]:
        """The odds of the draws of x_0 after the step, over p / (1 - p)."""
        del observation, increment
        log_masses = mixture.log_mixture_weights
        log_odds = log_masses[-1] - log_sum_exp(log_masses[:-1])
        return log_odds - jnp.log(self.probability / (1 - self.probability))


class WatchStart(AbstractMove):
    """A move that changes nothing, and compares the filter at each step with draws of x_0.

    The report's `log_evidence_against_start` is log of the mean of p(y_t | x_{t-1}) over the draws,
    less the increment. `with_alarm` makes a filter with it.

    - `propagation`: draws x_t of each draw of x_0, and weighs it: usually the filter's own.
    - `draws`: of x_0, the same at every step.
    """

    propagation: Any
    draws: PyTree

    weighs = False
    keeps_mass = True
    keeps_trajectories = True

    def map_inner(self, change: Callable[[Any], Any]) -> "WatchStart":
        """The same with another propagation."""
        return WatchStart(change(self.propagation), self.draws)

    def __call__(
        self, key: Key[Array, ""], mixture: ParticleMixture, observation: PyTree
    ) -> ParticleMixture:
        """The mixture itself."""
        del key, observation
        return mixture

    def evidence_against(
        self, mixture: ParticleMixture, observation: PyTree, increment: Float[Array, ""]
    ) -> Float[Array, ""]:
        """log mean p(y_t | x_{t-1}) less the increment; zero where y_t is missing."""
        del mixture
        if observation is None:
            return jnp.zeros_like(increment)
        anew = self.propagation(jax.random.key(0), single_component(self.draws), observation)
        return jax.lax.stop_gradient(anew.log_mass - increment)


class RegroupOthers(AbstractRegrouping):
    """A regrouping of all components but the last, whose label is that of restarts."""

    regrouping: Any

    def map_inner(self, change: Callable[[Any], Any]) -> "RegroupOthers":
        """The same of another regrouping."""
        return RegroupOthers(change(self.regrouping))

    def initial_memory(self, num_components: int) -> dict[str, PyTree]:
        """That of the regrouping."""
        return self.regrouping.initial_memory(num_components - 1)

    def forget(self, memory: dict[str, PyTree], dead: Bool[Array, " m"]) -> dict[str, PyTree]:
        """What the regrouping forgets."""
        return self.regrouping.forget(memory, dead[:-1])

    def regroup(self, key: Key[Array, ""], mixture: ParticleMixture) -> Regrouped:
        """The labels of the others; those of restarts stay."""
        last, labels = mixture.num_components - 1, mixture.component_indicators
        is_last = labels == last
        others = mixture.replace(
            log_weights=jnp.where(is_last, -jnp.inf, mixture.log_weights),
            component_indicators=jnp.where(is_last, 0, labels),
            num_components=last,
        )
        regrouped, memory = self.regrouping.regroup(key, others)
        return jnp.where(is_last, last, regrouped), memory
