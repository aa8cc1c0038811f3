"""Smoothed sums online: their run, no lag and a long one, and functions."""

import jax
import numpy as np
import pytest

import mpfjax
from mpfjax.smoothing import FixedLagSmoother
from tests.marking import weekly
from tests.smoothing.test_trajectories import QUADRATIC, SQUARES


def test_no_lag_is_filtering_and_counts_are_averaged():
    filter = mpfjax.particle_filter(QUADRATIC, 50, ess_threshold=0.5)
    smoother = FixedLagSmoother(filter, lambda before, after: after > 1, 0)
    window = smoother.init(filter.init(jax.random.key(4)))
    for key, seen in zip(jax.random.split(jax.random.key(5), 4), SQUARES, strict=True):
        window, (found,), _ = smoother.step(key, window, seen)
        moved = window.mixture
        np.testing.assert_allclose(found, moved.expectation(moved.particles > 1), rtol=1e-5)


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

    def moments(model, place):
        """The terms at the end, and their variances."""
        filter = mpfjax.particle_filter(model, 300)
        smoother = FixedLagSmoother(filter, lambda x, y: {"x": y, "xx": y**2}, 11, method)
        window = smoother.init(filter.init(jax.random.key(0)))
        for key, y in zip(jax.random.split(jax.random.key(1), 12), seen + place, strict=True):
            window, terms, _ = smoother.step(key, window, y)
        return terms, smoother.variances(window)["x"]

    (terms, at_zero), (_, away) = moments(near, 0.0), moments(far, 20.0)
    np.testing.assert_allclose(at_zero, terms["xx"] - terms["x"] ** 2, rtol=1e-3)
    exact = mpfjax.exact.kalman_smoother(near, seen).covariances[-12:, 0]
    np.testing.assert_allclose(away, exact, rtol=0.35)
    np.testing.assert_allclose(np.mean(away / exact), 1, atol=0.1)
