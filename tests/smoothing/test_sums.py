"""Smoothed sums online: their run, no lag and a long one, functions, and bad input."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax.smoothing import smoothed_sums
from tests.smoothing.registry import MODELS, statistics_for
from tests.smoothing.test_trajectories import QUADRATIC, SQUARES, NoTransition

ONE, SEEN = MODELS["one dimension"]
statistics = statistics_for(ONE)


@pytest.mark.thorough
def test_the_filters_run_is_that_of_run_filter_and_a_long_lag_is_none():
    filter = mpfjax.particle_filter(ONE, 60)
    run = mpfjax.run_filter(jax.random.key(3), filter, SEEN, missing="skip")
    whole, lagged = (
        smoothed_sums(jax.random.key(3), filter, mpfjax.Series.skipping(SEEN), statistics, lag=lag)
        for lag in (None, 50)
    )
    for sums in (whole, lagged):
        np.testing.assert_array_equal(sums.run.final.particles, run.final.particles)
        np.testing.assert_array_equal(
            sums.run.log_likelihood_increments, run.log_likelihood_increments
        )
    assert whole.terms is None
    np.testing.assert_allclose(whole.sums, lagged.sums, rtol=1e-4, atol=1e-5)
    total = np.asarray(lagged.terms).sum(axis=0)
    np.testing.assert_allclose(total, whole.sums[-1], rtol=1e-4, atol=1e-5)


def test_no_lag_is_filtering_and_counts_are_averaged():
    filter = mpfjax.particle_filter(QUADRATIC, 50, ess_threshold=0.5)
    run = mpfjax.run_filter(
        jax.random.key(4), filter, SQUARES, lambda mixture: mixture.average(mixture.particles > 1)
    )
    found = smoothed_sums(
        jax.random.key(4), filter, SQUARES, lambda before, after: after > 1, lag=0
    )
    np.testing.assert_allclose(found.terms, run.collected, rtol=1e-5)
    np.testing.assert_allclose(found.sums, np.cumsum(run.collected), rtol=1e-5)


def test_a_model_of_one_particle_takes_a_function_of_one():
    class Walk:
        def sample_initial(self, key):
            return jax.random.normal(key)

        def sample_transition(self, key, state):
            return state + jax.random.normal(key)

        def log_likelihood(self, observation, state):
            return -((observation - state) ** 2)

        def log_transition(self, state, previous_state):
            return -0.5 * (state - previous_state) ** 2

    filter = mpfjax.particle_filter(mpfjax.per_particle(Walk()), 20)
    found = smoothed_sums(
        jax.random.key(0), filter, np.ones(3), lambda before, after: jnp.where(after > before, 1, 0)
    )
    assert 0 < float(found.sums[-1]) < 3


@pytest.mark.usefixtures("as_installed")
class TestBadInput:
    FILTER = mpfjax.particle_filter(QUADRATIC, 20)

    @pytest.mark.parametrize(
        ("options", "named"),
        [
            ({"key": 0}, "key"),
            ({"filter": None}, "filter"),
            (
                {"filter": mpfjax.particle_filter(NoTransition(), 20)},
                "NoTransition defines no log_transition",
            ),
            ({"observations": []}, "observations"),
            ({"observations": np.array([1.0, np.nan])}, "observations"),
            ({"function": 3}, "function: 3"),
            ({"function": lambda before, after: before[:3]}, r"function: .*\(3,\)"),
            ({"function": lambda before, after: after.sum()}, "function: "),
            ({"function": lambda before, after: ()}, "function: "),
            ({"lag": -1}, "lag: -1"),
            ({"lag": 1.5}, "lag: 1.5"),
            ({"method": "best"}, "method: 'best'"),
            ({"num_draws": 0}, "num_draws: 0"),
        ],
    )
    def test_is_named(self, options, named):
        arguments = {
            "key": jax.random.key(0), "filter": self.FILTER, "observations": SQUARES,
            "function": lambda before, after: after - before,
        }  # fmt: skip
        with pytest.raises(ValueError, match=named):
            smoothed_sums(**arguments | options)

    def test_an_error_of_the_function_says_where_it_is_from(self):
        with pytest.raises(KeyError) as error:
            smoothed_sums(
                jax.random.key(0), self.FILTER, SQUARES, lambda before, after: {}["missing"]
            )
        assert any("in function" in note for note in error.value.__notes__)
