"""A look-ahead that is computed from a reparameterised model alone."""

import abc
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from mpfjax.mixture import ParticleMixture
from mpfjax.models.base import require_noise
from mpfjax.models.law import refuse_marginalised
from mpfjax.models.noise import noise_dtype
from mpfjax.moves.base import AbstractProposal, Given, Step
from mpfjax.moves.initial import selection_weights


class AbstractLookahead(Given):
    """A look-ahead ν to y_t that depends on the step, or on the whole mixture."""

    def check(self, now: Step) -> None:
        """Raise a `ValueError` for a model that it does not support; most support any."""

    @abc.abstractmethod
    def log_factors(self, mixture: ParticleMixture, now: Step) -> Float[Array, " n"]:
        """log ν of each particle."""


class PilotLookahead(AbstractLookahead):
    """The likelihoods of two possible successors of each particle, trusted as far as they agree.

    For `lookahead` of `mixture_particle_filter`, `auxiliary_particle_filter` and
    `AuxiliaryResample`. Each particle is propagated twice, by noise of +1 and of -1 in every
    dimension. These are the nodes of the two-point Gaussian quadrature if the noise has one
    dimension. Let L̄_i be the mean of both likelihoods, L̄ the mean over all particles, and r the
    correlation of the two over the weighted particles. Then ν_i = 1 + ρ (L̄_i / L̄ - 1), where ρ =
    2 r / (1 + r) is the reliability of L̄_i (Spearman 1910; Brown 1910), at least 0 and at most
    3/4. If the transition density is broader than the likelihood, the two do not agree, and nothing
    is selected: ν = 1. ν is at least 1/4, so that no weight grows by more than a factor of four.

    It requires no random numbers and only the model, and evaluates two transitions and two
    likelihoods per particle. Raises `ValueError` in a filter of a model without
    `transition_from_noise`. Use it if the transition density is narrow compared with the
    likelihood, in several dimensions, above all with `noise="rqmc"`.
    """

    def check(self, now: Step) -> None:
        """Raise a `ValueError` for a model that is not reparameterised."""
        refuse_marginalised(now.model, "PilotLookahead")
        require_noise(now.model, "PilotLookahead")

    def log_factors(self, mixture: ParticleMixture, now: Step) -> Float[Array, " n"]:
        """log ν of each particle, by the weights of the mixture."""
        law, states = now.law, mixture.particles
        shape = (mixture.num_particles, law.noise_dimension(states))
        ones = jnp.ones(shape, noise_dtype(states))
        looks = [
            law.log_likelihood(now.observation, law.make(noise, states)) for noise in (ones, -ones)
        ]
        # Any ν is exact, so that its derivative is not needed.
        return jax.lax.stop_gradient(jnp.log(selection_weights(jnp.stack(looks), mixture.weights)))


Lookahead = AbstractProposal | AbstractLookahead | Callable[[PyTree, PyTree], Array]
