"""Every sampler has the exact posterior, with inputs, a missing observation and ten particles."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax import Series
from mpfjax.tuning import Interval, Positive, metropolis_hastings, particle_gibbs, sequential, smc2
from tests.marking import weekly
from tests.tuning.exact_posteriors import (
    DEVIATION_OF_LOG_SIGMA,
    INPUTS,
    MEAN_OF_LOG_SIGMA,
    OBSERVATIONS,
    SERIES,
    SIGMA,
    SQUARES,
    A,
    Pushed,
    eager_mixture,
    log_prior_of_a,
    log_prior_of_sigma,
    posterior_of_a,
    posterior_of_log_sigma,
    sample_a,
)

KEY = jax.random.key(1)
FILTER = mpfjax.particle_filter(Pushed(), 10)
OF_A = {"parameters": A, "progress": False}
OF_SIGMA = {
    "parameters": SIGMA, "transforms": {"sigma_y": Positive()}, "log_prior": log_prior_of_sigma,
    "progress": False,
}  # fmt: skip
CHAINS = {"num_chains": 60, "burn_in": 20}


def by_metropolis():
    """Of a in an interval, so that the Jacobian counts."""
    run = metropolis_hastings(
        KEY, FILTER, SERIES, 400, log_prior=log_prior_of_a, transforms={"a": Interval(-0.3, 1.1)},
        proposal_deviations=1.5, **CHAINS, **OF_A,
    )  # fmt: skip
    assert 0.1 < run.acceptance_rate < 0.9
    return run.parameters["a"], posterior_of_a(-0.3, 1.1)


def by_gibbs():
    """From deviations that are a hundred times too small, from which the scale is learned."""
    run = particle_gibbs(
        KEY, FILTER, SERIES, 300, log_prior=log_prior_of_a, sample_prior=sample_a,
        proposal_deviations=0.005, **CHAINS | {"burn_in": 200}, **OF_A,
    )  # fmt: skip
    assert (run.renewal_rates > 0.5).all()
    assert 0.3 < run.acceptance_rate < 0.6
    return run.parameters["a"], posterior_of_a()


def by_gibbs_through_a_mixture():
    """With K-means, merging and splitting in the chain."""
    run = particle_gibbs(
        KEY, eager_mixture(), SQUARES, 300, proposal_deviations=0.8, **CHAINS, **OF_SIGMA
    )
    assert 0.2 < run.acceptance_rate < 0.8
    assert run.trajectories.shape == run.renewed.shape == (60, 300, len(SQUARES) + 1)
    return np.log(run.parameters["sigma_y"]), posterior_of_log_sigma()


@pytest.mark.exactness
@pytest.mark.parametrize(
    "sample",
    [
        by_gibbs,  # Metropolis-Hastings and SMC² have theirs in `test_exact_answers.py`
        *weekly([by_metropolis, by_gibbs_through_a_mixture]),
    ],
)
def test_chains_have_the_exact_mean_and_variance(sample):
    """Over chains, within four standard errors."""
    chains, exact = sample()
    moments = np.array([exact.mean, exact.variance])
    found = np.stack([chains.mean(axis=1), ((chains - exact.mean) ** 2).mean(axis=1)], axis=1)
    error = found.std(axis=0, ddof=1) / np.sqrt(len(found))
    assert (error < 0.08 * np.array([np.sqrt(exact.variance), exact.variance])).all()
    z = (found.mean(axis=0) - moments) / error
    assert np.abs(z).max() < 4, z


def part(first, last):
    return Series.skipping(OBSERVATIONS[first:last], INPUTS[first:last])


def growing(key):
    """Observations come in two parts."""
    filter = mpfjax.particle_filter(Pushed(), 10)
    run = smc2(
        key, filter, part(0, 3), 120, sample_prior=sample_a, log_prior=log_prior_of_a, **OF_A
    ).extend(part(3, 8), progress=False)
    return run, run.parameters["a"], posterior_of_a()


def through_a_mixture(key):
    """With K-means, merging and splitting in the chain."""

    def sample_prior(key):
        noise = jax.random.normal(key)
        return {"sigma_y": jnp.exp(MEAN_OF_LOG_SIGMA + DEVIATION_OF_LOG_SIGMA * noise)}

    run = smc2(key, eager_mixture(), SQUARES, 120, sample_prior=sample_prior, **OF_SIGMA)
    np.testing.assert_array_equal(
        np.isfinite(run.acceptance_rates), run.effective_sample_sizes < 0.8 * 120
    )
    return run, np.log(run.parameters["sigma_y"]), posterior_of_log_sigma()


@pytest.mark.weekly
@pytest.mark.parametrize("sample", [growing, through_a_mixture])
def test_smc2_has_the_exact_evidence_mean_and_variance(sample, monkeypatch):
    """Over independent runs: estimates times the estimated evidence have no bias."""
    monkeypatch.setattr(sequential, "_ESS_THRESHOLD", 0.8)
    errors = []
    for key in jax.random.split(jax.random.key(4), 30):
        run, x, exact = sample(key)
        ratio = np.exp(run.log_marginal_likelihood - exact.log_evidence)
        assert run.weights.sum() == pytest.approx(1.0, abs=1e-4)
        mean, square = run.weights @ x, run.weights @ (x - exact.mean) ** 2
        errors.append([ratio - 1, ratio * (mean - exact.mean), ratio * (square - exact.variance)])
    errors = np.array(errors)
    standard = errors.std(axis=0, ddof=1) / np.sqrt(len(errors))
    spread = np.array([1.0, np.sqrt(exact.variance), exact.variance])
    assert (standard < 0.12 * spread).all(), standard / spread
    z = errors.mean(axis=0) / standard
    assert np.abs(z).max() < 4, z
