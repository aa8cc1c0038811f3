"""Propagation from t-1 to t: the bootstrap proposal, and any proposal with its own density."""

from typing import cast

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key, PyTree

from mpfjax.checks import check_one_of, check_type, saying
from mpfjax.mixture import ParticleMixture
from mpfjax.models.base import (
    AbstractStateSpaceModel,
    HasTransitionDensity,
    check_log_density,
    check_model,
    check_moved,
    model_name,
    require,
)
from mpfjax.moves.base import AbstractPropagation
from mpfjax.operations.gradients import add_gradient
from mpfjax.proposals import AbstractProposal


class Propagate(AbstractPropagation):
    """Draw x_t and multiply the weights by L(y_t | x_t) D(x_t | x_{t-1}) / q(x_t | x_{t-1}, y_t).

    This is the weight update of Vermaak et al. (2003), section 3. With joint weights, ordinary
    normalisation then updates the mixture weights as well (eq. 4). Without a proposal, q is the
    dynamics D, and the factor is L alone. With a proposal it is the guided filter. Use one where
    the likelihood is much narrower than the dynamics.

    - `gradient`: what a derivative sees; the values are the same. "none" differentiates the draw
      x_t = f(x_{t-1}, noise; θ). "stop" treats the draw as a constant and the factor as L D / ⊥q,
      where ⊥ is `stop_gradient` (Ścibior and Wood 2021). Parameters of D then have a gradient
      through its density, and parameters of q have none. The draw of x_0 is still
      differentiated.

    Raises `ValueError` for another gradient, and for a proposal, or "stop", with a model that has
    no `log_transition`.
    """

    model: AbstractStateSpaceModel
    proposal: AbstractProposal | None = None
    gradient: str = eqx.field(static=True, default="none")

    def __check_init__(self) -> None:
        check_model(self.model, type(self).__name__)
        check_propagated_gradient(self.gradient, self.model)
        if self.proposal is not None:
            what = "a proposal, such as GaussNewtonProposal(model)"
            check_type(AbstractProposal, what, proposal=self.proposal)
            require(self.model, "log_transition", f"proposal {type(self.proposal).__name__}")

    def __call__(
        self, key: Key[Array, ""], mixture: ParticleMixture, observation: PyTree
    ) -> ParticleMixture:
        """Propagate every particle and weigh it by y_t."""
        if self.proposal is None:
            return _weigh(self.model, self.predict(key, mixture), observation)
        previous = mixture.particles
        states, log_density = self.proposal.propose(key, observation, previous)
        check_moved(states, previous, self.proposal, "propose")
        if self.gradient == "stop":
            states, log_density = jax.lax.stop_gradient((states, log_density))
        log_ratio = log_transition(self.model, states, previous) - log_density
        return _weigh(self.model, mixture.replace(particles=states), observation, log_ratio)

    def predict(self, key: Key[Array, ""], mixture: ParticleMixture) -> ParticleMixture:
        """Draw x_t ~ D(. | x_{t-1}) and leave the weights, for a step without an observation."""
        return predict(key, self.model, mixture, self.gradient)


class Predict(AbstractPropagation):
    """Draw x_t ~ D(. | x_{t-1}) and leave the weights: the first half of a bootstrap `Propagate`.

    `Weigh` is the second half. Use the two in a chain that does something in between, such as
    redrawing the prediction from its Gaussian (Lin et al. 2012, section 4, step 3). `gradient` and
    the errors are those of `Propagate`.
    """

    model: AbstractStateSpaceModel
    gradient: str = eqx.field(static=True, default="none")

    def __check_init__(self) -> None:
        check_model(self.model, type(self).__name__)
        check_propagated_gradient(self.gradient, self.model)

    def __call__(
        self, key: Key[Array, ""], mixture: ParticleMixture, observation: PyTree
    ) -> ParticleMixture:
        """Propagate every particle; the observation plays no part."""
        del observation
        return self.predict(key, mixture)

    def predict(self, key: Key[Array, ""], mixture: ParticleMixture) -> ParticleMixture:
        """The same without an observation."""
        return predict(key, self.model, mixture, self.gradient)


class Weigh(AbstractPropagation):
    """Multiply the weights by L(y_t | x_t): the second half of a bootstrap `Propagate`.

    Use it after `Predict` and what a chain does to the prediction.
    """

    model: AbstractStateSpaceModel

    def __check_init__(self) -> None:
        check_model(self.model, "Weigh")

    def __call__(
        self, key: Key[Array, ""], mixture: ParticleMixture, observation: PyTree
    ) -> ParticleMixture:
        """Weigh every particle by y_t."""
        del key
        return _weigh(self.model, mixture, observation)

    def predict(self, key: Key[Array, ""], mixture: ParticleMixture) -> ParticleMixture:
        """The mixture as it is: there is nothing to weigh by."""
        del key
        return mixture


def check_propagated_gradient(gradient: str, model: object) -> None:
    """Raise a `ValueError` for an unknown gradient, or one whose density the model lacks."""
    check_one_of(("none", "stop"), gradient=gradient)
    if gradient == "stop":
        require(model, "log_transition", "gradient='stop'")


def predict(
    key: Key[Array, ""], model: AbstractStateSpaceModel, mixture: ParticleMixture, gradient: str
) -> ParticleMixture:
    """Draws of x_t, with the weights' derivatives times D / ⊥D where the draws have none."""
    states = model.sample_transition(key, mixture.particles)
    check_moved(states, mixture.particles, model)
    if gradient == "none":
        return mixture.replace(particles=states)
    states = jax.lax.stop_gradient(states)
    log_density = log_transition(model, states, mixture.particles)
    log_density = jnp.where(mixture.occupied, log_density.astype(mixture.log_weights.dtype), 0.0)
    return mixture.replace(
        particles=states, log_weights=add_gradient(mixture.log_weights, log_density)
    )


def log_transition(
    model: AbstractStateSpaceModel, states: PyTree, previous_states: PyTree
) -> Float[Array, " n"]:
    """log D of each particle, checked."""
    values = cast(HasTransitionDensity, model).log_transition(states, previous_states)
    num_particles = jax.tree.leaves(states)[0].shape[0]
    return check_log_density(values, model, "log_transition", num_particles)


def _weigh(
    model: AbstractStateSpaceModel,
    mixture: ParticleMixture,
    observation: PyTree,
    log_ratio: Float[Array, " n"] | None = None,
) -> ParticleMixture:
    """The weights times L, and times D / q where the draw was not from D."""
    leaves = [f"{leaf.dtype}{list(leaf.shape)}" for leaf in jax.tree.leaves(observation)]
    seen = f"{', '.join(leaves)} in {jax.tree.structure(observation)}"
    who = f"model: {model_name(model)}.log_likelihood"
    with saying(f"in {who}, of an observation (a step of the observations) that is {seen}"):
        log_factors = model.log_likelihood(observation, mixture.particles)
    log_factors = check_log_density(log_factors, model, "log_likelihood", mixture.num_particles)
    return mixture.weighed(*[log_factors] if log_ratio is None else [log_factors, log_ratio])
