"""The models that ship with the library: densities, draws, and the wrapper for one particle."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

import mpfjax
from tests.exact.test_exact import MODEL, joint_gaussian
from tests.user_models import Drift, DriftOfOne

QUADRATIC = mpfjax.QuadraticModel(0.3, 0.5, -2.0, 2.0)
LINEAR = mpfjax.LinearGaussianModel(**MODEL)
NUM_RUNS, NUM_STEPS = 4000, 3
KEYS = jax.random.split(jax.random.key(0), NUM_RUNS)


@pytest.mark.parametrize("draw", ["stratified", "independent"])
def test_x0_is_uniform(draw):
    model = mpfjax.QuadraticModel(low=-1.0, high=3.0, initial_draw=draw)
    states = np.asarray(jax.vmap(lambda key: model.sample_initial(key, 20))(KEYS[:200])).ravel()
    assert states.min() >= -1
    assert states.max() <= 3
    assert scipy.stats.kstest(states, scipy.stats.uniform(-1, 4).cdf).pvalue > 1e-3


@pytest.mark.exactness
def test_simulated_series_have_the_moments_of_the_joint_gaussian():
    states, observations = jax.jit(jax.vmap(lambda key: mpfjax.simulate(key, LINEAR, NUM_STEPS)))(
        KEYS
    )
    assert states.shape == (NUM_RUNS, NUM_STEPS + 1, 2)
    assert observations.shape == (NUM_RUNS, NUM_STEPS, 2)
    mean, covariance = joint_gaussian(MODEL["m0"], MODEL["P0"], [MODEL] * NUM_STEPS)
    rows = np.concatenate([states.reshape(NUM_RUNS, -1), observations.reshape(NUM_RUNS, -1)], 1)
    deviations = np.sqrt(np.diag(covariance))
    z = (rows.mean(0) - mean) / deviations * np.sqrt(NUM_RUNS)
    assert np.abs(z).max() < 4
    variances = np.outer(deviations**2, deviations**2) + covariance**2
    z = (np.cov(rows.T) - covariance) / np.sqrt(variances / NUM_RUNS)
    assert np.abs(z).max() < 4


class Driven(Drift):
    inputs: jax.Array | None = None

    def sample_transition(self, key, states):
        return states + jnp.where(jnp.arange(2) == 0, self.inputs, 0.0)[None]

    def sample_observation(self, key, states):
        return states[:, 0]


@pytest.mark.exactness
def test_series_of_one_particle_and_with_inputs():
    states, observations = mpfjax.simulate(KEYS[0], mpfjax.per_particle(Full()), 200)
    noise = np.asarray(observations - states[1:, 0])
    assert noise.shape == (200,)
    assert noise.std() == pytest.approx(0.7, abs=4 * 0.7 / np.sqrt(400))
    states, _ = mpfjax.simulate(KEYS[2], Driven(), 4, inputs=jnp.arange(4.0))
    np.testing.assert_allclose(np.diff(states[:, 0]), np.arange(4.0), atol=1e-6)
    with pytest.raises(
        TypeError, match=r"model: Driven\.\w+.*whose `inputs` is None: pass inputs="
    ):
        mpfjax.simulate(KEYS[2], Driven(), 4)


class Full(DriftOfOne):
    """With all that the library looks for."""

    def sample_observation(self, key, state):
        return state[0] + 0.7 * jax.random.normal(key)

    def log_initial(self, state):
        return -0.5 * (state**2).sum()

    def with_history(self, state, previous_state):
        return jnp.concatenate([state[:1], previous_state[1:]])

    def prepare_observation(self, observation):
        return 2 * observation

    noise_dimension = 2

    def transition_from_noise(self, noise, state):
        return self.transition_mean(state) + 0.5 * noise


@pytest.mark.exactness
def test_a_model_of_one_particle_has_the_densities_and_means_of_the_batched_one():
    batched, wrapped = Drift(), mpfjax.per_particle(Full())
    states, previous = jax.random.normal(jax.random.key(5), (2, 6, 2))
    y = jnp.array(0.4)
    for one, other in (
        (batched.log_likelihood(y, states), wrapped.log_likelihood(y, states)),
        (batched.log_transition(states, previous), wrapped.log_transition(states, previous)),
        (batched.transition_mean(states), wrapped.transition_mean(states)),
        (batched.observation_mean(states), wrapped.observation_mean(states)[:, 0]),
        (batched.transition_covariance, wrapped.transition_covariance),
        (-0.5 * (states**2).sum(axis=1), wrapped.log_initial(states)),
        (np.column_stack([states[:, 0], previous[:, 1]]), wrapped.with_history(states, previous)),
        (2.0, wrapped.prepare_observation(jnp.ones(()))),
        tuple(model.transition_from_noise(previous, states) for model in (batched, wrapped)),
    ):
        np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-6)
    assert not hasattr(mpfjax.per_particle(DriftOfOne()), "noise_dimension")
