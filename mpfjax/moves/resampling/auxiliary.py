"""Resampling with a look-ahead: the auxiliary particle filter as a move."""

from collections.abc import Callable
from typing import Annotated, Any

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key, PyTree

from mpfjax.checks import Rule, saying
from mpfjax.mixture import ParticleMixture
from mpfjax.models.base import real_each
from mpfjax.moves.base import AbstractMove
from mpfjax.moves.resampling.resample import Resample
from mpfjax.operations.segments import spread
from mpfjax.operations.stored import take

_LOOKAHEAD = Rule(
    lambda look: (
        not isinstance(look, type)
        and (callable(look) or hasattr(look, "log_normaliser") or hasattr(look, "at_step_of"))
    ),
    "a function of an observation and states, nor a proposal with log_normaliser",
)


class AuxiliaryResample(AbstractMove):
    """Resample in proportion to w_i ν(y_t, x_{t-1}^i), and divide the weights by ν again.

    The first stage of the auxiliary particle filter (Pitt and Shephard 1999). The look-ahead ν
    predicts how well each particle will explain y_t. Particles with a larger ν have more offspring,
    before anything is drawn at t. The distribution stays the same in expectation for any ν:
    offspring of a particle with k times the offspring have 1 / k of the weight. Ẑ stays unbiased.
    Unlike that of `Resample`, the mass of a component changes. Everything happens within
    components.

    - `resample`: the `Resample` that draws; its `ess_threshold` applies to the weights times ν.
    - `lookahead`: a function (y_t, states) -> log ν of each particle, (n,), or a proposal that has
      `log_normaliser`, such as `GaussNewtonProposal`. Where ν depends on the step, its
      `at_step_of(mixture)` gives that function, as of a learned one. The best ν is
      p(y_t | x_{t-1}). It must be positive for every particle that can explain y_t, and its tails
      no thinner than those of p(y_t | x_{t-1}): an overconfident ν leaves most of the weight to a
      few particles. Where ν is zero for all particles of a component, the component is resampled
      by w alone.

    Without an observation nothing is resampled. Raises `ValueError` for a look-ahead that is
    neither function nor such a proposal. Use it, with a proposal of the same kind, where the
    likelihood is narrow.
    """

    resample: Resample
    lookahead: Annotated[Any, _LOOKAHEAD]

    def map_inner(self, change: Callable[[Any], Any]) -> "AuxiliaryResample":
        """The same with another `Resample`."""
        return AuxiliaryResample(change(self.resample), self.lookahead)

    @property
    def resampling(self) -> Resample:
        """The `Resample` that draws."""
        return self.resample

    weighs = False
    """the weights are divided by the look-ahead again."""
    keeps_trajectories = True
    """offspring of the one that is kept are weighed as any."""

    @property
    def reads(self) -> frozenset[str]:
        """The memory that the look-ahead reads."""
        return getattr(self.lookahead, "reads", frozenset())

    @property
    def particles_per_component(self) -> int | None:
        """`particles_per_component` of the resampling."""
        return self.resample.particles_per_component

    def would_resample(
        self, mixture: ParticleMixture, observation: PyTree = None
    ) -> Bool[Array, " m"]:
        """Which components of `mixture` the move would resample."""
        weighed = mixture.weighed(self._log_factors(mixture, observation))
        return self.resample.would_resample(weighed)

    def __call__(
        self, key: Key[Array, ""], mixture: ParticleMixture, observation: PyTree
    ) -> ParticleMixture:
        """Resample every component that is due, looking ahead to y_t."""
        log_factors = self._log_factors(mixture, observation)
        # Resampling may lose a NaN, or a particle whose look-ahead is infinite.
        broken = jnp.any(mixture.occupied & ~(log_factors < jnp.inf))
        due = self.resample.would_resample(mixture.weighed(log_factors))
        log_factors = jnp.where(spread(due, mixture.component_indicators), log_factors, 0.0)
        drawn, ancestors = self.resample.redraw(key, mixture.weighed(log_factors), due)
        drawn = drawn.weighed(-take(log_factors, ancestors.particles))
        return drawn.replace(log_weights=jnp.where(broken, jnp.nan, drawn.log_weights))

    def _log_factors(self, mixture: ParticleMixture, observation: PyTree) -> Float[Array, " n"]:
        """log ν of each particle, zero in a component where ν is zero throughout."""
        look: Any = self.lookahead
        if hasattr(look, "at_step_of"):
            look = look.at_step_of(mixture)
        with saying("in lookahead, which is called with an observation and the particles"):
            look = getattr(look, "log_normaliser", look)
            values = look(observation, mixture.particles)
        values = real_each(values, mixture.num_particles, "lookahead: it")
        log_factors = values.astype(mixture.log_weights.dtype)
        seen = mixture.weighed(log_factors).active
        is_seen = spread(seen, mixture.component_indicators) | ~(log_factors < jnp.inf)
        return jnp.where(is_seen, log_factors, 0.0)
