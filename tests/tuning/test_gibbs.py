"""Particle Gibbs has the exact posterior, and learns the scale of its steps."""

import jax
import numpy as np
import pytest

import mpfjax
from tests.matrix.law import posterior
from tests.tuning.examples import INPUTS, LAW, OBSERVATIONS, PRIOR, SERIES, A, Pushed
from tests.tuning.examples import log_prior_of_a as log_prior
from tests.tuning.examples import sample_a as sample_prior
from tests.unbiased import assert_unbiased


@pytest.mark.exactness
def test_chains_have_the_exact_mean_and_variance():
    """From deviations that are a hundred times too small, with inputs and a missing observation."""
    filter = mpfjax.particle_filter(Pushed(), 10)
    run = mpfjax.tuning.particle_gibbs(
        jax.random.key(1), filter, SERIES, 300, log_prior=log_prior, sample_prior=sample_prior,
        proposal_deviations=0.005, num_chains=60, burn_in=200, parameters=A, progress=False,
    )  # fmt: skip
    assert (run.renewal_rates > 0.5).all()
    assert 0.3 < run.acceptance_rate < 0.6
    mean, variance = posterior(LAW, OBSERVATIONS, INPUTS, "a", prior=PRIOR)
    gaps = (np.asarray(run.parameters["a"], float) - mean) / np.sqrt(variance)
    for power, moment in ((1, 0.0), (2, 1.0)):
        assert_unbiased((gaps**power).mean(axis=1), moment, loosest=0.08)
