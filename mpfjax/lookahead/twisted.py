"""Moves of a twisted particle filter, whose look-ahead depends on the step."""

from collections.abc import Callable
from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key, PyTree

from mpfjax.lookahead.pilot import AbstractLookahead
from mpfjax.lookahead.quadratics import LocalQuadratics
from mpfjax.mixture import ParticleMixture
from mpfjax.models.base import check_moved
from mpfjax.models.law import law_of
from mpfjax.models.noise import draw_noise, noise_dtype
from mpfjax.moves.base import (
    AbstractMove,
    AbstractPropagation,
    AbstractRegrouping,
    AbstractWrapper,
    Regrouped,
    Step,
)
from mpfjax.moves.propagation.propagate import noise_of_slots, weigh
from mpfjax.operations.logarithms import log_sum_exp


class Twist(AbstractLookahead):
    """ψ_1, ..., ψ_T for the steps of a series, as `mpfjax.smoothing.learn_lookahead` fits them.

    It is the look-ahead of an `AuxiliaryResample`, ν_t(x_{t-1}) of the step.

    - `steps`: ψ of each step, and one more, ψ = 1, for steps after the last.
    - `initial`: of x_0, which is made of noise alone; None where the model draws it otherwise.
    - `features`: φ, the features of a state that ψ depends on, (n, d).
    """

    steps: LocalQuadratics
    initial: LocalQuadratics | None
    features: Callable[[PyTree], Array]

    def at(self, t: Int[Array, ""]) -> LocalQuadratics:
        """ψ_t."""
        place = jnp.minimum(t - 1, self.steps.log_cap.shape[0] - 1)
        return jax.tree.map(lambda leaf: leaf[place], self.steps)

    def features_of(self, states: PyTree) -> Float[Array, "n d"]:
        """φ(x) of each particle, a row for each."""
        features = jnp.asarray(self.features(states))
        return features.reshape(len(features), -1).astype(noise_dtype(states))

    def log_factors(self, mixture: ParticleMixture, now: Step) -> Float[Array, " n"]:
        """log ν_t(x_{t-1}), whatever y_t is."""
        return self.log_normaliser(mixture.t, mixture)

    def log_normaliser(self, t: Int[Array, ""], mixture: ParticleMixture) -> Float[Array, " n"]:
        """log ν_t of the particles of x_{t-1}."""
        return self.at(t).log_normaliser(self.features_of(mixture.particles))


class TwistInitial(AbstractMove):
    """Draws x_0 anew: its noise from q_0, with the weights N(ε; 0, I) / q_0(ε).

    Their mass is part of the first increment, so that Ẑ stays unbiased.
    """

    twist: Twist
    noise: str = eqx.field(static=True)

    approximate = False

    def __call__(self, key: Key[Array, ""], mixture: ParticleMixture, now: Step) -> ParticleMixture:
        """The mixture of the twisted draws."""
        if self.twist.initial is None:
            return mixture
        psi, model = self.twist.initial, cast(Any, now.model)
        shape, dtype = (mixture.num_particles, model.initial_noise_dimension + 1), psi.slopes.dtype
        noise = draw_noise(key, self.noise, shape, dtype)
        drawn, log_ratio = psi.draw(noise, jnp.zeros((shape[0], 1), dtype))
        states = law_of(model).make_initial(drawn)
        check_moved(states, mixture.particles, model, "initial_from_noise")
        return mixture.replace(particles=states).reweight(log_ratio)


class PropagateTwisted(AbstractPropagation, AbstractWrapper):
    """Draw the noise ε of x_t from q_t(ε | x_{t-1}), and weigh by L(y_t | x_t) N(ε; 0, I) / q_t.

    No density of the dynamics is needed, which may be singular or mixed with discrete draws. For a
    conditionally linear model ε is the noise of z_t, and L is p(y_t | z_0, ..., z_t, y_1..y_{t-1}).
    `move` is the filter's own propagation, which makes x_t of noise.
    """

    move: Any
    twist: Twist

    holds = ("move",)

    def __call__(self, key: Key[Array, ""], mixture: ParticleMixture, now: Step) -> ParticleMixture:
        """Propagate every particle and weigh it by y_t."""
        if now.is_missing:
            return self.move(key, mixture, now)
        law, previous = now.law, mixture.particles
        dimension = law.noise_dimension(previous) + 1
        noise = noise_of_slots(key, self.move.noise, dimension, mixture)
        psi = self.twist.at(mixture.t)
        drawn, log_ratio = psi.draw(noise, self.twist.features_of(previous))
        states = law.complete(law.make(drawn, previous), previous)
        return weigh(mixture.replace(particles=states), now, log_ratio)


class RegroupTwisted(AbstractWrapper, AbstractRegrouping):
    """A regrouping with the weights times ν_{t+1}(x_t), by which the next step resamples.

    Under the weights of the filtering distribution alone few particles carry the mass, because the
    look-ahead has moved all others towards later observations.
    """

    move: AbstractRegrouping
    twist: Twist

    holds = ("move",)

    def regroup(self, key: Key[Array, ""], mixture: ParticleMixture) -> Regrouped:
        """The move's indicators under the weights times ν_{t+1}."""
        log_factors = self.twist.log_normaliser(mixture.t + 1, mixture)
        log_weights = mixture.reweight(log_factors).log_weights
        log_weights = log_weights - log_sum_exp(log_weights)
        return self.move.regroup(key, mixture.replace(log_weights=log_weights))
