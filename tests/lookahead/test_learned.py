"""Learned look-aheads: exact whatever they are, and far less noisy than the filter they are of."""

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax.exact import grid_filter, kalman_filter, switching_filter
from mpfjax.smoothing import learn_lookahead
from tests.marking import quick_of
from tests.moves import test_marginalised_mixed as mixed
from tests.switching import MODEL as REGIMES
from tests.switching import OBSERVATIONS as SEEN
from tests.unbiased import assert_unbiased, ratios_to

GRID = jnp.linspace(-4.0, 4.0, 1601)
SQUARE = mpfjax.QuadraticModel(0.2, 0.2, -2.5, 2.5, initial_draw="independent")
LINE = mpfjax.LinearGaussianModel(
    A=[[1.0, 0.5], [0.0, 0.9]], Q=[[0.1, 0.02], [0.02, 0.1]], H=[[1.0, 0.0]], R=[[0.1]],
    m0=[0.0, 0.3], P0=[[1.0, 0.2], [0.2, 0.5]],
)  # fmt: skip
PATH = 1.3 + 0.2 * np.sin(np.arange(1.0, 9.0, dtype=np.float32))
NOISY = PATH + 0.2 * jax.random.normal(jax.random.key(7), (8,))
SQUARES = PATH**2 + (NOISY - PATH)
KEYS = jax.random.split(jax.random.key(2), 400)


def side(states):
    return (states > 0).astype(jnp.int32)


def in_groups(model):
    groups = [mpfjax.GroupBy(side)]
    moves = [mpfjax.Resample(), mpfjax.Propagate(), *groups]
    return mpfjax.Filter(model, moves, 60, 2, initial_moves=groups)


def pf(model):
    return mpfjax.particle_filter(model, 60)


def mpf(model):
    filter = mpfjax.mixture_particle_filter(model, 60, 2)
    resampled = mpfjax.with_resampling(filter, mpfjax.Resample(ess_threshold=0.5))
    return mpfjax.with_quasi_monte_carlo(resampled)


class Case(NamedTuple):
    """A filter of a model, the exact filter, and what is left of the deviation of log Ẑ."""

    model: Any
    make: Callable
    observations: jax.Array
    exact: Callable
    share: float


def on_a_grid(observations):
    return grid_filter(SQUARE, observations, GRID)


def kalman(observations):
    return kalman_filter(LINE, mpfjax.Series.skipping(observations))


def of_the_whole(observations):
    return kalman_filter(mixed.whole(True), mpfjax.Series.skipping(observations))


def of_regimes(observations):
    return switching_filter(REGIMES, mpfjax.Series.skipping(observations))


GAP, ROWS = mixed.OBSERVATIONS.at[2].set(jnp.nan), NOISY[:, None]
CASES = {
    "two modes": Case(SQUARE, in_groups, SQUARES, on_a_grid, 0.5),
    "linear": Case(LINE, pf, ROWS, kalman, 0.2),
    "linear, one missing": Case(LINE, pf, ROWS.at[3].set(jnp.nan), kalman, 0.5),
    "two modes, rqmc": Case(SQUARE, mpf, SQUARES, on_a_grid, 1.0),
    "mixed form": Case(mixed.Mixed(), pf, mixed.OBSERVATIONS, of_the_whole, 0.5),
    "mixed form, one missing": Case(mixed.Mixed(), pf, GAP, of_the_whole, 0.6),
    "regimes": Case(REGIMES, pf, SEEN, of_regimes, 1.0),
}


@cache
def learned(name, num_iterations=3):
    case = CASES[name]
    series = mpfjax.Series.skipping(case.observations)
    return learn_lookahead(jax.random.key(0), case.make(case.model), series, num_iterations)


def mean(mixture):
    state = mixture.mean()
    return jnp.ravel(state.mean if hasattr(state, "covariance") else state)


def log_errors(name, filter):
    """log Ẑ / Z and the means at every step, of a run for each key."""
    case = CASES[name]
    run = mpfjax.monte_carlo(KEYS, filter, mpfjax.Series.skipping(case.observations), mean)
    exact = case.exact(case.observations)
    gaps = np.asarray(run.log_likelihood_increments - exact.log_likelihood_increments[None])
    return np.cumsum(gaps, axis=1), np.asarray(run.collected)


@pytest.mark.parametrize("name", quick_of(CASES, [], one_in=7))
def test_evidence_and_means_are_unbiased_at_every_step_and_the_noise_is_less(name):
    """E[Ẑ/Z] = 1 and E[Ẑ/Z E[x]] = E[x | y] within four standard errors."""
    found, means = log_errors(name, learned(name))
    ratios, case = np.exp(found), CASES[name]
    exact = np.asarray(case.exact(case.observations).means)
    exact = exact.reshape(len(exact), -1)[:, -means.shape[2] :]
    for values, truth in ((ratios, np.ones(len(exact))), (ratios[..., None] * means, exact)):
        assert_unbiased(values, truth, slack=2e-3)
    plain, _ = log_errors(name, case.make(case.model))
    # Each deviation has a relative error of 1 / √(2 n).
    within = 1 + 4 / np.sqrt(len(KEYS))
    assert found[:, -1].std() < case.share * plain[:, -1].std() * within


@pytest.mark.exactness
def test_a_look_ahead_that_is_wrong_is_exact_all_the_same():
    """ψ of other observations: the weights undo it, however bad it is."""
    other = 0.8 * SQUARES[:4]
    keys = jax.random.split(jax.random.key(4), 2000)
    run = mpfjax.monte_carlo(keys, learned("two modes", 1), other, lambda mixture: None)
    assert_unbiased(ratios_to(on_a_grid(other), run))
