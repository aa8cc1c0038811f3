"""Smoothed sums online: their run, no lag and a long one, and functions."""

import jax
import numpy as np
import pytest

import mpfjax
from mpfjax.operations.random import split
from mpfjax.smoothing import FixedLagSmoother, smoothed_sums
from mpfjax.smoothing.sums import _advance
from tests.marking import weekly
from tests.smoothing.test_trajectories import QUADRATIC, SQUARES


def test_no_lag_is_filtering_and_counts_are_averaged():
    filter = mpfjax.particle_filter(QUADRATIC, 50, ess_threshold=0.5)
    run = mpfjax.run_filter(
        jax.random.key(4),
        filter,
        SQUARES,
        lambda mixture: mixture.expectation(mixture.particles > 1),
    )
    found = smoothed_sums(
        jax.random.key(4), filter, SQUARES, lambda before, after: after > 1, lag=0
    )
    np.testing.assert_allclose(found.terms, run.collected, rtol=1e-5)
    np.testing.assert_allclose(found.sums, np.cumsum(run.collected), rtol=1e-5)
    np.testing.assert_array_equal(found.run.final.particles, run.final.particles)


@pytest.mark.exactness
@pytest.mark.parametrize("method", ["exact", *weekly(["mcmc"])])
def test_one_step_at_a_time_is_the_whole_series(method):
    """From the same start by the same keys: the term at t - L, and at the end those left."""
    lag, key, terms, spreads = 2, jax.random.key(3), [], []
    filter = mpfjax.mixture_particle_filter(QUADRATIC, 50, 2)

    def function(before, after):
        return {"x": after, "up": before < after}

    whole = smoothed_sums(key, filter, SQUARES, function, lag=lag, method=method)
    smoother = FixedLagSmoother(filter, function, lag, method)
    window = smoother.init(whole.run.initial)
    keys = [jax.random.split(own, len(SQUARES)) for own in split(key, 3)[1:]]
    for step_key, draw_key, seen in zip(*keys, SQUARES, strict=True):
        moved, _ = filter.step(step_key, window.mixture, seen)
        window, estimates = _advance(smoother, draw_key, window, moved, None)
        terms.append(estimates)
        spreads.append(smoother.variances(window))
    np.testing.assert_array_equal(np.isnan(terms[0]["x"]), [True, True, False])
    np.testing.assert_array_equal(np.isnan(spreads[0]["x"]), [True, True, False])
    for each_step, of_all in ((terms, whole.terms), (spreads, whole.variances)):
        for name, expected in of_all.items():
            found = [*(each[name][0] for each in each_step[lag:]), *each_step[-1][name][1:]]
            np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)
    # An event has the variance p (1 - p).
    chances = whole.terms["up"]
    np.testing.assert_allclose(whole.variances["up"], chances * (1 - chances), atol=1e-5)


@pytest.mark.exactness
@pytest.mark.parametrize("method", ["exact", *weekly(["mcmc"])])
def test_variances_are_about_the_mean_however_far_from_zero(method):
    """As those of a Kalman smoother, where E[x²] - E[x]² is rounding alone."""
    noise = np.random.default_rng(0).normal(size=(2, 12))
    walk = np.cumsum(0.02 * noise[0])[:, None]
    near, far = (
        mpfjax.LinearGaussianModel([[1.0]], [[4e-4]], [[1.0]], [[9e-4]], [place], [[9e-4]])
        for place in (0.0, 20.0)
    )
    seen = (walk + 0.03 * noise[1][:, None]).astype(np.float32)
    found = [
        smoothed_sums(
            jax.random.key(0), mpfjax.particle_filter(model, 300), seen + place,
            lambda before, after: {"x": after, "xx": after**2}, lag=12, method=method,
        )
        for model, place in ((near, 0.0), (far, 20.0))
    ]  # fmt: skip
    at_zero, away = (each.variances["x"] for each in found)
    recipe = found[0].terms["xx"] - found[0].terms["x"] ** 2
    np.testing.assert_allclose(at_zero, recipe, rtol=1e-3)
    exact = mpfjax.exact.kalman_smoother(near, seen).covariances[-12:, 0]
    np.testing.assert_allclose(away, exact, rtol=0.35)
    np.testing.assert_allclose(np.mean(away / exact), 1, atol=0.1)
