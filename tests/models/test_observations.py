"""A `Series` says in one argument what `inputs=` and `missing=` say in two."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax import Series
from mpfjax.models.series import as_series
from tests import switching
from tests.together.test_inputs import FILTER, INPUTS, OBSERVATIONS
from tests.user_models import ScalarLinear, TwoSensors

HOLED = OBSERVATIONS.at[1].set(jnp.nan)
KEY = jax.random.key(0)


def mean(mixture):
    return mixture.mean()


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


@pytest.mark.exactness
def test_islands_take_the_keywords_too():
    run = mpfjax.run_islands(KEY, FILTER, HOLED, mean, num_islands=2, inputs=INPUTS, missing="skip")
    expected = mpfjax.run_islands(KEY, FILTER, Series.skipping(HOLED, INPUTS), mean, num_islands=2)
    np.testing.assert_array_equal(run.collected, expected.collected)


@pytest.mark.exactness
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


class Beams(ScalarLinear):
    """Ranges; where nothing came back, a beam is infinite."""

    handles_missing = True

    def log_likelihood(self, observation, states):
        hit = jnp.isfinite(observation)
        errors = jnp.where(hit, observation, 0.0)[None] - states[:, None]
        return -0.5 * jnp.sum(jnp.where(hit[None], errors, 0.0) ** 2, axis=1)


class HitsAlone(Beams):
    handles_missing = False


@pytest.mark.exactness
def test_scans_with_infinities_are_the_models_or_are_counted(recwarn):
    scans = np.array([[1.0, np.inf, 0.9], [np.inf] * 3, [np.nan] * 3, [1.0, 1.1, np.nan]])
    for data in (scans[[0, 1, 1, 3]], Series.skipping(scans)):
        run = mpfjax.run_filter(KEY, mpfjax.particle_filter(Beams(), 20), data)
        assert (run.log_likelihood_increments[jnp.array([0, 3])] != 0).all()
    mpfjax.particle_filter(Beams(), 20).step(KEY, run.final, scans[0])
    assert not recwarn.list
    refusing = mpfjax.particle_filter(HitsAlone(), 20)
    with pytest.warns(RuntimeWarning, match="2 of 4 steps are skipped.*handles_missing"):
        run = mpfjax.run_filter(KEY, refusing, scans, missing="skip")
    assert (run.log_likelihood_increments == 0).all()
    switches = mpfjax.particle_filter(switching.MODEL, 20)
    with pytest.raises(ValueError, match="observations: infinite at index 0"):
        mpfjax.run_filter(KEY, switches, switching.OBSERVATIONS.at[0].set(jnp.inf))
