"""Simulated series have the moments that the model gives them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from tests.test_exact import MODEL, joint_gaussian
from tests.user_models import Drift, DriftOfOne

NUM_RUNS, NUM_STEPS = 4000, 3
KEYS = jax.random.split(jax.random.key(0), NUM_RUNS)


def test_means_and_covariances_are_those_of_the_joint_gaussian():
    model = mpfjax.LinearGaussianModel(**MODEL)
    states, observations = jax.jit(jax.vmap(lambda key: model.simulate(key, NUM_STEPS)))(KEYS)
    assert states.shape == (NUM_RUNS, NUM_STEPS + 1, 2)
    assert observations.shape == (NUM_RUNS, NUM_STEPS, 2)
    mean, covariance = joint_gaussian(**MODEL, length=NUM_STEPS, with_first=True)
    rows = np.concatenate([states.reshape(NUM_RUNS, -1), observations.reshape(NUM_RUNS, -1)], 1)
    deviations = np.sqrt(np.diag(covariance))
    z = (rows.mean(0) - mean) / deviations * np.sqrt(NUM_RUNS)
    assert np.abs(z).max() < 4
    variances = np.outer(deviations**2, deviations**2) + covariance**2
    z = (np.cov(rows.T) - covariance) / np.sqrt(variances / NUM_RUNS)
    assert np.abs(z).max() < 4


class Seen(Drift):
    def sample_observation(self, key, states):
        return states[:, 0] + 0.7 * jax.random.normal(key, states.shape[:1])


class SeenOfOne(DriftOfOne):
    def sample_observation(self, key, state):
        return state[0] + 0.7 * jax.random.normal(key)


class Driven(Seen):
    inputs: jax.Array | None = None

    def sample_transition(self, key, states):
        return states + jnp.where(jnp.arange(2) == 0, self.inputs, 0.0)[None]


def test_models_of_one_particle_of_several_objects_and_with_inputs():
    for model in (Seen(), mpfjax.per_particle(SeenOfOne())):
        states, observations = model.simulate(jax.random.key(1), 200)
        noise = np.asarray(observations - states[1:, 0])
        assert noise.shape == (200,)
        assert noise.std() == pytest.approx(0.7, abs=4 * 0.7 / np.sqrt(400))
    joint = mpfjax.MultiObjectModel(mpfjax.QuadraticModel(0.3, 0.1, -2.0, 2.0), 3)
    states, observations = joint.simulate(jax.random.key(2), 50)
    assert (states.shape, observations.shape) == ((51, 3), (50, 3))
    noise = np.asarray(observations - states[1:] ** 2)
    assert noise.std() == pytest.approx(0.1, abs=4 * 0.1 / np.sqrt(300))
    states, _ = Driven().simulate(jax.random.key(3), 4, inputs=jnp.arange(4.0))
    np.testing.assert_allclose(np.diff(states[:, 0]), np.arange(4.0), atol=1e-6)


def test_what_cannot_be_simulated_is_said():
    repelled = mpfjax.MultiObjectModel(
        mpfjax.LinearGaussianModel(**MODEL), 2, mpfjax.PairwiseRepulsion(1.0, 2.0)
    )
    key = jax.random.key(0)
    with pytest.raises(ValueError, match="interaction: "):
        repelled.simulate(key, 3)
    with pytest.raises(ValueError, match="model: Drift defines no sample_observation"):
        Drift().simulate(key, 3)
    with pytest.raises(ValueError, match="num_steps: 0"):
        Seen().simulate(key, 0)
    with pytest.raises(ValueError, match="inputs: Seen has no place"):
        Seen().simulate(key, 3, inputs=jnp.zeros(3))
    with pytest.raises(ValueError, match=r"inputs: .* shape \(2,\)"):
        Driven().simulate(key, 3, inputs=jnp.zeros(2))

    class Wrong(Seen):
        def sample_observation(self, key, states):
            return states[0, 0]

    with pytest.raises(ValueError, match=r"model: Wrong.sample_observation returned a leaf"):
        Wrong().simulate(key, 3)
