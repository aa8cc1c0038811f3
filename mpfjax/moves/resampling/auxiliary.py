"""Resampling with a look-ahead: the auxiliary particle filter as a move."""

from typing import Annotated, Any

import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from mpfjax.checks import Rule, saying
from mpfjax.mixture import ParticleMixture
from mpfjax.models.base import real_each
from mpfjax.moves.base import AbstractWrapper, Step, unless_waiting
from mpfjax.moves.resampling.resample import Resample
from mpfjax.operations.segments import spread
from mpfjax.operations.stored import take

_LOOKAHEAD = Rule(
    lambda look: (
        not isinstance(look, type)
        and (callable(look) or hasattr(look, "log_normaliser") or hasattr(look, "log_factors"))
    ),
    "a function of an observation and states, nor a proposal with log_normaliser",
)


class AuxiliaryResample(AbstractWrapper):
    """Resample in proportion to w_i ν(y_t, x_{t-1}^i), and divide the weights by ν again.

    The first stage of the auxiliary particle filter (Pitt and Shephard 1999). The look-ahead ν
    predicts how well each particle will explain y_t, and particles with a larger ν have more
    offspring before anything is drawn at t. The distribution is unchanged in expectation for any ν:
    a particle with k times as many offspring has offspring with 1 / k of the weight. Ẑ remains
    unbiased. Unlike in `Resample`, the weight of a component changes. All resampling is within
    components.

    - `resample`: the `Resample` that draws; its `ess_threshold` applies to the weights times ν.
    - `lookahead`: a function (y_t, states) -> log ν of each particle, (n,); a proposal that has
      `log_normaliser`, such as `GaussNewtonProposal`; or an object that has `log_factors(mixture,
      now)`, such as a learned look-ahead. The best ν is p(y_t | x_{t-1}). It must be positive for
      every particle that can explain y_t, and its tails no lighter than those of p(y_t | x_{t-1}):
      an overconfident ν leaves most of the weight to a few particles. If ν is zero for all
      particles of a component, the component is resampled by w alone.

    Without an observation nothing is resampled. Raises `ValueError` for a look-ahead that is
    neither a function nor such a proposal. Use it, with a proposal of the same kind, if the
    likelihood is narrow.
    """

    resample: Resample
    lookahead: Annotated[Any, _LOOKAHEAD]

    holds = ("resample",)
    weighs = False
    """the weights are divided by the look-ahead again."""
    keeps_mass = False
    """but what a component weighs is only the same in expectation."""

    def check(self, now: Step, num_particles: int, num_components: int) -> None:
        """Raise a `ValueError` for a model that the look-ahead does not support."""
        super().check(now, num_particles, num_components)
        if hasattr(self.lookahead, "check"):
            self.lookahead.check(now)

    def __call__(self, key: Key[Array, ""], mixture: ParticleMixture, now: Step) -> ParticleMixture:
        """Resample every component that is due, looking ahead to y_t, unless that is missing."""
        if now.is_missing:
            return mixture
        log_factors = self._log_factors(mixture, now)
        # Resampling may lose a NaN, or a particle whose look-ahead is infinite.
        broken = jnp.any(mixture.occupied & ~(log_factors < jnp.inf))
        due = self.resample.due(mixture.reweight(log_factors))
        log_factors = jnp.where(spread(due, mixture.component_indicators), log_factors, 0.0)
        result, ancestors = self.resample.redraw(key, mixture.reweight(log_factors), due)
        result = result.reweight(-take(log_factors, ancestors.particles))
        result = result.replace(log_weights=jnp.where(broken, jnp.nan, result.log_weights))
        return unless_waiting(result, mixture)

    def _log_factors(self, mixture: ParticleMixture, now: Step) -> Float[Array, " n"]:
        """log ν of each particle, zero in a component where ν is zero throughout."""
        with saying("lookahead", "called with an observation and the particles"):
            values = _log_nu(self.lookahead, mixture, now)
        values = real_each(values, mixture.num_particles, "lookahead: it")
        log_factors = values.astype(mixture.log_weights.dtype)
        has_any = mixture.reweight(log_factors).active
        counts = spread(has_any, mixture.component_indicators) | ~(log_factors < jnp.inf)
        return jnp.where(counts, log_factors, 0.0)


def _log_nu(look: Any, mixture: ParticleMixture, now: Step) -> Any:
    """What the look-ahead returns: one of a mixture, a proposal, or a function."""
    if hasattr(look, "log_factors"):
        return look.log_factors(mixture, now)
    if hasattr(look, "log_normaliser"):
        return look.log_normaliser(now, mixture.particles)
    return look(now.observation, mixture.particles)
