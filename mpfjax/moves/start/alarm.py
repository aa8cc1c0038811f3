"""The alarm: a cumulative sum of the evidence against all hypotheses (CUSUM, Page 1954)."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key, PyTree

from mpfjax.checks import Count
from mpfjax.memory import Memory
from mpfjax.mixture import ParticleMixture, single_component
from mpfjax.moves.base import AbstractMove, Step, is_missing
from mpfjax.moves.initial import require_propagation
from mpfjax.operations.logarithms import without_gradient

# In the memory.
ALARM = "alarm"
# Above it, all hypotheses are judged wrong.
THRESHOLD = 5.0


class Alarm(Memory):
    """The cumulative sum: after each step the filter is compared with the same draws of x_0.

    The sum is bounded, so that it ends soon after the hypotheses are right again, and so is the
    evidence of one step, of which an impossible one would otherwise count for ever.
    """

    total: Float[Array, ""]
    num_particles: int = eqx.field(static=True)

    @property
    def rings(self) -> Bool[Array, ""]:
        """Whether what was observed speaks against all hypotheses."""
        return self.total > THRESHOLD

    def log_evidence(self, now: Step) -> Float[Array, ""]:
        """log p(y_t | x_{t-1} ~ p_0), of a state that begins anew."""
        now = without_gradient(now)
        key_initial, key_move = jax.random.split(jax.random.key(0))
        draws = single_component(now.initial_law.sample_initial(key_initial, self.num_particles))
        assert now.propagation is not None
        return now.propagation(key_move, draws, now).log_mass

    def heard(self, log_evidence: Float[Array, ""]) -> "Alarm":
        """The alarm after a step with this evidence against the hypotheses."""
        change = jnp.where(jnp.isnan(log_evidence), 0.0, log_evidence)
        change = jnp.clip(change, -2 * THRESHOLD, 2 * THRESHOLD)
        return Alarm(jnp.clip(self.total + change, 0.0, 2 * THRESHOLD), self.num_particles)

    def after_step(self, mixture: ParticleMixture, now: Step) -> tuple["Alarm", dict[str, PyTree]]:
        """Adds log p(y_t | x_{t-1} ~ p_0) less the increment; zero where y_t is missing."""
        assert mixture.within is not None
        increment = jax.lax.stop_gradient(mixture.within.log_increment)
        log_evidence = jnp.zeros_like(increment)
        if not is_missing(now):
            log_evidence = self.log_evidence(now) - increment
        alarm = self.heard(log_evidence)
        return alarm, {"log_evidence_against_start": log_evidence, "alarm": alarm.rings}


class WatchStart(AbstractMove):
    """A move that changes nothing, and puts an `Alarm` into the memory; see `with_alarm`.

    - `num_particles`: draws of x_0, the same at every step.
    """

    num_particles: Count = eqx.field(static=True, default=4096)

    approximate = False
    biases_score = False
    weighs = False
    keeps_mass = True

    def check(self, now: Step, num_particles: int, num_components: int) -> None:
        """Raise a `ValueError` where no move draws x_t of each particle."""
        require_propagation(now, "draws of x_0 are compared")

    def initial_memory(self, now: Step, num_components: int) -> dict[str, PyTree]:
        """The alarm before any observation."""
        return {ALARM: Alarm(jnp.zeros(()), self.num_particles)}

    def __call__(self, key: Key[Array, ""], mixture: ParticleMixture, now: Step) -> ParticleMixture:
        """The mixture itself."""
        return mixture
