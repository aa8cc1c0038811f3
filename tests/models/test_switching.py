"""The switching model, and its exact answer by enumeration, against formulas of other kinds."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal

import mpfjax
from mpfjax.exact import kalman_filter, kalman_smoother, switching_filter
from tests.exact.test_exact import joint_gaussian
from tests.switching import INITIAL, MODEL, NUM_REGIMES, OBSERVATIONS, PARTS, TRANSITIONS


def parts_of(regime):
    """The matrices of one regime, as numpy."""
    own = {name: np.array(value, float) for name, value in PARTS.items()}
    parts = {name: own[name][regime] if name in "FQRb" else own[name] for name in own}
    return parts | {"A": parts.pop("F")}


def test_the_evidence_and_the_smoothed_regimes_are_those_of_the_joint_normal_of_all_observations():
    """p(y_1, y_2 | z_0, z_1, z_2) is one normal density, whose moments follow from x_0."""
    log_joint = {}
    for sequence in itertools.product(range(NUM_REGIMES), repeat=3):
        prior = INITIAL[sequence[0]] * TRANSITIONS[sequence[:-1], sequence[1:]].prod()
        steps = [parts_of(regime) for regime in sequence[1:]]
        mean, covariance = joint_gaussian(PARTS["m0"], PARTS["P0"], steps)
        of_seen = multivariate_normal(mean[6:], covariance[6:, 6:])
        log_joint[sequence] = np.log(prior) + of_seen.logpdf(OBSERVATIONS[:2, 0])
    run = switching_filter(MODEL, OBSERVATIONS[:2])
    log_evidence = np.logaddexp.reduce(list(log_joint.values()))
    np.testing.assert_allclose(run.log_marginal_likelihood, log_evidence, rtol=1e-5)
    for time in range(3):
        found = np.asarray(run.smoothed_regime_probabilities)[time]
        for k in range(NUM_REGIMES):
            expected = sum(np.exp(log_joint[s] - log_evidence) for s in log_joint if s[time] == k)
            np.testing.assert_allclose(found[k], expected, rtol=1e-4)


@pytest.mark.exactness
def test_with_equal_regimes_it_is_the_kalman_filter_and_smoother_where_numbers_are_missing_too():
    parts = parts_of(1)
    push = parts.pop("b")
    linear = mpfjax.LinearGaussianModel(B=push[:, None], **parts)
    model = mpfjax.SwitchingLinearGaussianModel(TRANSITIONS, F=parts.pop("A"), b=push, **parts)
    observations, inputs = OBSERVATIONS.at[2].set(jnp.nan), jnp.ones((len(OBSERVATIONS), 1))
    series = mpfjax.Series.skipping(observations)
    found = switching_filter(model, series)
    series = mpfjax.Series.skipping(observations, inputs)
    of_filter = kalman_filter(linear, series)
    of_smoother = kalman_smoother(linear, series)
    for one, other in (
        (found.means, of_filter.means),
        (found.covariances, of_filter.covariances),
        (found.log_likelihood_increments, of_filter.log_likelihood_increments),
        (found.smoothed_means, of_smoother.means),
        (found.smoothed_covariances, of_smoother.covariances),
    ):
        np.testing.assert_allclose(one, other, atol=1e-4)


@pytest.mark.exactness
def test_draws_of_regimes_follow_the_transition_matrix():
    latent = jnp.repeat(jnp.arange(NUM_REGIMES), 4000)
    noise = jax.random.normal(jax.random.key(1), (12000, 1))
    for drawn in (
        MODEL.sample_transition(jax.random.key(0), latent),
        MODEL.transition_from_noise(noise, latent),
    ):
        rows = np.asarray(drawn).reshape(NUM_REGIMES, 4000)
        shares = np.stack([np.bincount(row, minlength=NUM_REGIMES) / 4000 for row in rows])
        assert np.abs(shares - TRANSITIONS).max() < 4 * 0.5 / np.sqrt(4000)
    start = np.asarray(MODEL.sample_initial(jax.random.key(2), 4000))
    shares = np.bincount(start, minlength=NUM_REGIMES) / 4000
    assert np.abs(shares - INITIAL).max() < 4 * 0.5 / np.sqrt(4000)
    pairs = MODEL.all_transitions(latent)
    for k, (regime, log_probability) in enumerate(pairs):
        assert (np.asarray(regime) == k).all()
        np.testing.assert_allclose(log_probability, MODEL.log_transition(regime, latent), rtol=1e-6)
