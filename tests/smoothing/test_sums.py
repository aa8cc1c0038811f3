"""Smoothed sums and fixed lags, online, against the exact smoothers."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax.smoothing import smoothed_sums
from tests.marking import quick_of
from tests.smoothing.exact_smoothers import gaussian_smoother
from tests.smoothing.test_trajectories import (
    FILTERS,
    GRID,
    QUADRATIC,
    SEEN,
    SQUARES,
    NoTransition,
    assert_near,
    grid_truth,
)

NUM_RUNS, LAG = 800, 2
FOUR = mpfjax.LinearGaussianModel(
    A=0.9 * np.eye(4) + 0.1 * np.eye(4, k=1), Q=0.2 * np.eye(4) + 0.1,
    H=np.eye(2, 4), R=0.5 * np.eye(2), m0=np.full(4, 0.3), P0=np.eye(4),
)  # fmt: skip
IN_FOUR = np.array([[0.8, 0.1], [np.nan, np.nan], [0.5, -1.0], [1.2, 0.3]], np.float32)
ALL = FILTERS | {"four dimensions": (mpfjax.particle_filter(FOUR, 80), IN_FOUR)}
# Compiling is most of what a case takes: the O(N) kernel and the lag are tried on some.
CASES = {
    "pf": {"lag": LAG},
    "mpf": {"lag": LAG, "method": "mcmc", "num_draws": 3},
    "four dimensions": {},
    "ps": {"method": "mcmc"},
    "dps": {},
}


def statistics(previous_states, states):
    """x_{t-1}, x_t², x_{t-1} x_t of the first coordinate."""
    earlier, later = (leaf.reshape(leaf.shape[0], -1)[:, 0] for leaf in (previous_states, states))
    return {"first": earlier, "rest": jnp.stack([later**2, earlier * later], axis=1)}


def as_rows(tree):
    return jnp.concatenate([tree["first"][..., None], tree["rest"]], axis=-1)


def smoothed(filter, observations, options):
    """The evidence up to each step as a ratio to its mean, and the estimates, of many runs."""

    @jax.jit
    @jax.vmap
    def one(key):
        found = smoothed_sums(key, filter, observations, statistics, missing="skip", **options)
        terms = None if found.terms is None else as_rows(found.terms)
        return found.run.log_likelihood_increments, as_rows(found.sums), terms

    increments, sums, terms = one(jax.random.split(jax.random.key(0), NUM_RUNS))
    log_evidence = np.cumsum(np.asarray(increments, float), axis=1)
    ratios = np.exp(log_evidence - log_evidence.max(axis=0))
    ratios /= ratios.mean(axis=0)
    assert ratios.std(axis=0).max() < 1.5  # or they would prove nothing
    return ratios, np.asarray(sums, float), None if terms is None else np.asarray(terms, float)


@cache
def found(name):
    return smoothed(*ALL[name], CASES[name])


def exact_terms(name, upto):
    """E[h(x_{r-1}, x_r) | y_1..y_upto] for r = 1, ..., upto."""
    filter, observations = ALL[name]
    model, observations = filter.model, observations[:upto]
    if isinstance(model, mpfjax.MultiObjectModel):
        model, observations = FILTERS["pf"][0].model, observations[:, 0]
    means, covariance = gaussian_smoother(model, observations)
    d = means.shape[1]
    x, covariance = means[:, 0], covariance[::d, ::d]
    squares = np.diagonal(covariance) + x**2
    pairs = np.diagonal(covariance, 1) + x[:-1] * x[1:]
    return np.stack([x[:-1], squares[1:], pairs], axis=1)


WITHOUT_LAG = [name for name in CASES if "lag" not in CASES[name]]


@pytest.mark.parametrize("name", quick_of(WITHOUT_LAG, WITHOUT_LAG[:1]))
def test_sums_are_the_exact_ones_at_every_step(name):
    ratios, sums, _ = found(name)
    for t in range(sums.shape[1]):
        assert_near(ratios[:, t], sums[:, t], exact_terms(name, t + 1).sum(axis=0))


@pytest.mark.parametrize("name", [name for name in CASES if "lag" in CASES[name]])
def test_terms_are_those_of_the_lag(name):
    """Each times the evidence of the step at which it is settled."""
    ratios, sums, terms = found(name)
    length = terms.shape[1]
    for r in range(length):
        settled = min(r + LAG, length - 1)
        assert_near(ratios[:, settled], terms[:, r], exact_terms(name, settled + 1)[r])
    np.testing.assert_allclose(terms.sum(axis=1), sums[:, -1], rtol=1e-3, atol=1e-3)


def test_two_modes_are_smoothed_as_on_the_grid():
    filter = mpfjax.mixture_particle_filter(QUADRATIC, 80, 2)
    ratios, sums, _ = smoothed(filter, SQUARES, {"lag": 100})
    points, pairs = grid_truth()
    expected = [
        (points @ GRID)[:-1].sum(),
        (points @ GRID**2)[1:].sum(),
        np.einsum("sij,i,j->", pairs, GRID, GRID),
    ]
    assert_near(ratios[:, -1], sums[:, -1], np.array(expected))


def test_the_filters_run_is_that_of_run_filter_and_a_long_lag_is_none():
    filter, _ = FILTERS["pf"]
    run = mpfjax.run_filter(jax.random.key(3), filter, SEEN, missing="skip")
    whole, lagged = (
        smoothed_sums(jax.random.key(3), filter, SEEN, statistics, lag=lag, missing="skip")
        for lag in (None, 50)
    )
    for sums in (whole, lagged):
        np.testing.assert_array_equal(sums.run.final.particles, run.final.particles)
        np.testing.assert_array_equal(
            sums.run.log_likelihood_increments, run.log_likelihood_increments
        )
    assert whole.terms is None
    np.testing.assert_allclose(as_rows(whole.sums), as_rows(lagged.sums), rtol=1e-4, atol=1e-5)
    total = np.asarray(as_rows(lagged.terms)).sum(axis=0)
    np.testing.assert_allclose(total, as_rows(whole.sums)[-1], rtol=1e-4, atol=1e-5)


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


def change(before, after):
    return after - before


@pytest.mark.parametrize("method", ["exact", "mcmc"])
def test_nothing_seen_and_zero_likelihood(method):
    filter = mpfjax.particle_filter(QUADRATIC, 20)
    for observations in ([np.nan] * 3, [1.0, 1e30, np.nan]):
        found = smoothed_sums(
            jax.random.key(1), filter, np.float32(observations), change, method=method,
            num_draws=1, missing="skip", lag=1,
        )  # fmt: skip
        for values in (found.sums, found.terms):
            assert values.shape == (3,)
            assert np.isfinite(values).all()
        assert found.run.degenerate.any() == (1e30 in observations)


def test_one_step():
    filter = mpfjax.particle_filter(QUADRATIC, 20)
    found = smoothed_sums(jax.random.key(1), filter, np.ones(1), change, lag=3)
    np.testing.assert_allclose(found.terms, found.sums)


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
            "function": statistics,
        }  # fmt: skip
        with pytest.raises(ValueError, match=named):
            smoothed_sums(**arguments | options)

    def test_an_error_of_the_function_says_where_it_is_from(self):
        with pytest.raises(KeyError) as error:
            smoothed_sums(
                jax.random.key(0), self.FILTER, SQUARES, lambda before, after: {}["missing"]
            )
        assert any("in function" in note for note in error.value.__notes__)
