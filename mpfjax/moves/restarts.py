"""Restarts: hypotheses that the state is anywhere where it may begin, at every step."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key, PyTree

from mpfjax.checks import Count, InnerShare, shown
from mpfjax.mixture import ParticleMixture, no_ancestors, single_component
from mpfjax.moves.alarm import is_alarmed, over_all_islands, quiet
from mpfjax.moves.base import (
    AbstractMove,
    AbstractRegrouping,
    AbstractWrapper,
    Regrouped,
    Step,
    is_missing,
    unless_waiting,
)
from mpfjax.moves.initial import chosen, require_propagation, sample_initial, two_looks
from mpfjax.moves.resampling.auxiliary import AuxiliaryResample
from mpfjax.moves.resampling.resample import Resample
from mpfjax.operations.logarithms import log_sum_exp, without_gradient
from mpfjax.operations.random import split

# Of the slots for restarts, while nothing speaks against the hypotheses.
QUIET_PART = 1 / 16


class Restart(AbstractWrapper):
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

    The filter's own propagation draws x_t, and weighs it.

    - `resample`: the chain's resampling, a `Resample` or `AuxiliaryResample` at every step.
    - `probability`: p.
    - `share`: the most of the slots that restarts take.
    - `num_draws`: K.

    `with_restarts` makes a filter with it. Raises `ValueError` for another resampling, for numbers
    out of their range, and in a filter that has too few particles, or no propagation of each.
    """

    resample: Any
    probability: InnerShare = eqx.field(static=True, default=1e-3, kw_only=True)
    share: InnerShare = eqx.field(static=True, default=1 / 4, kw_only=True)
    num_draws: Count = eqx.field(static=True, default=4, kw_only=True)

    holds = ("resample",)
    keeps_mass = False
    keeps_parents = False
    """a state that begins anew has none."""
    keeps_families = False

    def __check_init__(self) -> None:
        super().__check_init__()
        plain = plain_resample(self.resample)
        if plain is None or plain.ess_threshold < 1 or plain.particles_per_component:
            what = "is no Resample of all components at every step, which leaves slots"
            raise ValueError(f"resample: {shown(self.resample)} {what}")

    def check(self, now: Step, num_particles: int, num_components: int) -> None:
        """Raise a `ValueError` where there are too few slots, or no propagation of each."""
        super().check(now, num_particles, num_components)
        require_propagation(now, "a state begins anew")
        most, others = self._most_slots(num_particles), num_components - 1
        if others < 1 or num_particles - most < others:
            which = f"is less than {most} for restarts and one for each of {others} components"
            raise ValueError(f"num_particles: {num_particles} {which}")

    def initial_memory(self, model: Any, num_components: int) -> dict[str, PyTree]:
        """How much has spoken against the hypotheses, beside the memory of the resampling."""
        return quiet() | super().initial_memory(model, num_components)

    def around(self, reference: Any) -> AbstractMove:
        """Raise a `ValueError`: a trajectory that is kept would have to begin anew."""
        raise ValueError("filter: restarts cannot keep a trajectory, as Resample and Propagate can")

    def _most_slots(self, num_particles: int) -> int:
        return max(1, round(self.share * num_particles))

    def __call__(self, key: Key[Array, ""], mixture: ParticleMixture, now: Step) -> ParticleMixture:
        """Resample, with draws of x_0 that y_t speaks for in the last slots."""
        key_resample, key_drawn, key_look, key_chosen = split(key, 4)
        usable, last = mixture.num_usable_slots, mixture.num_components - 1
        room = self._most_slots(mixture.num_particles)
        # Of a part of the slots, where only a part may be used.
        share = jnp.asarray(usable, jnp.float32) / mixture.num_particles
        most = jnp.maximum(1, jnp.round(room * share)).astype(jnp.int32)
        least = jnp.maximum(1, jnp.round(QUIET_PART * room * share)).astype(jnp.int32)
        number = jnp.where(is_alarmed(mixture), most, least)

        survivors = self._resampled(
            key_resample, mixture.replace(usable_slots=usable - number), now
        )
        drawn = sample_initial(key_drawn, now.model, self.num_draws * room)
        if is_missing(now):
            log_factors = jnp.zeros((2, self.num_draws * room))
        else:
            log_factors, _ = two_looks(key_look, now, drawn)
        anew = chosen(key_chosen, drawn, log_factors, room, number=number)
        anew = anew.replace(
            component_indicators=jnp.full_like(anew.component_indicators, last),
            ancestor_indices=no_ancestors(anew),
        )
        log_shares = jnp.log(jnp.array([1 - self.probability, self.probability]))
        joined = survivors.weighed(log_shares[:1]).joined(anew.weighed(log_shares[1:]))
        # A mixture that waits is of x_0, whose law a restart does not change.
        return unless_waiting(joined.replace(usable_slots=mixture.usable_slots), mixture)

    def _resampled(
        self, key: Key[Array, ""], mixture: ParticleMixture, now: Step
    ) -> ParticleMixture:
        """The mixture after the resampling, without restarts of the step before as such."""
        last, resample = mixture.num_components - 1, self.resample
        if is_missing(now):
            # There is nothing to look ahead to, and slots are needed all the same.
            survivors = plain_resample(resample).resample(key, mixture)  # pyright: ignore
        else:
            survivors = resample(key, mixture, now)
        # A free label, or that of the lightest component.
        lightest = jnp.argmin(mixture.log_mixture_weights[:last]).astype(jnp.int32)
        labels = survivors.component_indicators
        return survivors.replace(component_indicators=jnp.where(labels == last, lightest, labels))

    def evidence_against(
        self, mixture: ParticleMixture, now: Step, increment: Float[Array, ""]
    ) -> Float[Array, ""]:
        """The odds of the draws of x_0 after the step, over p / (1 - p)."""
        log_masses = mixture.log_mixture_weights
        anew, others = log_masses[-1], log_sum_exp(log_masses[:-1])
        log_odds = over_all_islands(anew) - over_all_islands(others)
        return log_odds - jnp.log(self.probability / (1 - self.probability))


def plain_resample(move: Any) -> Resample | None:
    """The `Resample` that a move is, or by which it draws; None of any other move."""
    held = (move, *move.inner) if isinstance(move, Resample | AuxiliaryResample) else ()
    return next((each for each in held if isinstance(each, Resample)), None)


class WatchStart(AbstractMove):
    """A move that changes nothing, and compares the filter at each step with draws of x_0.

    The report's `log_evidence_against_start` is log of the mean of p(y_t | x_{t-1}) over the draws,
    less the increment. `with_alarm` makes a filter with it.

    - `num_particles`: of x_0, the same at every step.
    """

    num_particles: Count = eqx.field(static=True, default=4096)

    weighs = False
    keeps_mass = True

    def check(self, now: Step, num_particles: int, num_components: int) -> None:
        """Raise a `ValueError` where no move draws x_t of each particle."""
        require_propagation(now, "draws of x_0 are compared")

    def initial_memory(self, model: Any, num_components: int) -> dict[str, PyTree]:
        """How much has spoken against the hypotheses."""
        return quiet()

    def around(self, reference: Any) -> "WatchStart":
        """The move itself, which changes nothing."""
        return self

    def __call__(self, key: Key[Array, ""], mixture: ParticleMixture, now: Step) -> ParticleMixture:
        """The mixture itself."""
        return mixture

    def evidence_against(
        self, mixture: ParticleMixture, now: Step, increment: Float[Array, ""]
    ) -> Float[Array, ""]:
        """log mean p(y_t | x_{t-1}) less the increment; zero where y_t is missing."""
        if is_missing(now):
            return jnp.zeros_like(increment)
        now = without_gradient(now)
        key_drawn, key_moved = jax.random.split(jax.random.key(0))
        draws = single_component(sample_initial(key_drawn, now.model, self.num_particles))
        anew = now.propagation(key_moved, draws, now)  # pyright: ignore[reportOptionalCall]
        return anew.log_mass - jax.lax.stop_gradient(increment)


class RegroupOthers(AbstractWrapper, AbstractRegrouping):
    """A regrouping of all components but the last, whose label is that of restarts."""

    regrouping: AbstractRegrouping

    holds = ("regrouping",)

    def check(self, now: Step, num_particles: int, num_components: int) -> None:
        """The checks of the regrouping, of one component less."""
        self.regrouping.check(now, num_particles, num_components - 1)

    def initial_memory(self, model: Any, num_components: int) -> dict[str, PyTree]:
        """That of the regrouping."""
        return self.regrouping.initial_memory(model, num_components - 1)

    def regroup(self, key: Key[Array, ""], mixture: ParticleMixture) -> Regrouped:
        """The labels of the others; those of restarts stay."""
        last, labels = mixture.num_components - 1, mixture.component_indicators
        is_last = labels == last
        others = mixture.replace(
            log_weights=jnp.where(is_last, -jnp.inf, mixture.log_weights),
            component_indicators=jnp.where(is_last, 0, labels),
            num_components=last,
        )
        if last == 1:
            return labels, mixture.memory
        regrouped, memory = self.regrouping.regroup(key, others)
        return jnp.where(is_last, last, regrouped), memory
