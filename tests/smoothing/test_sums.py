"""Smoothed sums online: their run, no lag and a long one, and functions."""

import jax
import numpy as np
import pytest

import mpfjax
from mpfjax.operations.random import split
from mpfjax.smoothing import FixedLagSmoother, smoothed_sums
from mpfjax.smoothing.sums import _advanced
from tests.smoothing.test_trajectories import QUADRATIC, SQUARES


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
    np.testing.assert_array_equal(found.run.final.particles, run.final.particles)


@pytest.mark.parametrize("method", ["exact", "mcmc"])
def test_one_step_at_a_time_is_the_whole_series(method):
    """From the same start by the same keys: the term at t - L, and at the end those left."""
    lag, key, terms = 2, jax.random.key(3), []
    filter = mpfjax.mixture_particle_filter(QUADRATIC, 50, 2)

    def function(before, after):
        return {"x": after, "up": before < after}

    whole = smoothed_sums(key, filter, SQUARES, function, lag=lag, method=method)
    smoother = FixedLagSmoother(filter, function, lag, method)
    window = smoother.init(whole.run.initial)
    keys = [jax.random.split(own, len(SQUARES)) for own in split(key, 3)[1:]]
    for step_key, draw_key, seen in zip(*keys, SQUARES, strict=True):
        moved, _ = filter.step(step_key, window.mixture, seen)
        window, estimates = _advanced(smoother, draw_key, window, moved, None)
        terms.append(estimates)
    np.testing.assert_array_equal(np.isnan(terms[0]["x"]), [True, True, False])
    for name, expected in whole.terms.items():
        found = [*(each[name][0] for each in terms[lag:]), *terms[-1][name][1:]]
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)
