"""What is tuned is log Ẑ of a run: with inputs, with missing numbers, and with the exact score."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax.exact import kalman_filter
from mpfjax.tuning import log_density
from mpfjax.tuning.evidence import pose_evidence
from mpfjax.tuning.problem import scores
from tests.marking import exactness
from tests.together.test_inputs import INPUTS, OBSERVATIONS, Driven, in_matrices
from tests.user_models import TwoSensors

SEEN = np.array([[1.0, np.nan], [0.7, 0.3], [np.nan, 0.9], [np.nan, np.nan], [0.4, -0.2]])
KEY, GAIN = jax.random.key(0), {"gain": lambda filter: filter.model.gain}


@pytest.mark.parametrize("missing", ["skip", *exactness(["error"])])
def test_a_missing_number_is_the_models_to_deal_with(missing):
    filter = mpfjax.particle_filter(TwoSensors(), 50, gradient="stop")
    series = mpfjax.Series(SEEN, skips_missing=missing == "skip")
    problem = pose_evidence(filter, series, GAIN, None)
    (key,) = jax.random.split(jax.random.fold_in(KEY, 0), 1)
    run = mpfjax.run_filter(key, filter, SEEN, lambda mixture: None, missing=missing)
    (found,), _ = scores(KEY[None], problem, problem.start())
    np.testing.assert_allclose(found, run.log_marginal_likelihood, rtol=1e-4)


@pytest.mark.exactness
def test_the_score_of_a_controls_coefficient_is_that_of_kalmans_filter():
    """The gradient that other libraries' samplers take: times Ẑ it is unbiased, over seeds."""

    def log_prior(parameters):
        return -0.5 * parameters["gain"] ** 2

    def exact(gain):
        model, inputs = in_matrices(gain)
        run = kalman_filter(model, mpfjax.Series(OBSERVATIONS[:, None], inputs))
        return run.log_marginal_likelihood + log_prior({"gain": gain})

    filter = mpfjax.particle_filter(Driven(), 100, gradient="stop")
    series = mpfjax.Series(OBSERVATIONS, INPUTS)
    density = log_density(filter, series, log_prior=log_prior, parameters=GAIN)
    score = jax.jit(jax.vmap(jax.value_and_grad(density), (None, 0)))
    for gain in (0.0, 1.2):
        values, slopes = score({"gain": jnp.array(gain)}, jax.random.split(KEY, 1000))
        value, slope = jax.value_and_grad(exact)(gain)
        errors = np.exp(np.asarray(values, float) - value) * (np.asarray(slopes["gain"]) - slope)
        standard = errors.std() / np.sqrt(len(errors))
        assert 0 < standard < 0.3
        assert abs(errors.mean()) < 4 * standard
