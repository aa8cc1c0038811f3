"""Rao-Blackwellised backward sampling against all sequences of regimes, and a Kalman smoother."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax import Filter, PropagateRegimes
from mpfjax.exact import switching_filter
from mpfjax.smoothing import sample_trajectories
from tests.moves import test_marginalised_mixed as tests_mixed
from tests.moves.test_marginalised_mixed import Mixed, whole
from tests.smoothing import exact_smoothers
from tests.switching import MODEL, NUM_REGIMES, OBSERVATIONS

NUM_RUNS, NUM_TRAJECTORIES = 40, 100


def smoothed(filter, model, observations, num_runs):
    """Trajectories of several runs of a filter."""

    def one(key):
        run = mpfjax.run_filter(key, filter, observations, None)
        key = jax.random.fold_in(key, 1)
        return sample_trajectories(key, model, run, NUM_TRAJECTORIES, observations=observations)

    return jax.lax.map(one, jax.random.split(jax.random.key(0), num_runs))


def assert_close(estimates, expected):
    """The mean over runs is within 4 standard errors, with room for the bias of order 1 / N."""
    error = estimates.std(axis=0) / np.sqrt(len(estimates))
    assert error.max() < 0.05
    assert (np.abs(estimates.mean(axis=0) - expected) < 4 * error + 2e-3).all()


def test_regimes_and_moments_are_those_of_all_sequences():
    filter = Filter(MODEL, [PropagateRegimes(MODEL)], 200)
    found = jax.jit(lambda: smoothed(filter, MODEL, OBSERVATIONS, NUM_RUNS))()
    exact = switching_filter(MODEL, OBSERVATIONS)
    latent = np.asarray(found.latent)
    shares = np.stack([(latent == k).mean(axis=1) for k in range(NUM_REGIMES)], axis=-1)
    assert_close(shares, np.asarray(exact.smoothed_regime_probabilities))
    mean, truth = np.asarray(found.mean), np.asarray(exact.smoothed_means)
    assert_close(mean.mean(axis=1), truth)
    squares = np.asarray(found.covariance) + mean[..., :, None] * mean[..., None, :]
    second = np.asarray(exact.smoothed_covariances) + truth[:, :, None] * truth[:, None, :]
    assert_close(squares.mean(axis=1), second)


@pytest.mark.thorough
def test_in_the_mixed_form_they_are_those_of_the_smoother_of_the_whole_state():
    filter, series = mpfjax.particle_filter(Mixed(), 300), tests_mixed.OBSERVATIONS
    found = jax.jit(lambda: smoothed(filter, Mixed(), series, NUM_RUNS))()
    means, covariance = exact_smoothers.gaussian_smoother(whole(True), np.asarray(series))
    blocks = [covariance[3 * s : 3 * s + 3, 3 * s : 3 * s + 3] for s in range(len(means))]
    assert_close(np.asarray(found.latent).mean(axis=1)[..., 0], means[:, 0])
    mean = np.asarray(found.mean)
    assert_close(mean.mean(axis=1), means[:, 1:])
    squares = np.asarray(found.covariance) + mean[..., :, None] * mean[..., None, :]
    second = np.stack(blocks)[:, 1:, 1:] + means[:, 1:, None] * means[:, None, 1:]
    assert_close(squares.mean(axis=1), second)


def test_misuse_is_named():
    filter = mpfjax.particle_filter(MODEL, 10)
    run = mpfjax.run_filter(jax.random.key(0), filter, OBSERVATIONS, None)
    key = jax.random.key(1)
    for options, name in (
        ({}, "observations: there are none"),
        ({"observations": OBSERVATIONS[:3]}, "observations: .3. steps"),
        ({"observations": OBSERVATIONS, "method": "mcmc"}, "method"),
    ):
        with pytest.raises(ValueError, match=name):
            sample_trajectories(key, MODEL, run, 5, **options)
    quadratic = mpfjax.QuadraticModel()
    plain = mpfjax.particle_filter(quadratic, 10)
    run = mpfjax.run_filter(key, plain, jnp.ones(3), None)
    with pytest.raises(ValueError, match="observations: only"):
        sample_trajectories(key, quadratic, run, 5, observations=jnp.ones(3))
