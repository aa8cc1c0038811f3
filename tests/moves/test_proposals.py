"""The Gauss-Newton proposal, and the proposal that is learned, against SciPy and exact filters."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
import scipy.stats

import mpfjax
from mpfjax import GaussNewtonProposal, NetworkProposal
from mpfjax.exact import grid_filter
from tests.precision import float64
from tests.unbiased import assert_unbiased

LINEAR = mpfjax.LinearGaussianModel(
    A=[[1.0, 0.3, 0.0], [0.0, 0.8, 0.1], [0.2, 0.0, 1.0]],
    Q=[[0.5, 0.1, 0.0], [0.1, 0.4, 0.1], [0.0, 0.1, 0.3]],
    H=[[1.0, 0.0, 0.5], [0.0, 1.0, 0.0]],
    R=[[0.3, 0.1], [0.1, 0.2]],
    m0=[0.5, -0.5, 0.0],
    P0=np.eye(3),
)
OBSERVATION = jnp.array([1.0, -0.3])
NOW = mpfjax.Step(LINEAR, OBSERVATION)
PREVIOUS = jnp.asarray(np.random.default_rng(0).normal(size=(20, 3)), jnp.float32)


@eqx.filter_jit
def propose(proposal, key, now, previous):
    return proposal.propose(key, now, previous)


def gaussian_fit(previous, observation):
    """Mean and covariance of p(x_t | x_{t-1}, y_t) on the linear model, by numpy."""
    A, Q, H, R = (np.asarray(part, float) for part in (LINEAR.A, LINEAR.Q, LINEAR.H, LINEAR.R))
    precision = np.linalg.inv(Q) + H.T @ np.linalg.inv(R) @ H
    covariance = np.linalg.inv(precision)
    prior = np.asarray(previous, float) @ A.T
    information = prior @ np.linalg.inv(Q) + H.T @ np.linalg.inv(R) @ np.asarray(observation)
    return information @ covariance, covariance


@pytest.mark.exactness
def test_the_log_density_is_that_of_the_gaussian_it_draws_from():
    proposal = GaussNewtonProposal(inflation=1.3)
    states, log_density = propose(proposal, jax.random.key(1), NOW, PREVIOUS)
    means, covariance = gaussian_fit(PREVIOUS, OBSERVATION)
    expected = [
        scipy.stats.multivariate_normal(mean, 1.3**2 * covariance).logpdf(state)
        for mean, state in zip(means, np.asarray(states), strict=True)
    ]
    np.testing.assert_allclose(log_density, expected, rtol=1e-3, atol=1e-3)
    other = proposal.log_density(NOW, states, PREVIOUS)
    np.testing.assert_allclose(log_density, other, rtol=1e-3, atol=1e-3)


@pytest.mark.exactness
def test_on_a_linear_model_the_weight_is_the_normaliser_whatever_is_drawn():
    """The locally optimal proposal: L D / q is p(y_t | x_{t-1}), which SciPy knows."""
    proposal = GaussNewtonProposal(inflation=1.0, num_iterations=1)
    states, log_density = propose(proposal, jax.random.key(3), NOW, PREVIOUS)
    weights = LINEAR.log_likelihood(OBSERVATION, states) - log_density
    weights += LINEAR.log_transition(states, PREVIOUS)
    H, Q, R = (np.asarray(part, float) for part in (LINEAR.H, LINEAR.Q, LINEAR.R))
    predictive = scipy.stats.multivariate_normal(np.zeros(2), H @ Q @ H.T + R)
    predicted = np.asarray(LINEAR.observation_mean(LINEAR.transition_mean(PREVIOUS)), float)
    expected = predictive.logpdf(np.asarray(OBSERVATION, float) - predicted)
    inflated = GaussNewtonProposal(inflation=1.7)
    for found in (weights, inflated.log_normaliser(NOW, PREVIOUS)):
        np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-3)


def test_on_the_quadratic_model_it_finds_the_mode_of_each_particles_own_side():
    previous, ends = [1.2, -1.2, 0.8, -0.8], [1.0, -1.0, 1.0, -1.0]
    with float64():
        model = mpfjax.QuadraticModel(0.5, 0.1)
        proposal = GaussNewtonProposal(num_iterations=8, inflation=0.01)
        key, now = jax.random.key(5), mpfjax.Step(model, jnp.array(1.0))
        states, log_density = propose(proposal, key, now, jnp.array(previous))
        assert states.dtype == log_density.dtype == np.float64
    np.testing.assert_allclose(states, ends, atol=0.05)


class TestNetworkProposal:
    MODEL = mpfjax.QuadraticModel(0.2, 0.2, -1.5, 1.5)
    OBSERVATIONS = jnp.array([1.0, 0.8, 0.9, 1.3, 1.2, 0.7])

    def filter(self, proposal):
        return mpfjax.particle_filter(self.MODEL, 24, proposal=proposal)

    def log_errors(self, filter, num_runs):
        """log Ẑ less log Z."""
        keys = jax.random.split(jax.random.key(3), num_runs)
        run = mpfjax.monte_carlo(keys, filter, self.OBSERVATIONS, lambda mixture: None)
        exact = grid_filter(self.MODEL, self.OBSERVATIONS, jnp.linspace(-4.0, 4.0, 801))
        return np.asarray(run.log_marginal_likelihood - exact.log_marginal_likelihood, float)

    @pytest.mark.exactness
    def test_the_evidence_is_unbiased_before_it_has_learned_anything(self):
        proposal = NetworkProposal.create(jax.random.key(0), 1, 1, 0.4)
        assert_unbiased(np.exp(self.log_errors(self.filter(proposal), 2000)), loosest=0.03)

    @pytest.mark.weekly
    def test_it_learns_by_the_filters_own_bound(self):
        """It ends above where it began, and below log Z as every bound must.

        The derivative of one run has heavy tails. Over few seeds the rare large ones decide the
        optimisation, and the compiler's rounding decides them; so there are many seeds, and steps
        that end at nothing. Both bounds are of runs that the optimisation has not seen.
        """
        start = self.filter(NetworkProposal.create(jax.random.key(0), 1, 1, 0.8))
        run = mpfjax.tuning.fit(
            jax.random.key(4), start, self.OBSERVATIONS,
            optax.adam(optax.cosine_decay_schedule(0.03, 60)), 60,
            parameters={"network": lambda filter: filter.moves[1].proposal.network},
            num_seeds=64, progress=False,
        )  # fmt: skip
        before, after = (-self.log_errors(filter, 1000) for filter in (start, run.tuned))
        errors = [gap.std() / np.sqrt(1000) for gap in (before, after)]
        assert after.mean() > 4 * errors[1]
        assert after.mean() + 4 * np.hypot(*errors) < 0.8 * before.mean()
