"""Forecasts against the Kalman filter's prediction."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm

import mpfjax
from mpfjax import forecast
from mpfjax.exact import kalman_filter
from tests.user_models import DriftOfOne

LINEAR = mpfjax.LinearGaussianModel(
    A=[[0.9]], Q=[[0.3]], H=[[1.0]], R=[[0.4]], m0=[0.5], P0=[[1.0]]
)
SEEN = jnp.array([[0.8], [0.1], [-0.4]])
NUM_STEPS = 3


class ObservedDrift(DriftOfOne):
    """With draws of its observations."""

    def sample_observation(self, key, state):
        return state[0] + jax.random.normal(key)


def test_a_wrapped_models_observations_are_drawn_one_by_one():
    """Of one particle, as all methods of such a model are, each with noise of its own."""
    filter = mpfjax.particle_filter(mpfjax.per_particle(ObservedDrift()), 400)
    mixture = filter.init(jax.random.key(0))
    ahead = forecast(jax.random.key(1), filter, mixture, 2)
    noise = ahead.observations - ahead.mixtures.particles[..., 0]
    assert noise.shape == (2, 400)
    np.testing.assert_allclose(noise.std(axis=1), 1.0, atol=4 / np.sqrt(2 * 400))


@pytest.mark.exactness
def test_intervals_are_the_kalman_filters():
    """Of states and observations, where weights are far from equal after a surprising y_t."""
    seen = SEEN.at[-1].set(1.5)
    filter = mpfjax.mixture_particle_filter(LINEAR, 20_000, 3)
    run = mpfjax.run_filter(jax.random.key(1), filter, seen, lambda mixture: None)
    ahead = forecast(jax.random.key(2), filter, run.final, NUM_STEPS)
    interval = jax.vmap(lambda mixture, values: mixture.quantile(values, [0.05, 0.95]))
    states = ahead.mixtures.particles
    found = interval(ahead.mixtures, jnp.concatenate([states, ahead.observations], axis=2))
    unknown = jnp.concatenate([seen, jnp.full((NUM_STEPS, 1), jnp.nan)])
    exact = kalman_filter(LINEAR, mpfjax.Series.skipping(unknown))
    means, variances = exact.means[-NUM_STEPS:, 0], exact.covariances[-NUM_STEPS:, 0, 0]
    error = np.sqrt(0.05 * 0.95 / run.final.effective_sample_size)
    for kind, spread in enumerate((variances, variances + 0.4)):
        shares = norm.cdf(found[:, :, kind], means[:, None], np.sqrt(spread)[:, None])
        np.testing.assert_allclose(shares, [[0.05, 0.95]] * NUM_STEPS, atol=4 * error)
    # Without the weights it is another.
    assert jnp.quantile(states[0], 0.05) < found[0, 0, 0] - 0.3


@pytest.mark.exactness
def test_predictions_of_each_step_are_the_kalman_filters():
    """Of states and observations before each observation, in a run with weights far from equal."""
    filter = mpfjax.particle_filter(LINEAR, 20_000)
    run = mpfjax.run_filter(jax.random.key(1), filter, SEEN)
    ahead = mpfjax.one_step_predictions(jax.random.key(2), filter, run)
    exact = kalman_filter(LINEAR, SEEN)
    before = jnp.concatenate([jnp.array([0.5]), exact.means[:-1, 0]])
    spread = 0.81 * jnp.concatenate([jnp.ones(1), exact.covariances[:-1, 0, 0]]) + 0.3
    means = jax.vmap(lambda mixture, y: (mixture.mean()[0], mixture.expectation(y)[0]))
    for found, noise in zip(means(ahead.mixtures, ahead.observations), (0.0, 0.4), strict=True):
        error = np.sqrt((spread + noise) / run.effective_sample_size.min())
        assert np.all(np.abs(found - 0.9 * before) < 4 * error)
    with pytest.raises(ValueError, match="run: it has not the mixtures of one run"):
        mpfjax.one_step_predictions(jax.random.key(2), filter, replace(run, collected=None))
