"""Estimates of a batch of runs: the jackknife, by numpy."""

import jax
import numpy as np
import pytest

from mpfjax import QuadraticModel, mixture_particle_filter, monte_carlo
from mpfjax.smoothing.variance import batch_estimate


def above(mixture):
    return mixture.expectation(mixture.particles > 0)


@pytest.mark.weekly
def test_a_batch_is_the_jackknife_of_ratios():
    filter = mixture_particle_filter(QuadraticModel(initial_draw="independent"), 100, 2)
    keys = jax.random.split(jax.random.key(0), 8)
    runs = monte_carlo(keys, filter, np.float32([0.1, 0.2, 0.3]), lambda _: None)
    found = batch_estimate(runs, above)
    weights = np.exp(np.asarray(runs.log_marginal_likelihood, float))
    values = np.asarray(jax.vmap(above)(runs.final), float)
    np.testing.assert_allclose(found.value, np.average(values, weights=weights), rtol=1e-4)
    np.testing.assert_allclose(found.log_marginal_likelihood, np.log(weights.mean()), rtol=1e-4)
    without = [np.arange(8) != b for b in range(8)]
    for mine, parts in (
        (found.error, [np.average(values[kept], weights=weights[kept]) for kept in without]),
        (found.log_marginal_likelihood_error, [np.log(weights[kept].mean()) for kept in without]),
    ):
        np.testing.assert_allclose(mine, np.sqrt(7 * np.var(parts)), rtol=1e-3)
    np.testing.assert_allclose(
        found.effective_runs, weights.sum() ** 2 / np.sum(weights**2), rtol=1e-4
    )
