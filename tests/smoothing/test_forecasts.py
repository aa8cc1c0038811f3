"""Forecasts against the Kalman filter's prediction."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

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
def test_predictions_are_the_kalman_filters():
    """Of states and observations before each observation, and later ones; weights are unequal."""
    seen, filter = SEEN.at[-1].set(1.5), mpfjax.particle_filter(LINEAR, 20_000)
    run = mpfjax.run_filter(jax.random.key(1), filter, seen)
    each_step = mpfjax.one_step_predictions(jax.random.key(2), filter, run)
    later = forecast(jax.random.key(3), filter, run.final, NUM_STEPS)
    unknown = jnp.concatenate([seen, jnp.full((NUM_STEPS, 1), jnp.nan)])
    exact = kalman_filter(LINEAR, mpfjax.Series.skipping(unknown))
    before = jnp.concatenate([jnp.array([0.5]), exact.means[:-1, 0]])
    spread = 0.81 * jnp.concatenate([jnp.ones(1), exact.covariances[:-1, 0, 0]]) + 0.3
    ahead = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), each_step, later)
    moments = jax.vmap(lambda mixture, x: (mixture.expectation(x)[0], mixture.variance(x)[0]))
    size = run.effective_sample_size.min()
    for values, noise in ((ahead.mixtures.particles, 0.0), (ahead.observations, 0.4)):
        mean, variance = moments(ahead.mixtures, values)
        error = np.sqrt((spread + noise) / size)
        assert np.all(np.abs(mean - 0.9 * before) < 4 * error)
        np.testing.assert_allclose(variance, spread + noise, rtol=4 * np.sqrt(2 / size))
    with pytest.raises(ValueError, match="run: it has not the mixtures of one run"):
        mpfjax.one_step_predictions(jax.random.key(2), filter, replace(run, collected=None))
