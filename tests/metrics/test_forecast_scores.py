"""Scores of forecasts against their definitions, and against a Gaussian's own."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax.metrics import crps, log_score
from tests import switching


def by_definition(values, weights, y):
    """E|Y - y| - E|Y - Y'| / 2, by all pairs."""
    weights = weights / weights.sum()
    pairs = np.abs(values[:, None] - values[None])
    return weights @ np.abs(values - y) - 0.5 * weights @ pairs @ weights


def test_crps_is_that_of_all_pairs():
    rng = np.random.default_rng(0)
    values = rng.normal(size=(3, 4, 9)).round(1)  # with ties
    weights = rng.random((3, 4, 9)) * (rng.random((3, 4, 9)) < 0.7) + 1e-3
    weights[0, :, :3] = 0.0
    values[0, :, 1] = np.nan  # an empty slot may hold anything
    y = rng.normal(size=(3, 4)).round(1)
    found = crps(*(jnp.asarray(array, jnp.float32) for array in (values, weights, y)))
    for row in np.ndindex(3, 4):
        seen = weights[row] > 0
        expected = by_definition(values[row][seen], weights[row][seen], y[row])
        assert float(found[row]) == pytest.approx(expected, abs=1e-5)


@pytest.mark.exactness
def test_in_the_log_score_of_a_conditionally_linear_model_x_is_integrated_out():
    """The sum over all sequences of regimes has -log p(y_4 | y_1..y_3)."""
    filter = mpfjax.particle_filter(switching.MODEL, 4000)
    run = mpfjax.run_filter(jax.random.key(0), filter, switching.OBSERVATIONS[:3])
    ahead = mpfjax.forecast(jax.random.key(1), filter, run.final, 1)
    mixture = jax.tree.map(lambda leaf: leaf[0], ahead.mixtures)
    score = log_score(switching.MODEL, mixture, switching.OBSERVATIONS[3])
    exact = -np.diff(switching.truth().log_evidence)[2]
    assert float(score) == pytest.approx(exact, abs=0.05)
