"""Forecasts against the Kalman filter's prediction, component by component."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax import forecast
from mpfjax.exact import kalman_filter
from tests.marking import thorough
from tests.user_models import DriftOfOne

LINEAR = mpfjax.LinearGaussianModel(
    A=[[0.9]], Q=[[0.3]], H=[[1.0]], R=[[0.4]], m0=[0.5], P0=[[1.0]]
)
SEEN = jnp.array([[0.8], [0.1], [-0.4]])
NUM_STEPS = 3


def observe(key, states):
    return states + np.sqrt(0.4) * jax.random.normal(key, states.shape)


@pytest.mark.parametrize("make", ["mpf", *thorough(["pf"])])
def test_moments_are_the_kalman_filters(make):
    filters = {
        "pf": mpfjax.particle_filter(LINEAR, 100),
        "mpf": mpfjax.mixture_particle_filter(LINEAR, 100, 3),
    }

    @jax.jit
    @jax.vmap
    def one(key):
        key_run, key = jax.random.split(key)
        run = mpfjax.run_filter(key_run, filters[make], SEEN, lambda mixture: None)
        ahead = forecast(key, filters[make], run.final, NUM_STEPS, simulate_observation=observe)

        def moments(mixture, observations):
            x, y = mixture.particles[:, 0], observations[:, 0]
            return [mixture.average(value) for value in (x, x**2, y, y**2)]

        found = jax.vmap(moments)(ahead.mixtures, ahead.observations)
        return run.log_marginal_likelihood, jnp.stack(found, axis=1)

    log_evidence, found = map(np.asarray, one(jax.random.split(jax.random.key(0), 1000)))
    exact = kalman_filter(LINEAR, SEEN)
    ratios = np.exp(log_evidence - float(exact.log_marginal_likelihood))
    mean, variance = float(exact.means[-1, 0]), float(exact.covariances[-1, 0, 0])
    expected = []
    for _ in range(NUM_STEPS):
        mean, variance = 0.9 * mean, 0.81 * variance + 0.3
        expected.append([mean, variance + mean**2, mean, variance + 0.4 + mean**2])
    weighed = ratios[:, None, None] * (found - np.array(expected))
    z = weighed.mean(0) / (weighed.std(0) / np.sqrt(len(weighed)))
    assert np.abs(z).max() < 4, z


@pytest.mark.thorough
def test_a_component_keeps_its_mass():
    """Two modes that stay apart: the probability of each is what it was."""
    model = mpfjax.QuadraticModel(0.05, 0.1, -2.0, 2.0)
    filter = mpfjax.mixture_particle_filter(model, 100, 2)
    run = mpfjax.run_filter(jax.random.key(1), filter, jnp.full(5, 1.5))
    ahead = forecast(jax.random.key(2), filter, run.final, 4)
    assert ahead.observations is None
    masses = jax.vmap(lambda mixture: jnp.sort(mixture.mixture_weights))(ahead.mixtures)
    expected = np.sort(np.asarray(run.final.mixture_weights))
    np.testing.assert_allclose(masses, np.tile(expected, (4, 1)), rtol=1e-5)


def test_a_wrapped_models_observations_are_drawn_one_by_one():
    """Of one particle, as all functions of such a model are, each with noise of its own."""
    filter = mpfjax.particle_filter(mpfjax.per_particle(DriftOfOne()), 400)
    mixture = filter.init(jax.random.key(0))
    simulate = lambda key, state: state[0] + jax.random.normal(key)  # noqa: E731
    ahead = forecast(jax.random.key(1), filter, mixture, 2, simulate_observation=simulate)
    noise = ahead.observations - ahead.mixtures.particles[..., 0]
    assert noise.shape == (2, 400)
    np.testing.assert_allclose(noise.std(axis=1), 1.0, atol=4 / np.sqrt(2 * 400))


@pytest.mark.parametrize(
    "wrong",
    [
        lambda key, states: jax.random.normal(key),
        lambda key, states: {"y": states, "bearing": states[:3, 0]},
        lambda key, states: states.T,
        lambda key, states: None,
    ],
)
def test_observations_that_are_not_one_a_particle_are_refused(wrong):
    filter = mpfjax.particle_filter(LINEAR, 10)
    mixture = filter.init(jax.random.key(0))
    with pytest.raises(ValueError, match="simulate_observation: it returned"):
        forecast(jax.random.key(1), filter, mixture, 2, simulate_observation=wrong)


@pytest.mark.usefixtures("as_installed")
@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"key": 0}, "key"),
        ({"filter": None}, "filter"),
        ({"mixture": None}, "mixture"),
        ({"num_steps": 0}, "num_steps: 0"),
        ({"num_steps": 1.5}, "num_steps: 1.5"),
        ({"simulate_observation": 3}, "simulate_observation: 3"),
    ],
)
def test_bad_input_is_named(options, named):
    filter = mpfjax.particle_filter(LINEAR, 10)
    arguments = {
        "key": jax.random.key(0), "filter": filter, "mixture": filter.init(jax.random.key(0)),
        "num_steps": 2,
    }  # fmt: skip
    with pytest.raises((ValueError, TypeError), match=named):
        forecast(**arguments | options)
