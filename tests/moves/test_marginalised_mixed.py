"""The mixed form, z_t that depends on x_{t-1}, against the Kalman filter of the whole state."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax.exact import kalman_filter
from tests.marking import exactness
from tests.unbiased import assert_unbiased

# The whole state (z, x) is linear: z_t = f z + A x + v, x_t = F x + B z + w.
SLOPE, COUPLING = 0.7, np.array([[0.5, -0.3]])
MATRIX, PUSH = np.array([[0.9, 0.3], [-0.2, 0.8]]), np.array([0.2, -0.1])
OWN, SHARED = np.array([[0.3]]), np.array([[0.15], [-0.1]])
NOISE = np.array([[0.4, 0.1], [0.1, 0.3]])
SEEN, ERROR = np.array([[0.5, 1.0, 0.2]]), np.array([[0.3]])
OBSERVATIONS = jnp.array([[0.5], [1.2], [-0.4], [-1.0], [0.8]])
NUM_RUNS, NUM_PARTICLES = 1000, 40


class Mixed(mpfjax.AbstractConditionallyLinearModel):
    """z is seen through y as well, beside x."""

    is_correlated: bool = True

    def sample_initial(self, key, num_particles):
        return jax.random.normal(key, (num_particles, 1))

    def initial_moments(self, latent):
        return jnp.zeros(2), jnp.eye(2)

    def latent_dynamics(self, previous_latent):
        parts = (SLOPE * previous_latent, jnp.array(COUPLING), jnp.array(OWN))
        return (*parts, jnp.array(SHARED)) if self.is_correlated else parts

    def dynamics(self, latent, previous_latent):
        return jnp.array(MATRIX), previous_latent * PUSH[None], jnp.array(NOISE)

    def emission(self, latent):
        return jnp.array(SEEN[:, 1:]), SEEN[0, 0] * latent, jnp.array(ERROR)


def whole(is_correlated):
    shared = SHARED if is_correlated else 0 * SHARED
    return mpfjax.LinearGaussianModel(
        A=np.block([[np.array([[SLOPE]]), COUPLING], [PUSH[:, None], MATRIX]]),
        Q=np.block([[OWN, shared.T], [shared, NOISE]]),
        H=SEEN, R=ERROR, m0=np.zeros(3), P0=np.eye(3),
    )  # fmt: skip


def moments(mixture):
    state = mixture.mean()
    return jnp.concatenate([state.latent, state.mean]), state.covariance


@pytest.mark.parametrize(
    ("is_correlated", "noise"),
    [(True, "independent"), *exactness([(False, "independent"), (True, "rqmc")])],
)
def test_evidence_and_moments_are_those_of_the_kalman_filter(is_correlated, noise):
    filter = mpfjax.particle_filter(Mixed(is_correlated), NUM_PARTICLES, noise=noise)
    keys = jax.random.split(jax.random.key(4), NUM_RUNS)
    run = jax.tree.map(np.asarray, mpfjax.monte_carlo(keys, filter, OBSERVATIONS, moments))
    exact = kalman_filter(whole(is_correlated), OBSERVATIONS)
    log_evidence = np.cumsum(np.asarray(exact.log_likelihood_increments))
    ratios = np.exp(np.cumsum(run.log_likelihood_increments, axis=1) - log_evidence)
    means, covariances = run.collected
    second = covariances + means[..., 1:, None] * means[..., None, 1:]
    mean = np.asarray(exact.means)
    expected = np.asarray(exact.covariances)[:, 1:, 1:] + mean[:, 1:, None] * mean[:, None, 1:]
    assert_unbiased(ratios, loosest=0.1)
    assert_unbiased(ratios[..., None] * means, mean, loosest=0.1)
    assert_unbiased(ratios[..., None, None] * second, expected, loosest=0.1)
