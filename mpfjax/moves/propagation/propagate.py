"""Propagation from t-1 to t: the bootstrap proposal, and any proposal with a density."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Key, PyTree

from mpfjax.checks import Renamed
from mpfjax.mixture import ParticleMixture
from mpfjax.models.base import check_moved, require, require_noise
from mpfjax.models.law import Law
from mpfjax.models.noise import Noise, draw_noise, noise_dtype
from mpfjax.moves.base import (
    AbstractPropagation,
    AbstractPropagationOfEach,
    AbstractProposal,
    Gradient,
    Step,
)
from mpfjax.operations.logarithms import add_gradient, without_gradient


class Draw(AbstractPropagation):
    """x_t drawn by the model's own law or a proposal, and what it weighs."""

    proposal: AbstractProposal | None = None
    gradient: Gradient = eqx.field(static=True, default="none", kw_only=True)
    noise: Noise = eqx.field(static=True, default="independent", kw_only=True)

    approximate = False
    biases_score = False

    def check(self, now: Step, num_particles: int, num_components: int) -> None:
        """Raise a `ValueError` for a model that lacks what the arguments need."""
        model, proposal, needs_noise = now.model, self.proposal, self.noise != "independent"
        if proposal is not None:
            proposal.check(now)
        has_density = now.law.has_density
        if not has_density and (self.gradient == "stop" or proposal is not None):
            require(model, "log_transition", "gradient='stop' or a proposal")
        if needs_noise and proposal is not None:
            require(proposal, "propose_from_noise", f"noise={self.noise!r}", "proposal")
        elif needs_noise and not has_density:
            require_noise(model, f"noise={self.noise!r}")

    def __call__(self, key: Key[Array, ""], mixture: ParticleMixture, now: Step) -> ParticleMixture:
        """Propagate every particle and weigh it by y_t; without it, by the model's own law."""
        proposal, previous, law = self.proposal, mixture.particles, now.law
        if proposal is None or now.is_missing:
            mixture = predict(key, law, mixture, self.gradient, self.noise)
            return mixture if now.is_missing else self.reweight(mixture, now)
        draws, log_density = _propose(proposal, key, self.noise, mixture, now)
        check_moved(draws, law.part(previous), proposal, "propose")
        if self.gradient == "stop":
            draws, log_density = without_gradient((draws, log_density))
        mixture = mixture.replace(particles=law.complete(draws, previous))
        return self.reweight(mixture, now, previous, log_density)

    weighed = Renamed("weighed", "reweight")

    def reweight(
        self,
        mixture: ParticleMixture,
        now: Step,
        previous: PyTree = None,
        log_density: Float[Array, " n"] | None = None,
    ) -> ParticleMixture:
        """The weights of x_t times L, and D / q where each has been drawn with a log q."""
        log_factors = []
        if log_density is not None:
            draws = now.law.part(mixture.particles)
            log_factors = [now.law.log_transition(draws, previous) - log_density]
        return weigh(mixture, now, *log_factors) if self.weighs else mixture.reweight(*log_factors)

    def around(self, reference: Any) -> AbstractPropagation:
        """The move around the trajectory, where noise and proposal allow it."""
        return reference.propagation(self)


class Propagate(Draw, AbstractPropagationOfEach):
    """Draw x_t and multiply the weights by L(y_t | x_t) D(x_t | x_{t-1}) / q(x_t | x_{t-1}, y_t).

    This is the weight update of Vermaak et al. (2003), section 3. With joint weights, ordinary
    normalisation also updates the mixture weights (eq. 4). Without a proposal, q is the dynamics D,
    and the factor is L alone. With a proposal it is the guided filter. Use one if the likelihood is
    much narrower than the dynamics.

    For an `AbstractConditionallyLinearModel`, where it is also called `PropagateMarginalised`, it
    is the step of a Rao-Blackwellised particle filter, or mixture Kalman filter (Chen and Liu 2000;
    Doucet, de Freitas, Murphy and Russell 2000). Each particle (z, m, P) draws z_t, its Kalman
    filter predicts x_t, and the weight is multiplied by

        p(y_t | z_0, ..., z_t, y_1..y_{t-1}) = N(y_t; H m + c, H P Hᵀ + R)

    and by the likelihood of observations of z_t alone. Then the Kalman filter is updated, in
    Joseph's form, which keeps P positive in float32. In the mixed form, z_t is drawn from its
    distribution given y_1..y_{t-1}, N(f + A m, A P Aᵀ + V), and first updates x_{t-1}.

    - `proposal`: q, an `AbstractProposal`. For a conditionally linear model it proposes z_t, such
      as `RegimeProposal()`, from the particles (latent, mean, covariance) of t - 1.
    - `gradient`: what is differentiated; the values are the same. "none" differentiates the draw
      x_t = f(x_{t-1}, noise; θ). "stop" treats the draw as a constant and the factor as L D / ⊥q,
      where ⊥ is `stop_gradient` (Ścibior and Wood 2021). Parameters of D then have a gradient
      through its density, and parameters of q have none. The draw of x_0, and the moments of a
      conditionally linear model, are differentiated in both cases.
    - `noise`: the noise of x_t. "independent": each particle has independent noise, drawn by the
      model's `sample_transition` or by the proposal. "rqmc" distributes the noise evenly over the
      slots of each component. The distribution of every single particle does not change, so Ẑ
      remains unbiased. The noise is a randomised point set over slot and noise, a Sobol set for
      noise of two dimensions or more (L'Ecuyer, Lécot and Tuffin 2008; Gerber and Chopin 2015). The
      gain is largest if a `Resample(along_curve=True)` has ordered the particles in the same step.
      If none has, as without an observation, the points are assigned at random, and errors are
      about as large as with independent noise. Use it if mixture weights and likelihoods must be
      accurate.

    Raises `ValueError` for another gradient or noise; in a filter, for a proposal, or "stop", with
    a model that has no `log_transition`; and for noise that is not independent, with a model that
    has no `transition_from_noise`, or a proposal that has no `propose_from_noise`.
    """


class Predict(Draw):
    """Draw x_t and multiply the weights by D / q alone: the first half of a `Propagate`.

    `Reweight` is the second half. Use the two in a chain with other moves in between, such as
    redrawing the prediction from its Gaussian (Lin et al. 2012, section 4, step 3). The arguments
    and errors are those of `Propagate`; without a proposal the weights do not change.
    """

    weighs = False
    """the likelihood of the observation changes no weight."""


class Reweight(AbstractPropagation):
    """Multiply the weights by L(y_t | x_t): the second half of a bootstrap `Propagate`.

    Use it after `Predict` and moves that change the prediction.
    """

    approximate = False
    biases_score = False

    def around(self, reference: Any) -> "Reweight":
        """The move itself, which weighs the trajectory as any other."""
        return self

    def __call__(self, key: Key[Array, ""], mixture: ParticleMixture, now: Step) -> ParticleMixture:
        """Reweight every particle by y_t, unless it is missing."""
        return mixture if now.is_missing else weigh(mixture, now)


def weigh(mixture: ParticleMixture, now: Step, *log_factors: Array) -> ParticleMixture:
    """The particles of x_t updated and weighted by y_t, and by further factors."""
    states, log_likelihoods = now.law.see(now.observation, mixture.particles)
    return mixture.replace(particles=states).reweight(*log_likelihoods, *log_factors)


def _propose(
    proposal: Any, key: Key[Array, ""], noise: str, mixture: ParticleMixture, now: Step
) -> tuple[PyTree, Float[Array, " n"]]:
    """x_t of every particle, and log q of each."""
    previous = mixture.particles
    if noise == "independent":
        return proposal.propose(key, now, previous)
    points = noise_of_slots(key, noise, proposal.noise_dimension(previous), mixture)
    return proposal.propose_from_noise(points, now, previous)


def noise_of_slots(
    key: Key[Array, ""], kind: str, dimension: int, mixture: ParticleMixture
) -> Float[Array, "n k"]:
    """Noise for every slot; its points are those of the slot's component."""
    shape, dtype = (mixture.num_particles, dimension), noise_dtype(mixture.particles)
    labels, num_components = mixture.component_indicators, mixture.num_components
    shuffle = not mixture.in_order
    return draw_noise(key, kind, shape, dtype, labels, num_components, shuffle)


def predict(
    key: Key[Array, ""], law: Law, mixture: ParticleMixture, gradient: str, noise: str
) -> ParticleMixture:
    """Draws of x_t, with the weights' derivatives times D / ⊥D where the draws have none."""
    states, log_weights = mixture.particles, mixture.log_weights
    # The noise may be that of a proposal alone.
    if noise != "independent" and law.is_of_noise:
        draws = law.make(noise_of_slots(key, noise, law.noise_dimension(states), mixture), states)
    else:
        draws = law.draw(key, states)
    if gradient == "stop":
        draws = without_gradient(draws)
        log_density = law.log_transition(draws, states).astype(log_weights.dtype)
        log_weights = add_gradient(log_weights, jnp.where(mixture.occupied, log_density, 0.0))
    return mixture.replace(particles=law.complete(draws, states), log_weights=log_weights)
