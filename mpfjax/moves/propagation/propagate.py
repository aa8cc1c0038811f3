"""Propagation from t-1 to t: the bootstrap proposal, and any proposal with its own density."""

from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key, PyTree

from mpfjax.checks import check_exponent, check_one_of, check_type, saying
from mpfjax.mixture import ParticleMixture
from mpfjax.models.base import (
    AbstractStateSpaceModel,
    HasTransitionDensity,
    HasTransitionNoise,
    check_log_density,
    check_moved,
    is_made_of_noise,
    model_name,
    require,
    require_model,
    require_noise,
)
from mpfjax.models.conditionally_linear import refuse_marginalised
from mpfjax.models.noise import NOISES, draw_noise, noise_dtype
from mpfjax.models.steps import likelihoods
from mpfjax.moves.base import AbstractPropagation
from mpfjax.moves.conditional import ConditionalPropagation, Reference
from mpfjax.operations.logarithms import add_gradient, finite_max
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
    - `noise`: what x_t is made of. "independent": each particle has noise of its own, as the
      model's `sample_transition` or the proposal draws it. "rqmc" spreads the noise evenly over
      the slots of each component. Every particle's own law stays the same, so Ẑ stays unbiased.
      It is a randomised point set over slot and noise, of Sobol for noise of two dimensions or
      more (L'Ecuyer, Lécot and Tuffin 2008; Gerber and Chopin 2015). Most is gained where a
      `Resample(sort_by="hilbert")` has put the particles in order in the same step. Where none
      has, as without an observation, the points are dealt to the particles anew, and errors are
      about those of independent noise. Take it where masses and likelihoods must be accurate.

    Raises `ValueError` for another gradient or noise; for a proposal, or "stop", with a model that
    has no `log_transition`; for noise that is not independent, with a model that has no
    `transition_from_noise`, or a proposal that has no `propose_from_noise`; and for more noise
    dimensions than there are Sobol direction numbers, 64.
    """

    model: AbstractStateSpaceModel
    proposal: AbstractProposal | None = None
    gradient: str = eqx.field(static=True, default="none")
    noise: str = eqx.field(static=True, default="independent")

    def __check_init__(self) -> None:
        _check_whole_states(self.model, type(self).__name__)
        check_propagated_gradient(self.gradient, self.model)
        check_noise(self.noise, self.model, self.proposal)
        if self.proposal is not None:
            what = "a proposal, such as GaussNewtonProposal(model)"
            check_type(AbstractProposal, what, proposal=self.proposal)
            require(self.model, "log_transition", f"proposal {type(self.proposal).__name__}")

    def __call__(
        self, key: Key[Array, ""], mixture: ParticleMixture, observation: PyTree
    ) -> ParticleMixture:
        """Propagate every particle and weigh it by y_t."""
        if self.noise != "independent":
            noise = noise_of_slots(self.noise, key, self.noise_dimension(mixture), mixture)
            return self.from_noise(noise, mixture, observation)
        if self.proposal is None:
            return _weigh(self.model, self.predict(key, mixture), observation)
        drawn = self.proposal.propose(key, observation, mixture.particles)
        return self._weighed(drawn, mixture, observation)

    def from_noise(
        self, noise: Float[Array, "n k"], mixture: ParticleMixture, observation: PyTree
    ) -> ParticleMixture:
        """The same with x_t made of this noise, a row for each slot."""
        if self.proposal is None:
            moved = _made_of(noise, self.model, mixture, self.gradient)
            return _weigh(self.model, moved, observation)
        proposal: Any = self.proposal
        drawn = proposal.propose_from_noise(noise, observation, mixture.particles)
        return self._weighed(drawn, mixture, observation)

    def noise_dimension(self, mixture: ParticleMixture) -> int:
        """k, the number of standard normal numbers that x_t is made of."""
        if self.proposal is None:
            return cast(HasTransitionNoise, self.model).noise_dimension
        proposal: Any = self.proposal
        return proposal.noise_dimension(mixture.particles)

    def predict(self, key: Key[Array, ""], mixture: ParticleMixture) -> ParticleMixture:
        """Draw x_t ~ D(. | x_{t-1}) and leave the weights, for a step without an observation."""
        # The noise may be that of the proposal alone.
        spreads = self.proposal is None or is_made_of_noise(self.model)
        noise = self.noise if spreads else "independent"
        return predict(key, self.model, mixture, self.gradient, noise)

    def _weighed(
        self,
        drawn: tuple[PyTree, Float[Array, " n"]],
        mixture: ParticleMixture,
        observation: PyTree,
    ) -> ParticleMixture:
        """The mixture of the proposal's draws, with the log density of each."""
        (states, log_density), previous = drawn, mixture.particles
        check_moved(states, previous, self.proposal, "propose")
        if self.gradient == "stop":
            states, log_density = jax.lax.stop_gradient((states, log_density))
        return self.weighed(mixture.replace(particles=states), observation, previous, log_density)

    def weighed(
        self,
        mixture: ParticleMixture,
        observation: PyTree,
        previous: PyTree = None,
        log_density: Float[Array, " n"] | None = None,
    ) -> ParticleMixture:
        """The weights of x_t times L, and D / q where each has been drawn with a log q."""
        if log_density is None:
            return _weigh(self.model, mixture, observation)
        log_ratio = log_transition(self.model, mixture.particles, previous) - log_density
        return _weigh(self.model, mixture, observation, log_ratio)

    def around(self, reference: Reference) -> ConditionalPropagation:
        """The same around the trajectory, where noise and proposal allow it."""
        return ConditionalPropagation(self, reference)


class Predict(AbstractPropagation):
    """Draw x_t ~ D(. | x_{t-1}) and leave the weights: the first half of a bootstrap `Propagate`.

    `Reweight` is the second half. Use the two in a chain that does something in between, such as
    redrawing the prediction from its Gaussian (Lin et al. 2012, section 4, step 3). `gradient`,
    `noise` and the errors are those of `Propagate`.
    """

    model: AbstractStateSpaceModel
    gradient: str = eqx.field(static=True, default="none")
    noise: str = eqx.field(static=True, default="independent")

    def __check_init__(self) -> None:
        _check_whole_states(self.model, type(self).__name__)
        check_propagated_gradient(self.gradient, self.model)
        check_noise(self.noise, self.model)

    @property
    def weighs(self) -> bool:
        """False: the observation changes no weight."""
        return False

    def __call__(
        self, key: Key[Array, ""], mixture: ParticleMixture, observation: PyTree
    ) -> ParticleMixture:
        """Propagate every particle; the observation plays no part."""
        del observation
        return self.predict(key, mixture)

    def predict(self, key: Key[Array, ""], mixture: ParticleMixture) -> ParticleMixture:
        """The same without an observation."""
        return predict(key, self.model, mixture, self.gradient, self.noise)

    proposal = None
    """x_t is drawn by the dynamics."""

    def weighed(self, mixture: ParticleMixture, observation: PyTree) -> ParticleMixture:
        """The mixture as it is."""
        del observation
        return mixture

    def around(self, reference: Reference) -> ConditionalPropagation:
        """The same around the trajectory, where the noise allows it."""
        return ConditionalPropagation(self, reference)


class Reweight(AbstractPropagation):
    """Multiply the weights by L(y_t | x_t): the second half of a bootstrap `Propagate`.

    `exponent` is β where the factor is L^β: the likelihood enters by powers, with other moves
    between them. The exponents of a chain's `Reweight` add up to 1. Raises `ValueError` for one not
    in (0, 1]. Use it after `Predict` and what a chain does to the prediction.
    """

    model: AbstractStateSpaceModel
    exponent: float = eqx.field(static=True, default=1.0)

    def __check_init__(self) -> None:
        _check_whole_states(self.model, "Reweight")
        check_exponent(exponent=self.exponent)

    def __call__(
        self, key: Key[Array, ""], mixture: ParticleMixture, observation: PyTree
    ) -> ParticleMixture:
        """Reweight every particle by y_t."""
        del key
        if self.exponent == 1:
            return _weigh(self.model, mixture, observation)
        log_factors = likelihoods(self.model, observation, mixture.particles)
        # Differences would be lost to rounding beside a large common constant.
        common = finite_max(jnp.where(mixture.occupied, log_factors, -jnp.inf))
        return mixture.weighed(self.exponent * (log_factors - common), self.exponent * common[None])

    def predict(self, key: Key[Array, ""], mixture: ParticleMixture) -> ParticleMixture:
        """The mixture unchanged: there is no observation."""
        del key
        return mixture

    def around(self, reference: Reference) -> "Reweight":
        """The move itself, which weighs the trajectory as any other."""
        del reference
        return self


def _check_whole_states(model: Any, needed_by: str) -> None:
    """Raise a `ValueError` for what is no model, or one whose particles carry moments."""
    require_model(model, needed_by)
    refuse_marginalised(model, needed_by)


def check_propagated_gradient(gradient: str, model: object) -> None:
    """Raise a `ValueError` for an unknown gradient, or one whose density the model lacks.

    A model that is None lacks nothing.
    """
    check_one_of(("none", "stop"), gradient=gradient)
    if gradient == "stop" and model is not None:
        require(model, "log_transition", "gradient='stop'")


def check_noise(noise: str, model: object, proposal: object = None) -> None:
    """Raise a `ValueError` for unknown noise, or one that model or proposal cannot be made of."""
    check_one_of(NOISES, noise=noise)
    if noise == "independent":
        return
    if proposal is None:
        if model is not None:
            require_noise(model, f"noise={noise!r}")
        return
    for method in ("propose_from_noise", "noise_dimension"):
        require(proposal, method, f"noise={noise!r}", "proposal")


def noise_of_slots(
    kind: str, key: Key[Array, ""], dimension: int, mixture: ParticleMixture
) -> Float[Array, "n k"]:
    """Noise for every slot; its points are those of the slot's component."""
    shape, dtype = (mixture.num_particles, dimension), noise_dtype(mixture.particles)
    labels, num_components = mixture.component_indicators, mixture.num_components
    shuffle = not mixture.in_order
    return draw_noise(kind, key, shape, dtype, labels, num_components, shuffle)


def predict(
    key: Key[Array, ""],
    model: AbstractStateSpaceModel,
    mixture: ParticleMixture,
    gradient: str,
    noise: str = "independent",
) -> ParticleMixture:
    """Draws of x_t, with the weights' derivatives times D / ⊥D where the draws have none."""
    if noise != "independent":
        dimension = cast(HasTransitionNoise, model).noise_dimension
        return _made_of(noise_of_slots(noise, key, dimension, mixture), model, mixture, gradient)
    states = model.sample_transition(key, mixture.particles)
    check_moved(states, mixture.particles, model)
    return _moved(states, model, mixture, gradient)


def _made_of(
    noise: Float[Array, "n k"],
    model: AbstractStateSpaceModel,
    mixture: ParticleMixture,
    gradient: str,
) -> ParticleMixture:
    """The mixture of x_t made of this noise."""
    who = f"model: {model_name(model)}.transition_from_noise"
    with saying(f"in {who}, of noise of shape {noise.shape}, as noise_dimension says"):
        states = cast(HasTransitionNoise, model).transition_from_noise(noise, mixture.particles)
    check_moved(states, mixture.particles, model, "transition_from_noise")
    return _moved(states, model, mixture, gradient)


def _moved(
    states: PyTree, model: AbstractStateSpaceModel, mixture: ParticleMixture, gradient: str
) -> ParticleMixture:
    """The mixture with these states, and the density that "stop" differentiates."""
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
    log_factors = likelihoods(model, observation, mixture.particles)
    return mixture.weighed(*[log_factors] if log_ratio is None else [log_factors, log_ratio])
