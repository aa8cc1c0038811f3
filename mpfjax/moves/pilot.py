"""A look-ahead that a model made of noise has of itself."""

from collections.abc import Callable
from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from mpfjax.mixture import ParticleMixture
from mpfjax.models.base import AbstractStateSpaceModel, HasTransitionNoise, require_noise
from mpfjax.models.conditionally_linear import refuse_marginalised
from mpfjax.models.noise import noise_dtype
from mpfjax.moves.initial import MOST_TRUST
from mpfjax.moves.propagation.propagate import likelihoods
from mpfjax.operations.logarithms import finite_max


class PilotLookahead(eqx.Module):
    """The likelihoods of two places to which a particle may move, trusted as far as they agree.

    For `lookahead` of `mixture_particle_filter`, `auxiliary_particle_filter` and
    `AuxiliaryResample`. Each particle is moved twice, by noise of +1 and of -1 in every dimension.
    These are the nodes of the Gaussian quadrature of two points if the noise has one dimension. Let
    L̄_i be the mean of both likelihoods, L̄ that of all particles, and r the correlation of the two
    over the weighted particles. Then ν_i = 1 + ρ (L̄_i / L̄ - 1), where ρ = 2 r / (1 + r) is the
    reliability of L̄_i (Spearman 1910; Brown 1910), at least 0 and at most 3/4. Where a step of the
    dynamics is wider than the likelihood, the two do not agree, and nothing is selected: ν = 1.
    ν is at least 1/4, so that no weight grows to more than four times what it was.

    It needs no random numbers and nothing but the model, and costs two transitions and two
    likelihoods a particle. Raises `ValueError` for a model without `transition_from_noise`. Use it
    where a step of the dynamics is narrow beside the likelihood, in several dimensions, above all
    with `noise="rqmc"`.
    """

    model: AbstractStateSpaceModel

    def __check_init__(self) -> None:
        refuse_marginalised(self.model, "PilotLookahead")
        require_noise(self.model, "PilotLookahead")

    def at_step_of(self, mixture: ParticleMixture) -> Callable[[PyTree, PyTree], Array]:
        """(y_t, states) -> log ν, by the weights of the mixture."""
        weights = mixture.weights
        return lambda observation, states: self._log_factors(observation, states, weights)

    def _log_factors(
        self, observation: PyTree, states: PyTree, weights: Float[Array, " n"]
    ) -> Float[Array, " n"]:
        model: Any = cast(HasTransitionNoise, self.model)
        ones = jnp.ones((weights.shape[0], model.noise_dimension), noise_dtype(states))
        seen = [
            likelihoods(self.model, observation, model.transition_from_noise(noise, states))
            for noise in (ones, -ones)
        ]
        # Any ν is exact, so that its derivative is not needed.
        return jax.lax.stop_gradient(jnp.log(_trusted(jnp.stack(seen, axis=1), weights)))


def _trusted(log_factors: Float[Array, "n 2"], weights: Float[Array, " n"]) -> Float[Array, " n"]:
    """ν of each particle, with a weighted mean of 1; impossible particles do not count."""
    counts = (weights > 0)[:, None] & (log_factors < jnp.inf)
    log_factors = jnp.where(counts, log_factors, -jnp.inf)
    values = jnp.exp(log_factors - finite_max(log_factors.ravel()))
    mean = weights @ jnp.mean(values, axis=1) / jnp.sum(weights)
    gaps = values / jnp.where(mean > 0, mean, 1.0) - 1
    shared, total = weights @ (gaps[:, 0] * gaps[:, 1]), weights @ jnp.mean(gaps**2, axis=1)
    correlation = jnp.clip(shared / jnp.where(total > 0, total, 1.0), 0.0, 1.0)
    trust = jnp.minimum(2 * correlation / (1 + correlation), MOST_TRUST)
    return 1 + jnp.where(mean > 0, trust, 0.0) * jnp.mean(gaps, axis=1)
