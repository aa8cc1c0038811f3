"""What is tuned is log Ẑ of a run, with missing numbers, and with the exact score."""

import jax
import numpy as np
import pytest

import mpfjax
from mpfjax.tuning.evidence import pose_evidence
from mpfjax.tuning.problem import scores
from tests.marking import exactness
from tests.matrix.law import kalman, score
from tests.tuning.examples import INPUTS, LAW, OBSERVATIONS, SERIES, Pushed, eager_mixture
from tests.unbiased import assert_unbiased, ratios_to
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
    (found,), _ = scores(KEY[None], problem, problem.start(), pooled=False)
    np.testing.assert_allclose(found, run.log_marginal_likelihood, rtol=1e-4)


@pytest.mark.parametrize("name", ["particle filter", *exactness(["mixture"])])
def test_the_score_by_fishers_identity_is_exact_without_any_gradient_of_the_moves(name):
    """Times Ẑ it is unbiased: in x_0, steps and observations, with inputs and a missing y."""
    names = {"a": "a", "m": "m0", "q": "q", "r": "r"}
    filter = mpfjax.particle_filter(Pushed(), 20)
    if name == "mixture":
        filter = eager_mixture(20).replace(model=Pushed())
    parameters = {n: lambda filter, n=n: getattr(filter.model, n) for n in names}
    problem = pose_evidence(filter, SERIES, parameters, None, "fisher")

    @jax.jit
    def value_and_score(key):
        return jax.value_and_grad(problem.value, argnums=1)(key, problem.start())

    values, slopes = jax.vmap(value_and_score)(jax.random.split(KEY, 2000))
    ratios = ratios_to(kalman(LAW, OBSERVATIONS, INPUTS).log_z, values)
    for n, name in names.items():
        exact = score(LAW, OBSERVATIONS, INPUTS, name)
        assert_unbiased(ratios * (np.asarray(slopes[n], float) - exact), 0.0, loosest=0.1)
