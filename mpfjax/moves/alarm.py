"""The alarm: a cumulative sum of what speaks against all hypotheses (CUSUM, Page 1954)."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key, PyTree

from mpfjax.checks import Count
from mpfjax.memory import Memory
from mpfjax.mixture import ParticleMixture, single_component
from mpfjax.moves.base import AbstractMove, Step, is_missing
from mpfjax.moves.initial import require_propagation, sample_initial
from mpfjax.operations.islands import num_islands, over_islands
from mpfjax.operations.logarithms import log_sum_exp, without_gradient

# In the memory.
SURPRISE = "alarm"
# Above it, all hypotheses are taken to be wrong.
ALARM = 5.0


class Alarm(Memory):
    """The cumulative sum: after each step the filter is compared with the same draws of x_0.

    The sum is bounded, so that it ends soon after the hypotheses are right again, and so is what
    one step can tell: an impossible one is not for ever.
    """

    total: Float[Array, ""]
    num_particles: int = eqx.field(static=True)

    @property
    def rings(self) -> Bool[Array, ""]:
        """Whether what was observed speaks against all hypotheses."""
        return self.total > ALARM

    def after_step(
        self, mixture: ParticleMixture, now: Step, increment: Float[Array, ""]
    ) -> tuple["Alarm", dict[str, PyTree]]:
        """Adds log mean p(y_t | x_{t-1}) less the increment; zero where y_t is missing."""
        evidence = jnp.zeros_like(increment)
        if not is_missing(now):
            now = without_gradient(now)
            key_drawn, key_moved = jax.random.split(jax.random.key(0))
            draws = single_component(sample_initial(key_drawn, now.model, self.num_particles))
            anew = now.propagation(key_moved, draws, now)  # pyright: ignore[reportOptionalCall]
            evidence = anew.log_mass - jax.lax.stop_gradient(increment)
        heard = jnp.where(jnp.isnan(evidence), 0.0, evidence)
        total = jnp.clip(self.total + jnp.clip(heard, -2 * ALARM, 2 * ALARM), 0.0, 2 * ALARM)
        alarm = Alarm(total, self.num_particles)
        return alarm, {"log_evidence_against_start": evidence, "surprised": alarm.rings}


class WatchStart(AbstractMove):
    """A move that changes nothing, and puts an `Alarm` into the memory; see `with_alarm`.

    - `num_particles`: draws of x_0, the same at every step.
    """

    num_particles: Count = eqx.field(static=True, default=4096)

    weighs = False
    keeps_mass = True

    def check(self, now: Step, num_particles: int, num_components: int) -> None:
        """Raise a `ValueError` where no move draws x_t of each particle."""
        require_propagation(now, "draws of x_0 are compared")

    def initial_memory(self, model: Any, num_components: int) -> dict[str, PyTree]:
        """The alarm before any observation."""
        return {SURPRISE: Alarm(jnp.zeros(()), self.num_particles)}

    def around(self, reference: Any) -> "WatchStart":
        """The move itself, which changes nothing."""
        return self

    def __call__(self, key: Key[Array, ""], mixture: ParticleMixture, now: Step) -> ParticleMixture:
        """The mixture itself."""
        return mixture


def over_all_islands(log_value: Float[Array, ""]) -> Float[Array, ""]:
    """The logarithm of the sum over all islands of what each has."""
    return log_value if num_islands() == 1 else log_sum_exp(over_islands(log_value))
