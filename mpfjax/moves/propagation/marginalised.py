"""Propagation of a conditionally linear model: the latent is drawn, the rest has moments."""

from typing import Any, cast

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Key, PyTree

from mpfjax.checks import check_type, saying
from mpfjax.mixture import MarginalisedState, ParticleMixture
from mpfjax.models.base import (
    AbstractStateSpaceModel,
    HasTransitionNoise,
    check_moved,
    is_made_of_noise,
    model_name,
    require,
    require_model,
)
from mpfjax.models.conditionally_linear import (
    AbstractConditionallyLinearModel,
    is_mixed,
    latent_from_noise,
    latent_rows,
    log_latent_density,
    predicted,
    require_marginalised,
)
from mpfjax.models.noise import noise_dtype
from mpfjax.models.steps import seen
from mpfjax.moves.base import AbstractPropagation
from mpfjax.moves.propagation.propagate import (
    Propagate,
    check_noise,
    check_propagated_gradient,
    log_transition,
    noise_of_slots,
)
from mpfjax.operations.logarithms import add_gradient, without_gradient
from mpfjax.operations.random import normal
from mpfjax.proposals import AbstractProposal


class PropagateMarginalised(AbstractPropagation):
    """Draw z_t, predict, weigh by the predictive density of y_t, and update by it.

    The step of a Rao-Blackwellised particle filter, or mixture Kalman filter (Chen and Liu 2000;
    Doucet, de Freitas, Murphy and Russell 2000), for an `AbstractConditionallyLinearModel`. Each
    particle (z, m, P) draws z_t, and its Kalman filter predicts x_t. The weight is multiplied by

        p(y_t | z_0, ..., z_t, y_1..y_{t-1}) = N(y_t; H m + c, H P Hᵀ + R)

    and by the likelihood of what is seen of z_t alone. Then the Kalman filter is updated. Joint
    weights then have their mixture weights updated as in `Propagate`, and Ẑ is unbiased. In the
    mixed form, z_t is drawn from its law given y_1..y_{t-1}, N(f + A m, A P Aᵀ + V), and first
    updates x_{t-1}. The covariance is updated in Joseph's form, which keeps it positive in float32.

    - `proposal`: z_t ~ q in place of its own law, as `RegimeProposal(model)`. An `AbstractProposal`
      whose `propose(key, observation, particles)` is given the particles (latent, mean,
      covariance) of t - 1, and returns z_t and log q. The factor is then p(y_t | ...) p(z_t) / q.
    - `gradient`, `noise`: those of `Propagate`, of the draw of z_t. Moments are differentiated.

    Without an observation z_t is drawn by its own law, and moments are predicted. Raises
    `ValueError` for another model, and as `Propagate` does. `particle_filter`,
    `mixture_particle_filter` and `auxiliary_particle_filter` use it for such a model.
    """

    model: AbstractConditionallyLinearModel
    proposal: AbstractProposal | None = None
    gradient: str = eqx.field(static=True, default="none")
    noise: str = eqx.field(static=True, default="independent")

    def __check_init__(self) -> None:
        require_marginalised(self.model, "PropagateMarginalised")
        require_model(self.model, "PropagateMarginalised")
        # The mixed form has the law of z_t and its noise whatever the model's methods are.
        own = None if is_mixed(self.model) else self.model
        check_propagated_gradient(self.gradient, own)
        check_noise(self.noise, own, self.proposal)
        if self.proposal is not None:
            what = "a proposal, such as RegimeProposal(model)"
            check_type(AbstractProposal, what, proposal=self.proposal)
            if own is not None:
                require(own, "log_transition", f"proposal {type(self.proposal).__name__}")

    def __call__(
        self, key: Key[Array, ""], mixture: ParticleMixture, observation: PyTree
    ) -> ParticleMixture:
        """Propagate every particle and weigh it by y_t."""
        if self.noise != "independent":
            noise = noise_of_slots(self.noise, key, self.noise_dimension(mixture), mixture)
            return self.from_noise(noise, mixture, observation)
        if self.proposal is None:
            return _weighed(self.model, self.predict(key, mixture), observation)
        drawn = self.proposal.propose(key, observation, mixture.particles)
        return self._proposed(drawn, mixture, observation)

    def from_noise(
        self, noise: Float[Array, "n k"], mixture: ParticleMixture, observation: PyTree
    ) -> ParticleMixture:
        """The same with z_t made of this noise, a row for each slot."""
        if self.proposal is None:
            return _weighed(self.model, self._made_of(noise, mixture), observation)
        proposal: Any = self.proposal
        drawn = proposal.propose_from_noise(noise, observation, mixture.particles)
        return self._proposed(drawn, mixture, observation)

    def noise_dimension(self, mixture: ParticleMixture) -> int:
        """k, the number of standard normal numbers that z_t is made of."""
        if self.proposal is not None:
            proposal: Any = self.proposal
            return proposal.noise_dimension(mixture.particles)
        return latent_noise_dimension(self.model, mixture.particles)

    def predict(self, key: Key[Array, ""], mixture: ParticleMixture) -> ParticleMixture:
        """Draw z_t by its own law and predict, for a step without an observation."""
        state = mixture.particles
        made_of_noise = is_mixed(self.model) or is_made_of_noise(self.model)
        if self.noise != "independent" and made_of_noise:
            dimension = latent_noise_dimension(self.model, state)
            return self._made_of(noise_of_slots(self.noise, key, dimension, mixture), mixture)
        if is_mixed(self.model):
            shape = (mixture.num_particles, latent_noise_dimension(self.model, state))
            return self._made_of(normal(key, shape, noise_dtype(state)), mixture)
        latent = self.model.sample_transition(key, state.latent)
        check_moved(latent, state.latent, self.model)
        return self._moved(latent, mixture)

    def _made_of(self, noise: Float[Array, "n k"], mixture: ParticleMixture) -> ParticleMixture:
        """The prediction with z_t made of this noise."""
        return self._moved(latent_made_of(self.model, noise, mixture.particles), mixture)

    def _moved(self, latent: PyTree, mixture: ParticleMixture) -> ParticleMixture:
        """The prediction given z_t, and the density of z_t that "stop" differentiates."""
        if self.gradient == "none":
            return mixture.replace(particles=predicted(self.model, latent, mixture.particles))
        latent = without_gradient(latent)
        log_density = log_latent_transition(self.model, latent, mixture.particles)
        log_density = log_density.astype(mixture.log_weights.dtype)
        log_density = jnp.where(mixture.occupied, log_density, 0.0)
        return mixture.replace(
            particles=predicted(self.model, latent, mixture.particles),
            log_weights=add_gradient(mixture.log_weights, log_density),
        )

    def _proposed(
        self,
        drawn: tuple[PyTree, Float[Array, " n"]],
        mixture: ParticleMixture,
        observation: PyTree,
    ) -> ParticleMixture:
        """The mixture of the proposal's draws, with log q of each."""
        (latent, log_density), state = drawn, mixture.particles
        check_moved(latent, state.latent, self.proposal, "propose")
        if self.gradient == "stop":
            latent, log_density = without_gradient((latent, log_density))
        log_ratio = log_latent_transition(self.model, latent, state) - log_density
        moved = mixture.replace(particles=predicted(self.model, latent, state))
        return _weighed(self.model, moved, observation, log_ratio)


def log_latent_transition(
    model: AbstractConditionallyLinearModel, latent: PyTree, state: MarginalisedState
) -> Float[Array, " n"]:
    """log p(z_t | z_{t-1}), in the mixed form also given y_1..y_{t-1}, of each particle."""
    if is_mixed(model):
        return log_latent_density(model, latent, state)
    return log_transition(model, latent, state.latent)


def latent_noise_dimension(
    model: AbstractConditionallyLinearModel, state: MarginalisedState
) -> int:
    """k, the number of standard normal numbers that the model makes z_t of by its own law."""
    if is_mixed(model):
        return latent_rows(model, state.latent).shape[0]
    return cast(HasTransitionNoise, model).noise_dimension


def latent_made_of(
    model: AbstractConditionallyLinearModel, noise: Float[Array, "n k"], state: MarginalisedState
) -> PyTree:
    """z_t of each particle, by its own law, made of this noise."""
    if is_mixed(model):
        return latent_from_noise(model, noise, state)
    who = f"model: {model_name(model)}.transition_from_noise"
    with saying(f"in {who}, of noise of shape {noise.shape}, as noise_dimension says"):
        latent = cast(HasTransitionNoise, model).transition_from_noise(noise, state.latent)
    check_moved(latent, state.latent, model, "transition_from_noise")
    return latent


def _weighed(
    model: AbstractConditionallyLinearModel,
    mixture: ParticleMixture,
    observation: PyTree,
    log_ratio: Float[Array, " n"] | None = None,
) -> ParticleMixture:
    """The predicted mixture updated by y_t, its weights times p(y_t | z), and times p / q."""
    state, log_factors = seen(model, observation, mixture.particles)
    if log_ratio is not None:
        log_factors.append(log_ratio)
    return mixture.replace(particles=state).weighed(*log_factors)


def propagation(
    model: AbstractStateSpaceModel, proposal: AbstractProposal | None
) -> Propagate | PropagateMarginalised:
    """The propagation of x_t for this kind of model."""
    if isinstance(model, AbstractConditionallyLinearModel):
        return PropagateMarginalised(model, proposal)
    return Propagate(model, proposal)
