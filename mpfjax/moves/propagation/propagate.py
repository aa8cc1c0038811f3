"""Propagation from t-1 to t: the bootstrap proposal, and any proposal with its own density."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Key, PyTree

from mpfjax.checks import Exponent, check
from mpfjax.mixture import ParticleMixture
from mpfjax.models.base import (
    AbstractStateSpaceModel,
    check_moved,
    is_made_of_noise,
    require,
    require_noise,
)
from mpfjax.models.conditionally_linear import (
    AbstractConditionallyLinearModel,
    is_mixed,
    refuse_marginalised,
)
from mpfjax.models.noise import Noise, draw_noise, noise_dtype
from mpfjax.models.steps import (
    completed,
    drawn,
    drawn_part,
    likelihoods,
    log_transition,
    made_of,
    noise_dimension,
    seen,
)
from mpfjax.moves.base import (
    AbstractPropagation,
    AbstractPropagationOfEach,
    Gradient,
    Step,
    is_missing,
)
from mpfjax.moves.conditional import ConditionalPropagation, Reference
from mpfjax.moves.propagation.proposals import AbstractProposal
from mpfjax.operations.logarithms import add_gradient, finite_max, without_gradient


class _Propagation(AbstractPropagation):
    """x_t drawn by the model's own law or a proposal, and what it weighs."""

    proposal: AbstractProposal | None = None
    gradient: Gradient = eqx.field(static=True, default="none", kw_only=True)
    noise: Noise = eqx.field(static=True, default="independent", kw_only=True)

    def check(self, now: Step, num_particles: int, num_components: int) -> None:
        """Raise a `ValueError` for a model that lacks what the arguments need."""
        model, proposal, needs_noise = now.model, self.proposal, self.noise != "independent"
        if proposal is not None:
            proposal.check(now)
        # The mixed form has the law of z_t and its noise whatever the model's methods are.
        has_law = is_mixed(model)
        if not has_law and (self.gradient == "stop" or proposal is not None):
            require(model, "log_transition", "gradient='stop' or a proposal")
        if needs_noise and proposal is not None:
            require(proposal, "propose_from_noise", f"noise={self.noise!r}", "proposal")
        elif needs_noise and not has_law:
            require_noise(model, f"noise={self.noise!r}")

    def __call__(self, key: Key[Array, ""], mixture: ParticleMixture, now: Step) -> ParticleMixture:
        """Propagate every particle and weigh it by y_t; without it, by the model's own law."""
        proposal, previous = self.proposal, mixture.particles
        if proposal is None or is_missing(now):
            moved = predict(key, now.model, mixture, self.gradient, self.noise)
            return moved if is_missing(now) else self.weighed(moved, now)
        if self.noise == "independent":
            draws, log_density = proposal.propose(key, now, previous)
        else:
            of_noise: Any = proposal
            noise = noise_of_slots(key, self.noise, of_noise.noise_dimension(previous), mixture)
            draws, log_density = of_noise.propose_from_noise(noise, now, previous)
        check_moved(draws, drawn_part(now.model, previous), proposal, "propose")
        if self.gradient == "stop":
            draws, log_density = without_gradient((draws, log_density))
        moved = mixture.replace(particles=completed(now.model, draws, previous))
        return self.weighed(moved, now, previous, log_density)

    def weighed(
        self,
        mixture: ParticleMixture,
        now: Step,
        previous: PyTree = None,
        log_density: Float[Array, " n"] | None = None,
    ) -> ParticleMixture:
        """The weights of x_t times L, and D / q where each has been drawn with a log q."""
        states, log_factors = mixture.particles, []
        if self.weighs:
            states, log_factors = seen(now.model, now.observation, states)
        if log_density is not None:
            draws = drawn_part(now.model, mixture.particles)
            log_factors.append(log_transition(now.model, draws, previous) - log_density)
        return mixture.replace(particles=states).weighed(*log_factors)

    def around(self, reference: Reference) -> ConditionalPropagation:
        """The same around the trajectory, where noise and proposal allow it."""
        return ConditionalPropagation(self, reference)


class Propagate(_Propagation, AbstractPropagationOfEach):
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

    Raises `ValueError` for another gradient or noise; in a filter, for a proposal, or "stop", with
    a model that has no `log_transition`; and for noise that is not independent, with a model that
    has no `transition_from_noise`, or a proposal that has no `propose_from_noise`.
    """


class PropagateMarginalised(_Propagation, AbstractPropagationOfEach):
    """Draw z_t, predict, weigh by the predictive density of y_t, and update by it.

    The step of a Rao-Blackwellised particle filter, or mixture Kalman filter (Chen and Liu 2000;
    Doucet, de Freitas, Murphy and Russell 2000), for an `AbstractConditionallyLinearModel`. Each
    particle (z, m, P) draws z_t, and its Kalman filter predicts x_t. The weight is multiplied by

        p(y_t | z_0, ..., z_t, y_1..y_{t-1}) = N(y_t; H m + c, H P Hᵀ + R)

    and by the likelihood of what is seen of z_t alone. Then the Kalman filter is updated. Joint
    weights then have their mixture weights updated as in `Propagate`, and Ẑ is unbiased. In the
    mixed form, z_t is drawn from its law given y_1..y_{t-1}, N(f + A m, A P Aᵀ + V), and first
    updates x_{t-1}. The covariance is updated in Joseph's form, which keeps it positive in float32.

    - `proposal`: z_t ~ q in place of its own law, as `RegimeProposal()`. An `AbstractProposal`
      whose `propose(key, now, particles)` is given the particles (latent, mean,
      covariance) of t - 1, and returns z_t and log q. The factor is then p(y_t | ...) p(z_t) / q.
    - `gradient`, `noise`: those of `Propagate`, of the draw of z_t. Moments are differentiated.

    Without an observation z_t is drawn by its own law, and moments are predicted. Raises
    `ValueError` for another model, and as `Propagate` does. `particle_filter`,
    `mixture_particle_filter` and `auxiliary_particle_filter` use it for such a model.
    """

    def check(self, now: Step, num_particles: int, num_components: int) -> None:
        """Raise a `ValueError` for another model, and as `Propagate` does."""
        check(AbstractConditionallyLinearModel, model=now.model)
        super().check(now, num_particles, num_components)


class Predict(_Propagation):
    """Draw x_t and multiply the weights by D / q alone: the first half of a `Propagate`.

    `Reweight` is the second half. Use the two in a chain that does something in between, such as
    redrawing the prediction from its Gaussian (Lin et al. 2012, section 4, step 3). The arguments
    and errors are those of `Propagate`; without a proposal the weights stay as they are.
    """

    weighs = False
    """the likelihood of the observation changes no weight."""


class Reweight(AbstractPropagation):
    """Multiply the weights by L(y_t | x_t): the second half of a bootstrap `Propagate`.

    `exponent` is β where the factor is L^β: the likelihood enters by powers, with other moves
    between them. The exponents of a chain's `Reweight` add up to 1. Raises `ValueError` for one not
    in (0, 1]. Use it after `Predict` and what a chain does to the prediction.
    """

    exponent: Exponent = eqx.field(static=True, default=1.0)

    def check(self, now: Step, num_particles: int, num_components: int) -> None:
        """Raise a `ValueError` for a part of a marginalised likelihood."""
        if self.exponent != 1:
            refuse_marginalised(now.model, "a part of the likelihood", "take exponent 1")

    def around(self, reference: Reference) -> "Reweight":
        """The move itself, which weighs the trajectory as any other."""
        return self

    def __call__(self, key: Key[Array, ""], mixture: ParticleMixture, now: Step) -> ParticleMixture:
        """Reweight every particle by y_t, unless it is missing."""
        if is_missing(now):
            return mixture
        if self.exponent == 1:
            states, log_factors = seen(now.model, now.observation, mixture.particles)
            return mixture.replace(particles=states).weighed(*log_factors)
        log_factors = likelihoods(now.model, now.observation, mixture.particles)
        # Differences would be lost to rounding beside a large common constant.
        common = finite_max(jnp.where(mixture.occupied, log_factors, -jnp.inf))
        return mixture.weighed(self.exponent * (log_factors - common), self.exponent * common[None])


def noise_of_slots(
    key: Key[Array, ""], kind: str, dimension: int, mixture: ParticleMixture
) -> Float[Array, "n k"]:
    """Noise for every slot; its points are those of the slot's component."""
    shape, dtype = (mixture.num_particles, dimension), noise_dtype(mixture.particles)
    labels, num_components = mixture.component_indicators, mixture.num_components
    shuffle = not mixture.in_order
    return draw_noise(key, kind, shape, dtype, labels, num_components, shuffle)


def predict(
    key: Key[Array, ""],
    model: AbstractStateSpaceModel,
    mixture: ParticleMixture,
    gradient: str,
    noise: str = "independent",
) -> ParticleMixture:
    """Draws of x_t, with the weights' derivatives times D / ⊥D where the draws have none."""
    states = mixture.particles
    # The noise may be that of a proposal alone.
    if noise != "independent" and (is_mixed(model) or is_made_of_noise(model)):
        numbers = noise_of_slots(key, noise, noise_dimension(model, states), mixture)
        draws = made_of(model, numbers, states)
    else:
        draws = drawn(key, model, states)
    return _moved(draws, model, mixture, gradient)


def _moved(
    draws: PyTree, model: AbstractStateSpaceModel, mixture: ParticleMixture, gradient: str
) -> ParticleMixture:
    """The mixture with these draws, and their density, which "stop" differentiates."""
    previous, log_weights = mixture.particles, mixture.log_weights
    if gradient == "stop":
        draws = without_gradient(draws)
        log_density = log_transition(model, draws, previous).astype(log_weights.dtype)
        log_weights = add_gradient(log_weights, jnp.where(mixture.occupied, log_density, 0.0))
    return mixture.replace(particles=completed(model, draws, previous), log_weights=log_weights)
