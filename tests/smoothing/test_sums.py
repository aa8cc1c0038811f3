"""Smoothed sums online: their run, no lag and a long one, and functions."""

import jax
import numpy as np

import mpfjax
from mpfjax.smoothing import smoothed_sums
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
