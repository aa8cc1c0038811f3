"""A `Series` says in one argument what `inputs=` and `missing=` say in two."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax import Series
from mpfjax.models.observations import as_series
from tests.test_inputs import INPUTS, OBSERVATIONS, Driven, mean
from tests.user_models import ScalarLinear, TwoSensors

HOLED = OBSERVATIONS.at[1].set(jnp.nan)
FILTER = mpfjax.particle_filter(Driven(), 20)
KEY = jax.random.key(0)


@pytest.mark.parametrize(
    "series",
    [
        Series.skipping(HOLED, INPUTS),
        Series(HOLED, INPUTS, present=~jnp.isnan(HOLED)),
        Series(HOLED.at[1].set(3.0), INPUTS, present=np.asarray(~jnp.isnan(HOLED))),
    ],
)
def test_it_is_run_as_the_keywords_are(series):
    run = mpfjax.run_filter(KEY, FILTER, series, mean)
    expected = mpfjax.run_filter(KEY, FILTER, HOLED, mean, inputs=INPUTS, missing="skip")
    np.testing.assert_array_equal(run.collected, expected.collected)
    assert run.log_likelihood_increments[1] == 0


def test_within_jit_it_is_the_same():
    def run(series):
        return mpfjax.run_filter(KEY, FILTER, series).log_marginal_likelihood

    series = Series.skipping(HOLED, INPUTS)
    np.testing.assert_allclose(jax.jit(run)(series), run(series), rtol=1e-6)


def test_what_is_missing_is_the_models_to_say():
    seen = np.array([[1.0, np.nan], [np.nan, np.nan], [np.nan, 2.0]])
    skipping = Series.skipping(seen)
    np.testing.assert_array_equal(as_series(skipping, TwoSensors()).present, [True, False, True])
    np.testing.assert_array_equal(as_series(skipping, ScalarLinear()).present, 3 * [False])
    assert as_series(Series(seen), TwoSensors()).present is None
    mask = Series(seen, present=np.array([True, True, False]), skips_missing=True)
    np.testing.assert_array_equal(as_series(mask, TwoSensors()).present, [True, False, False])


@pytest.mark.parametrize(
    ("data", "options", "named"),
    [
        (Series(HOLED, present=np.arange(len(HOLED)) != 2), {}, "observations: NaN .* index 1"),
        (Series(OBSERVATIONS, INPUTS), {"inputs": INPUTS}, "observations: a Series says itself"),
    ],
)
def test_what_would_be_run_as_something_else_is_refused(data, options, named):
    with pytest.raises(ValueError, match=named):
        mpfjax.run_filter(KEY, FILTER, data, **options)
