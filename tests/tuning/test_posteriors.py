"""Chains have the exact posterior, with inputs, a missing observation and ten particles.

Every sampler on every filter is in `tests/matrix`.
"""

import jax
import numpy as np
import pytest

import mpfjax
from mpfjax.tuning import Interval, metropolis_hastings, particle_gibbs
from tests.marking import weekly
from tests.tuning.exact_posteriors import (
    SERIES,
    A,
    Pushed,
    log_prior_of_a,
    posterior_of_a,
    sample_a,
)

KEY = jax.random.key(1)
FILTER = mpfjax.particle_filter(Pushed(), 10)
OF_A = {"parameters": A, "progress": False}
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


@pytest.mark.exactness
@pytest.mark.parametrize("sample", [by_gibbs, *weekly([by_metropolis])])
def test_chains_have_the_exact_mean_and_variance(sample):
    """Over chains, within four standard errors."""
    chains, exact = sample()
    moments = np.array([exact.mean, exact.variance])
    found = np.stack([chains.mean(axis=1), ((chains - exact.mean) ** 2).mean(axis=1)], axis=1)
    error = found.std(axis=0, ddof=1) / np.sqrt(len(found))
    assert (error < 0.08 * np.array([np.sqrt(exact.variance), exact.variance])).all()
    z = (found.mean(axis=0) - moments) / error
    assert np.abs(z).max() < 4, z
