"""A missing number is the model's to deal with: what is tuned weighs what the filter weighs."""

import jax
import numpy as np
import optax
import pytest

import mpfjax
from mpfjax.tuning import fit, metropolis_hastings, standard_errors
from mpfjax.tuning.evidence import pose_evidence
from mpfjax.tuning.problem import scores
from tests.user_models import TwoSensors

FILTER = mpfjax.particle_filter(TwoSensors(), 50, gradient="stop")
SEEN = np.array([[1.0, np.nan], [0.7, 0.3], [np.nan, 0.9], [np.nan, np.nan], [0.4, -0.2]])
GAIN = {"gain": lambda filter: filter.model.gain}
KEY = jax.random.key(0)


@pytest.mark.parametrize("missing", ["error", "skip"])
def test_the_objective_is_the_log_evidence_of_a_run(missing):
    series = mpfjax.Series(SEEN, skips_missing=missing == "skip")
    problem = pose_evidence(FILTER, series, GAIN, None)
    (key,) = jax.random.split(jax.random.fold_in(KEY, 0), 1)
    run = mpfjax.run_filter(key, FILTER, SEEN, lambda mixture: None, missing=missing)
    (found,), _ = scores(problem, problem.start(), KEY[None])
    np.testing.assert_allclose(found, run.log_marginal_likelihood, rtol=1e-4)


@pytest.mark.thorough
def test_steps_of_which_a_part_is_there_are_in_every_likelihood():
    """Every step lacks a sensor: taken for missing, all would have log Ẑ = 0 and no curvature."""
    lacks = np.arange(2)[None] == np.arange(6)[:, None] % 2
    half = np.where(lacks, np.nan, np.float32([0.9, -0.4]))
    options, series = {"parameters": GAIN}, mpfjax.Series.skipping(half)
    filter = mpfjax.particle_filter(TwoSensors(), 200, gradient="stop")
    runs = mpfjax.monte_carlo(jax.random.split(KEY, 64), filter, half, lambda mixture: None)
    log_evidence = float(np.mean(runs.log_marginal_likelihood))
    fitted = fit(KEY, filter, series, optax.adam(0.01), 1, **options, progress=False)
    assert fitted.history["log_marginal_likelihood"][0] == pytest.approx(log_evidence, abs=0.3)
    assert standard_errors(KEY, filter, series, **options, num_seeds=64)["gain"] > 0
    chain = metropolis_hastings(
        KEY, filter, series, 2, log_prior=lambda parameters: 0.0 * parameters["gain"],
        proposal_deviations=1e-6, progress=False, **options,
    )  # fmt: skip
    np.testing.assert_allclose(chain.log_marginal_likelihoods, log_evidence, atol=1.0)
