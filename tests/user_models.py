"""Models that a user would write, from nothing but the interface; the tests run on them too.

`Drift` is batched, `DriftOfOne` is the same model written for one particle. Both are
linear-Gaussian, so that the Kalman filter gives the truth (`DRIFT_AS_LINEAR_GAUSSIAN`).
`ScalarLinear` is another, whose parameters are there to be differentiated.
"""

import contextlib

import chex
import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.stats import norm

import mpfjax

DRIFT_AS_LINEAR_GAUSSIAN = mpfjax.LinearGaussianModel(
    A=[[1.0, 0.5], [0.0, 0.8]], Q=0.25 * jnp.eye(2), H=[[1.0, 0.0]], R=[[0.49]], m0=[0.0, 0.0],
    P0=jnp.eye(2),
)  # fmt: skip


class Drift(mpfjax.AbstractStateSpaceModel):
    """A position that is pushed by a second coordinate, and seen with noise."""

    def sample_initial(self, key, num_particles):
        return jax.random.normal(key, (num_particles, 2))

    def sample_transition(self, key, states):
        return self.transition_from_noise(jax.random.normal(key, states.shape), states)

    noise_dimension = 2

    def transition_from_noise(self, noise, states):
        return self.transition_mean(states) + 0.5 * noise

    def log_likelihood(self, observation, states):
        return norm.logpdf(observation - states[:, 0], scale=0.7)

    def log_transition(self, states, previous_states):
        return norm.logpdf(states - self.transition_mean(previous_states), scale=0.5).sum(axis=1)

    # What the Gauss-Newton proposal asks for on top:

    def transition_mean(self, states):
        return jnp.stack([states[:, 0] + 0.5 * states[:, 1], 0.8 * states[:, 1]], axis=1)

    def observation_mean(self, states):
        return states[:, 0]

    transition_covariance = property(lambda self: 0.25 * jnp.eye(2))
    observation_covariance = property(lambda self: jnp.array([[0.49]]))


class Batched(mpfjax.AbstractStateSpaceModel):
    """A random walk with the three methods that a filter needs, and no density."""

    def sample_initial(self, key, num_particles):
        return jax.random.normal(key, (num_particles,))

    def sample_transition(self, key, states):
        return states + jax.random.normal(key, states.shape)

    def log_likelihood(self, observation, states):
        return -((observation - states) ** 2)


class TwoSensors(Drift):
    """Both coordinates, each by a sensor that may be missing; what is there is weighed."""

    gain: jax.Array = eqx.field(converter=jnp.asarray, default=1.0)
    handles_missing = True

    def log_likelihood(self, observation, states):
        seen = ~jnp.isnan(observation)
        residuals = jnp.where(seen, observation, 0.0)[None] - self.gain * states
        terms = norm.logpdf(residuals, scale=0.7)
        return jnp.sum(jnp.where(seen[None], terms, 0.0), axis=1)


class DriftOfOne:
    """The same, of one particle; not even a module."""

    def sample_initial(self, key):
        return jax.random.normal(key, (2,))

    def sample_transition(self, key, state):
        return self.transition_mean(state) + 0.5 * jax.random.normal(key, (2,))

    def log_likelihood(self, observation, state):
        return norm.logpdf(observation - state[0], scale=0.7)

    def log_transition(self, state, previous_state):
        return norm.logpdf(state - self.transition_mean(previous_state), scale=0.5).sum()

    def transition_mean(self, state):
        return jnp.stack([state[0] + 0.5 * state[1], 0.8 * state[1]])

    def observation_mean(self, state):
        return state[:1]

    transition_covariance = property(lambda self: 0.25 * jnp.eye(2))
    observation_covariance = property(lambda self: jnp.array([[0.49]]))


class ScalarLinear(mpfjax.AbstractStateSpaceModel):
    """x_t = a x_{t-1} + N(0, q²), y_t = h x_t + N(0, r²), x_0 ~ N(m, p²), in six numbers.

    The same in matrices would spend most of the tests' time on tiny Cholesky factors.
    """

    a: jax.Array = eqx.field(converter=jnp.asarray, default=0.9)
    q: jax.Array = eqx.field(converter=jnp.asarray, default=0.6)
    h: jax.Array = eqx.field(converter=jnp.asarray, default=1.0)
    r: jax.Array = eqx.field(converter=jnp.asarray, default=0.5)
    m: jax.Array = eqx.field(converter=jnp.asarray, default=0.5)
    p: jax.Array = eqx.field(converter=jnp.asarray, default=1.0)

    def sample_initial(self, key, num_particles):
        return self.m + self.p * jax.random.normal(key, (num_particles,))

    def sample_transition(self, key, states):
        return self.transition_from_noise(jax.random.normal(key, (len(states), 1)), states)

    noise_dimension = 1

    def transition_from_noise(self, noise, states):
        return self.a * states + self.q * noise[:, 0]

    def log_likelihood(self, observation, states):
        return norm.logpdf(observation, self.h * states, self.r)

    def log_transition(self, states, previous_states):
        return norm.logpdf(states, self.a * previous_states, self.q)

    # What the Gauss-Newton proposal asks for on top:

    def transition_mean(self, states):
        return self.a * states

    def observation_mean(self, states):
        return self.h * states

    transition_covariance = property(lambda self: self.q**2)
    observation_covariance = property(lambda self: self.r**2)

    def in_matrices(self):
        rows = lambda value: value.reshape(1, 1)  # noqa: E731
        return mpfjax.LinearGaussianModel(
            A=rows(self.a), Q=rows(self.q**2), H=rows(self.h), R=rows(self.r**2),
            m0=self.m.reshape(1), P0=rows(self.p**2),
        )  # fmt: skip


class Window(mpfjax.QuadraticModel):
    """Zero likelihood, with a logarithm of -inf, for most of the particles."""

    def log_likelihood(self, observation, states):
        honest = super().log_likelihood(observation, states)
        return jnp.where(jnp.abs(observation - states**2) < 0.4, honest, -jnp.inf)


# Observations at which the model below misbehaves, as a broken model would.
BLINDED, BROKEN, EXPLODING = -99.0, -98.0, -97.0


class TrickyQuadraticModel(mpfjax.QuadraticModel):
    """The quadratic model, with a zero, a NaN and an infinite likelihood on demand.

    Within `nothing_traced`, to trace it is an error.
    """

    def log_likelihood(self, observation, states):
        honest = super().log_likelihood(observation, _watch(states))
        first = jnp.arange(states.shape[0]) == 0
        honest = jnp.where(observation == BLINDED, -jnp.inf, honest)
        honest = jnp.where((observation == BROKEN) & first, jnp.nan, honest)
        return jnp.where((observation == EXPLODING) & first, jnp.inf, honest)


def _seen(states):
    return states


_watch = _seen


@contextlib.contextmanager
def nothing_traced():
    """Every program that runs a `TrickyQuadraticModel` has been compiled before: or it fails."""
    global _watch
    _watch = chex.assert_max_traces(_seen, n=0)
    try:
        yield
    finally:
        _watch = _seen
