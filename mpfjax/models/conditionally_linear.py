"""Models that are linear and Gaussian given a latent part of the state.

Each particle carries the moments of the linear part, by a Kalman filter, instead of a draw.
"""

import abc
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key, PyTree, jaxtyped

from mpfjax.checks import array_of, as_numbers, check_shape, shown
from mpfjax.mixture import MarginalisedState
from mpfjax.models import gaussians
from mpfjax.models.base import AbstractStateSpaceModel, check_moved, model_name, real_each
from mpfjax.models.gaussians import Gaussian, Linear, apply, particles_first, particles_last
from mpfjax.models.law import Law
from mpfjax.models.noise import noise_dtype
from mpfjax.operations.logarithms import default_float
from mpfjax.operations.random import normal


class AbstractConditionallyLinearModel(AbstractStateSpaceModel):
    """A latent Markov process z_t, and x_t that is linear and Gaussian given z.

    z_t ~ p(. | z_{t-1}), and given z_0, ..., z_t

        x_0 ~ N(m0, P0),    x_t = F x_{t-1} + b + N(0, Q),    y_t = H x_t + c + N(0, R),

    where all of these may depend on z. The first observation is y_1. Particles are
    `MarginalisedState`s (latent, mean, covariance): a draw of z_t, and E and Cov of x_t given z_0,
    ..., z_t and y_1..y_t, by the Kalman filter. So x needs no particles (Doucet, de Freitas, Murphy
    and Russell 2000; Chen and Liu 2000). The latent is a pytree whose leaves have a leading axis n,
    as the states of any model.

    A model defines

    - `sample_initial(key, num_particles)`: z_0;
    - `initial_moments(latent)`: m0 (d,) and P0 (d, d), of each z_0;
    - `sample_transition(key, latent)`: z_t; or `transition_from_noise(noise, latent)` and
      `noise_dimension`, as in `AbstractStateSpaceModel`;
    - `dynamics(latent, previous_latent)`: F (d, d), b (d,), Q (d, d), given z_t and z_{t-1};
    - `emission(latent)`: H (p, d), c (p,), R (p, p), given z_t; or None if y_t does not depend on
      x.

    An array with a leading n has one entry for each particle; otherwise all particles share it. Q
    and R may be singular. If no matrix has a leading n, every particle has the same covariance,
    which is then computed once: a step takes a fraction of the time (Schön, Gustafsson and Nordlund
    2005). A move that assigns different covariances to the particles requires F with a leading n. A
    diffuse x_0 loses digits: in float32 log Ẑ is accurate to 0.05 up to about P0 / R = 1e7; beyond
    that set jax_enable_x64.

    It may also define

    - `log_transition(latent, previous_latent)`: log p(z_t | z_{t-1}), (n,), required by proposals,
      gradient "stop" and smoothing;
    - `log_likelihood(observation, latent)`: log density of observations of z alone, (n,); zero by
      default;
    - `linear_observation(observation)`: the y_t, (p,), to which `emission` refers; by default the
      observation itself;
    - `all_transitions(latent)`: if z_t takes finitely many values, all possible values: K pairs of
      a z_t and log p(z_t | z_{t-1}), (n,). See `RegimeProposal` and `PropagateRegimes`;
    - `latent_dynamics(previous_latent)`: instead of `sample_transition`, if z_t depends on x_{t-1}:
      the mixed form of Schön, Gustafsson and Nordlund (2005). z_t is then (n, k), and

        z_t = f + A x_{t-1} + v,    v ~ N(0, V),    Cov(w, v) = S,

      where w is the noise of x_t, whose covariance is Q. It returns f (k,), A (k, d), V (k, k), or
      also S (d, k), for which V must be invertible. A draw of z_t then contains information on
      x_{t-1}.

    An entry of y_t that is NaN is missing, and `log_likelihood` must omit it as well. A class with
    `handles_missing = False` never receives one. `particle_filter`, `mixture_particle_filter` and
    `auxiliary_particle_filter` accept such a model like any other: their move is `Propagate`. Use
    it if a part of the state is linear given the rest: regimes, velocities and biases in addition
    to a position, maps.
    """

    handles_missing = True

    @property
    def _law(self) -> Any:
        """The class of the model's law."""
        return MixedLaw if is_mixed(self) else MarginalisedLaw

    @abc.abstractmethod
    def sample_initial(self, key: Key[Array, ""], num_particles: int) -> PyTree:
        """Draw z_0 for `num_particles` particles: every leaf has shape (n, ...)."""

    @abc.abstractmethod
    def initial_moments(self, latent: PyTree) -> tuple[Array, Array]:
        """m0 and P0, the moments of x_0 given z_0: (d,) and (d, d), or one for each particle."""

    @abc.abstractmethod
    def dynamics(self, latent: PyTree, previous_latent: PyTree) -> tuple[Array, Array, Array]:
        """F, b, Q of x_t = F x_{t-1} + b + N(0, Q), given z_t and z_{t-1}."""

    @abc.abstractmethod
    def emission(self, latent: PyTree) -> tuple[Array, Array, Array] | None:
        """H, c, R of y_t = H x_t + c + N(0, R), given z_t; None if x is not observed."""

    def log_likelihood(self, observation: PyTree, states: PyTree) -> Float[Array, " n"]:
        """log density of observations of z alone; zero here."""
        return jnp.zeros(jax.tree.leaves(states)[0].shape[0], default_float())

    def linear_observation(self, observation: PyTree) -> Float[Array, " p"]:
        """The part of an observation that is y_t = H x_t + c + N(0, R)."""
        return observation


class MarginalisedLaw(Law):
    """The law of a conditionally linear model: z_t is random, and x_t has moments given z."""

    is_whole = False

    def part(self, states: PyTree) -> PyTree:
        """z."""
        return states.latent

    def complete(self, draws: PyTree, states: PyTree) -> PyTree:
        """z_t with the moments of x_t predicted."""
        law = predicted_gaussian(self.model, draws, states)
        check_moved(draws, states.latent, self.model)
        return _state_of(draws, law, states.mean.shape[0])

    def start(self, draws: PyTree) -> PyTree:
        """z_0 with the moments of x_0."""
        mean, covariance = _initial_moments(self.model, draws)
        n, d = jax.tree.leaves(draws)[0].shape[0], mean.shape[-1]
        return MarginalisedState(
            draws, jnp.broadcast_to(mean, (n, d)), jnp.broadcast_to(covariance, (n, d, d))
        )

    def see(self, observation: PyTree, states: PyTree) -> tuple[PyTree, list[Float[Array, " n"]]]:
        """The moments given y_t too, and the factors of z and of x."""
        model, n = self.model, states.mean.shape[0]
        log_factors = [self.log_likelihood_of_draws(observation, states.latent)]
        emission = emission_of(model, states.latent, states)
        if emission is None:
            return states, log_factors
        rows = observation_rows(model, observation, emission, states.mean.dtype)
        law, log_density = gaussians.update(filtered_gaussian(model, states), rows, emission)
        log_density = jnp.broadcast_to(log_density, (n,))
        log_factors.append(real_each(log_density, n, model, "emission"))
        return _state_of(states.latent, law, n), log_factors


class MixedLaw(MarginalisedLaw):
    """The law of a conditionally linear model whose z_t depends on x_{t-1}; z_t is then normal."""

    has_density = True
    is_of_noise = property(lambda self: True)

    def draw(self, key: Key[Array, ""], states: PyTree) -> PyTree:
        """z_t, drawn from its normal law."""
        return self.make(normal(key, states.latent.shape, noise_dtype(states)), states)

    def make(self, noise: Float[Array, "n k"], states: PyTree) -> PyTree:
        """z_t ~ N(f + A m, A P Aᵀ + V), made of this standard normal noise."""
        mixed, _ = latent_dynamics_of(self.model, states)
        law = gaussians.predict(filtered_gaussian(self.model, states), mixed)
        drawn = law.mean + apply(gaussians.cholesky(law.covariance), noise.T.astype(law.mean.dtype))
        return drawn.T.reshape(states.latent.shape)

    def noise_dimension(self, states: PyTree) -> int:
        """k, the number of coordinates of z_t."""
        return latent_rows(self.model, states.latent).shape[0]

    def log_transition(self, draws: PyTree, states: PyTree) -> Float[Array, " n"]:
        """log p(z_t | z_{t-1}, y_1..y_{t-1})."""
        mixed, _ = latent_dynamics_of(self.model, states)
        rows = latent_rows(self.model, draws)
        return gaussians.update_by_all(filtered_gaussian(self.model, states), rows, mixed)[1]


def is_marginalised(model: Any) -> bool:
    """Whether the model's particles carry moments in place of draws."""
    return isinstance(model, AbstractConditionallyLinearModel)


def is_mixed(model: Any) -> bool:
    """Whether z_t depends on x_{t-1}."""
    return callable(getattr(model, "latent_dynamics", None))


def _initial_moments(model: Any, latent: PyTree) -> list[Array]:
    """m0 and P0, checked."""
    n = jax.tree.leaves(latent)[0].shape[0]
    return _checked(model, "initial_moments", model.initial_moments(latent), n, m0="d", P0="d d")


def _state_of(latent: PyTree, law: Gaussian, n: int) -> MarginalisedState:
    """The law of each particle with the particles first."""
    return MarginalisedState(latent, *(particles_first(values, n) for values in law))


def predicted_gaussian(model: Any, latent: PyTree, state: MarginalisedState) -> Gaussian:
    """The predicted law of x_t given z_t, with the particles last."""
    law = filtered_gaussian(model, state)
    dynamics = dynamics_of(model, latent, state)
    if is_mixed(model):
        mixed, shared = latent_dynamics_of(model, state)
        law, _ = gaussians.update_by_all(law, latent_rows(model, latent), mixed)
        dynamics = gaussians.decorrelate(dynamics, mixed, shared, latent_rows(model, latent))
    return gaussians.predict(law, dynamics)


def latent_rows(model: Any, latent: Any) -> Float[Array, "k n"]:
    """z_t of the mixed form with the particles last; a `ValueError` for other than one array."""
    if getattr(latent, "ndim", None) != 2:
        who = f"model: {model_name(model)}, which has latent_dynamics,"
        raise ValueError(f"{who} has the latent {shown(latent)}, not one array (n, k)")
    return jnp.asarray(latent).T


def filtered_gaussian(model: Any, state: MarginalisedState) -> Gaussian:
    """The moments of each particle, the particles last; one covariance, if it is that of all."""
    if _shares_covariance(model, state):
        state = state._replace(covariance=state.covariance[0])
    return gaussian_of(state)


def _shares_covariance(model: Any, state: MarginalisedState) -> bool:
    """Whether no matrix of the model depends on z, so that all particles have one covariance.

    So it is computed once for all (Schön, Gustafsson and Nordlund 2005). The shapes tell it: P0, F,
    Q, H and R, and A, V and S of the mixed form, come without a leading axis n.
    """

    def matrices(state: MarginalisedState) -> list[Array]:
        parts = (
            particles_last(_initial_moments(model, state.latent)[1], 2),
            dynamics_of(model, state.latent, state),
            emission_of(model, state.latent, state),
            latent_dynamics_of(model, state) if is_mixed(model) else None,
        )
        return [leaf for leaf in jax.tree.leaves(parts) if leaf.ndim == 3]

    return all(matrix.shape[-1] == 1 for matrix in jax.eval_shape(matrices, state))


def gaussian_of(state: MarginalisedState) -> Gaussian:
    """The moments of each particle, the particles last."""
    return Gaussian(particles_last(state.mean, 1), particles_last(state.covariance, 2))


def dynamics_of(model: Any, latent: PyTree, state: MarginalisedState) -> Linear:
    """F, b and Q, checked, the particles last."""
    (n, d), parts = state.mean.shape, model.dynamics(latent, state.latent)
    return Linear.of(*_checked(model, "dynamics", parts, n, F=f"{d} {d}", b=f"{d}", Q=f"{d} {d}"))


def emission_of(model: Any, latent: PyTree, state: MarginalisedState) -> Linear | None:
    """H, c and R, checked, the particles last; None where x is not observed."""
    parts = model.emission(latent)
    if parts is None:
        return None
    n, d = state.mean.shape
    return Linear.of(*_checked(model, "emission", parts, n, H=f"p {d}", c="p", R="p p"))


def latent_dynamics_of(
    model: Any, state: MarginalisedState
) -> tuple[Linear, Float[Array, "d k n"] | None]:
    """f, A and V of the mixed form, and S if there is one, checked, the particles last."""
    (n, d), k = state.mean.shape, latent_rows(model, state.latent).shape[0]
    shapes = {"f": f"{k}", "A": f"{k} {d}", "V": f"{k} {k}", "S": f"{d} {k}"}
    parts = model.latent_dynamics(state.latent)
    if isinstance(parts, tuple) and len(parts) == 3:
        del shapes["S"]
    offset, matrix, noise, *rest = _checked(model, "latent_dynamics", parts, n, **shapes)
    return Linear.of(matrix, offset, noise), particles_last(rest[0], 2) if rest else None


def observation_rows(
    model: Any, observation: PyTree, emission: Linear, dtype: jnp.dtype
) -> Float[Array, "p 1"]:
    """y_t as a column, checked."""
    numbers = as_numbers("observation", model.linear_observation(observation))
    rows, p = jnp.atleast_1d(numbers).astype(dtype), emission.matrix.shape[0]
    check_shape(f"{p}", observation=rows)
    return jnp.reshape(rows, (p, 1))


def _checked(model: Any, method: str, parts: Any, n: int, **shapes: str) -> list[Array]:
    """The arrays that a method returned, one for all particles or one for each."""
    fits = isinstance(parts, tuple | list) and len(parts) == len(shapes)
    with jaxtyped("context"):
        for part, shape in zip(parts, shapes.values(), strict=True) if fits else ():
            fits &= isinstance(part, (array_of(shape), array_of(f"{n} {shape}")))
    if not fits:
        who = f"model: {model_name(model)}.{method}"
        actual = shown(jax.tree.map(jnp.shape, parts))
        raise ValueError(f"{who} returned {actual}, not {shapes}, or {n} of them")
    return [jnp.asarray(part) for part in parts]
