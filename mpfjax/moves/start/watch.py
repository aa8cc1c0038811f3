"""A watch over the hypotheses: whether what is observed speaks for a state that begins anew."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key, PyTree

from mpfjax.checks import Count
from mpfjax.mixture import ParticleMixture, single_component
from mpfjax.moves.alarm import quiet
from mpfjax.moves.base import AbstractMove, Step, is_missing
from mpfjax.moves.initial import require_propagation, sample_initial
from mpfjax.operations.logarithms import without_gradient


class WatchStart(AbstractMove):
    """A move that changes nothing, and compares the filter at each step with draws of x_0.

    The report's `log_evidence_against_start` is log of the mean of p(y_t | x_{t-1}) over the draws,
    less the increment. `with_alarm` makes a filter with it.

    - `num_particles`: draws of x_0, the same at every step.
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
