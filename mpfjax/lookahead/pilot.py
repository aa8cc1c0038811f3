"""A look-ahead that a model made of noise has of itself."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from mpfjax.mixture import ParticleMixture
from mpfjax.models.base import AbstractStateSpaceModel, require_noise
from mpfjax.models.conditionally_linear import refuse_marginalised
from mpfjax.models.noise import noise_dtype
from mpfjax.models.steps import likelihoods
from mpfjax.moves.initial import trusted
from mpfjax.proposals import AbstractProposal


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
        model: Any = self.model

        def look(observation: PyTree, states: PyTree) -> Float[Array, " n"]:
            ones = jnp.ones((mixture.num_particles, model.noise_dimension), noise_dtype(states))
            seen = [
                likelihoods(model, observation, model.transition_from_noise(noise, states))
                for noise in (ones, -ones)
            ]
            # Any ν is exact, so that its derivative is not needed.
            return jax.lax.stop_gradient(jnp.log(trusted(jnp.stack(seen), mixture.weights)))

        return look


Lookahead = AbstractProposal | PilotLookahead | Callable[[PyTree, PyTree], Array]
