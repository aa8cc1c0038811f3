"""Known inputs: controls and times that the model finds in its field `inputs` at each step.

The driven Ornstein-Uhlenbeck process dx = k (g u - x) dt + s dW, seen at irregular times, is linear
and Gaussian: numpy has the exact answer, without any recursion.
"""

from functools import cache
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.scipy.stats import norm

import mpfjax
from mpfjax.exact import grid_filter, kalman_filter, kalman_smoother

TIMES = np.cumsum([0.3, 1.7, 0.2, 0.2, 2.5, 0.6]).astype(np.float32)
INPUTS = {
    "dt": np.diff(TIMES, prepend=np.float32(0)),
    "u": np.array([1.0, 1.0, -1.0, 0.5, 2.0, -2.0], np.float32),
}
OBSERVATIONS = jnp.array([0.6, 1.1, 0.1, -0.2, 2.3, 0.2])
LENGTH = len(TIMES)
RATE, GAIN, SPREAD, ERROR = 0.8, 1.2, 0.7, 0.4
KEY = jax.random.key(3)
TRACED = []  # how often JAX has traced the likelihood


def array(default: float) -> Any:
    return eqx.field(converter=lambda value: jnp.asarray(value, float), default=default)


class Driven(mpfjax.AbstractStateSpaceModel):
    """The process, with its exact transition over the time since the last step."""

    rate: jax.Array = array(RATE)
    gain: jax.Array = array(GAIN)
    inputs: Any = None

    noise_dimension = 1
    observation_covariance = property(lambda self: jnp.asarray(ERROR**2))

    def sample_initial(self, key, num_particles):
        return jax.random.normal(key, (num_particles,))

    def log_initial(self, states):
        return norm.logpdf(states)

    def transition_from_noise(self, noise, states):
        return self.transition_mean(states) + jnp.sqrt(self.transition_covariance) * noise[:, 0]

    def log_transition(self, states, previous_states):
        deviation = jnp.sqrt(self.transition_covariance)
        return norm.logpdf(states, self.transition_mean(previous_states), deviation)

    def log_likelihood(self, observation, states):
        TRACED.append(None)
        return norm.logpdf(observation, states, ERROR)

    def transition_mean(self, states):
        kept = jnp.exp(-self.rate * self.inputs["dt"])
        return kept * states + (1 - kept) * self.gain * self.inputs["u"]

    @property
    def transition_covariance(self):
        kept = jnp.exp(-self.rate * self.inputs["dt"])
        return SPREAD**2 / (2 * self.rate) * (1 - kept**2)

    def observation_mean(self, states):
        return states


def in_matrices(gain=GAIN):
    """The same as a linear-Gaussian model, whose matrices are inputs."""
    eye = np.eye(1, dtype=np.float32)
    model = mpfjax.LinearGaussianModel(eye, eye, eye, ERROR**2 * eye, np.zeros(1), eye, B=eye)
    kept = jnp.exp(-RATE * INPUTS["dt"])[:, None, None]
    inputs = {
        "A": kept,
        "Q": SPREAD**2 / (2 * RATE) * (1 - kept**2),
        "B": (1 - kept) * gain,
        "inputs": jnp.asarray(INPUTS["u"])[:, None],
    }
    return model, inputs


@cache
def truth():
    """log Z, and E[x_t | y_1..y_t] and E[x_t | y] of all times, from the joint normal law."""
    kept = np.exp(-RATE * INPUTS["dt"].astype(float))
    mean, covariance = np.zeros(LENGTH + 1), np.zeros((LENGTH + 1, LENGTH + 1))
    covariance[0, 0] = 1.0
    for t, a in enumerate(kept, 1):
        mean[t] = a * mean[t - 1] + (1 - a) * GAIN * INPUTS["u"][t - 1]
        covariance[t, :t] = covariance[:t, t] = a * covariance[t - 1, :t]
        covariance[t, t] = a**2 * covariance[t - 1, t - 1] + SPREAD**2 / (2 * RATE) * (1 - a**2)

    def given(num_seen):
        seen = slice(1, num_seen + 1)
        of_seen = covariance[seen, seen] + ERROR**2 * np.eye(num_seen)
        residual = OBSERVATIONS[:num_seen] - mean[seen]
        log_z = -0.5 * residual @ np.linalg.solve(of_seen, residual)
        log_z -= 0.5 * np.linalg.slogdet(2 * np.pi * of_seen)[1]
        return log_z, mean + covariance[:, seen] @ np.linalg.solve(of_seen, residual)

    steps = [given(s) for s in range(1, LENGTH + 1)]
    filtered = [smoothed[s] for s, (_, smoothed) in enumerate(steps, 1)]
    return steps[-1][0], np.array(filtered), steps[-1][1]


def mean(mixture):
    return mixture.mean()


def nothing(mixture):
    return None


@pytest.mark.exactness
def test_the_references_take_controls_and_matrices_by_time():
    model, inputs = in_matrices()
    log_z, filtered, smoothed = truth()
    run = kalman_filter(model, mpfjax.Series(OBSERVATIONS[:, None], inputs))
    np.testing.assert_allclose(run.log_marginal_likelihood, log_z, atol=1e-5)
    np.testing.assert_allclose(run.means[:, 0], filtered, atol=1e-5)
    run = kalman_smoother(model, mpfjax.Series(OBSERVATIONS[:, None], inputs))
    np.testing.assert_allclose(run.means[:, 0], smoothed, atol=1e-5)
    run = grid_filter(Driven(), mpfjax.Series(OBSERVATIONS, INPUTS), jnp.linspace(-4.0, 5.0, 700))
    np.testing.assert_allclose(run.log_marginal_likelihood, log_z, atol=1e-4)
    np.testing.assert_allclose(run.means, filtered, atol=1e-4)


def built_in(dt=0.5, u=1.0):
    """What every step sees where the inputs are constant."""
    return {"dt": jnp.asarray(dt), "u": jnp.asarray(u)}


class Drawn(mpfjax.AbstractStateSpaceModel):
    """x_t = u_t + noise, seen exactly enough; any object may have its own shift."""

    shift: jax.Array
    inputs: Any = None

    def sample_initial(self, key, num_particles):
        return self.shift + jax.random.normal(key, (num_particles,))

    def sample_transition(self, key, states):
        return self.shift + self.inputs + 0.01 * jax.random.normal(key, states.shape)

    def log_likelihood(self, observation, states):
        return norm.logpdf(observation, states - self.inputs, 1.0)


@pytest.mark.parametrize("shift", [jnp.array(1.0), jnp.array([1.0, 2.0, 3.0])])
def test_all_objects_have_the_input(shift):
    model = mpfjax.MultiObjectModel(Drawn(shift), 3, shared_observation=True)
    states = model.sample_initial(KEY, 16)
    moved = model.with_inputs(jnp.array(10.0)).sample_transition(KEY, states)
    expected = jnp.broadcast_to(shift + 10.0, (3,))
    np.testing.assert_allclose(moved.mean(axis=0), expected, atol=0.02)


FILTER = mpfjax.particle_filter(Driven(), 32)


def run(filter=FILTER, observations=OBSERVATIONS, collect=mean, inputs=INPUTS, **options):
    return mpfjax.run_filter(KEY, filter, observations, collect, inputs=inputs, **options)


@pytest.mark.exactness
def test_an_input_of_a_step_that_is_nan_or_not_there_is_an_error():
    with pytest.raises(ValueError, match="inputs: NaN or infinite"):
        FILTER.step(KEY, FILTER.init(KEY), OBSERVATIONS[0], inputs=built_in(u=np.nan))
    with pytest.raises(TypeError) as caught:
        FILTER.step(KEY, FILTER.init(KEY), OBSERVATIONS[0])
    assert "propagate.py" not in {entry.path.name for entry in caught.traceback}  # the user's alone
    assert "its inputs None, as the call gives no u_t" in str(caught.value)


@pytest.mark.exactness
def test_monte_carlo_islands_and_studies_hand_them_on(tmp_path):
    expected, series = run().log_marginal_likelihood, mpfjax.Series(OBSERVATIONS, INPUTS)
    runs = mpfjax.monte_carlo(KEY[None], FILTER, series, nothing)
    np.testing.assert_allclose(runs.log_marginal_likelihood[0], expected, rtol=1e-5)

    def make(num_particles):
        return mpfjax.particle_filter(Driven(), num_particles)

    (cell,) = mpfjax.run_study(mpfjax.Study({"pf": make}, [32], KEY[None], series), tmp_path)
    np.testing.assert_allclose(cell["log_marginal_likelihood"][0], expected, rtol=1e-5)
    island = mpfjax.run_islands(KEY, FILTER, series, nothing, num_islands=1)
    own = jax.random.fold_in(KEY, 0)
    alone = mpfjax.run_filter(own, FILTER, OBSERVATIONS, nothing, inputs=INPUTS)
    found = island.log_marginal_likelihood, alone.log_marginal_likelihood
    np.testing.assert_allclose(*found, rtol=1e-5)


def test_nothing_compiles_again():
    run()
    before = len(TRACED)
    run(inputs=jax.tree.map(lambda leaf: 0.5 * leaf, INPUTS))
    assert len(TRACED) == before > 0
