"""Propagation from t-1 to t: the bootstrap proposal, and any proposal with its own density."""

from typing import cast

import jax.numpy as jnp
from jaxtyping import Array, Float, Key, PyTree

from mpfjax.mixture import ParticleMixture
from mpfjax.models.base import AbstractStateSpaceModel, HasTransitionDensity, require
from mpfjax.moves.base import AbstractPropagation
from mpfjax.proposals import AbstractProposal


class Propagate(AbstractPropagation):
    """Draw x_t and multiply the weights by L(y_t | x_t) D(x_t | x_{t-1}) / q(x_t | x_{t-1}, y_t).

    The weight update of Vermaak et al. (2003), section 3. On joint weights it performs the update
    of the mixture weights (eq. 4) as well: that is ordinary normalisation. Without a proposal q
    is the dynamics D, and the factor is L alone; with one it is the guided filter, worth it
    where the likelihood is much narrower than the dynamics.

    Raises `ValueError` for a proposal with a model that has no `log_transition`.
    """

    model: AbstractStateSpaceModel
    proposal: AbstractProposal | None = None

    def __check_init__(self) -> None:
        if self.proposal is not None:
            require(self.model, "log_transition", f"proposal {type(self.proposal).__name__}")

    def __call__(
        self, key: Key[Array, ""], mixture: ParticleMixture, observation: PyTree
    ) -> ParticleMixture:
        """Propagate every particle and weigh it by y_t."""
        previous = mixture.particles
        if self.proposal is None:
            states = self.model.sample_transition(key, previous)
            log_factors = self._log_likelihood(observation, states, mixture)
        else:
            states, log_density = self.proposal.propose(key, observation, previous)
            log_factors = self._log_likelihood(observation, states, mixture)
            dynamics = cast(HasTransitionDensity, self.model)
            log_factors += dynamics.log_transition(states, previous) - log_density
        log_factors = log_factors.astype(mixture.log_weights.dtype)
        # An empty slot stays empty whatever the model makes of its stale state.
        log_weights = jnp.where(mixture.occupied, mixture.log_weights + log_factors, -jnp.inf)
        return mixture.replace(particles=states, log_weights=log_weights)

    def predict(self, key: Key[Array, ""], mixture: ParticleMixture) -> ParticleMixture:
        """Draw x_t ~ D(. | x_{t-1}) and leave the weights, for a step without an observation."""
        return mixture.replace(particles=self.model.sample_transition(key, mixture.particles))

    def _log_likelihood(
        self, observation: PyTree, states: PyTree, mixture: ParticleMixture
    ) -> Float[Array, " n"]:
        values = self.model.log_likelihood(observation, states)
        if values.shape != (mixture.num_particles,):
            raise ValueError(
                f"model: {type(self.model).__name__}.log_likelihood returned shape {values.shape},"
                f" not one value a particle, ({mixture.num_particles},)"
            )
        return values
