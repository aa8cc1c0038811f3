"""Propagation in stages against a grid; that chains of it are unbiased is in `test_chains.py`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax import PropagateTempered, Resample
from mpfjax.exact import grid_filter
from tests.examples import make_mixture
from tests.unbiased import assert_unbiased, ratios_to
from tests.user_models import BROKEN, TrickyQuadraticModel

SEEN = jnp.array([1.0, 1.4, 0.9])
GRID = jnp.linspace(-8.0, 8.0, 4001)


def in_stages(model, num_particles, **options):
    moves = [Resample(), PropagateTempered(**options)]
    return mpfjax.Filter(model, moves, num_particles)


def test_the_marginal_likelihood_is_unbiased():
    narrow = mpfjax.QuadraticModel(0.5, 0.02, -2.0, 2.0)
    exact = grid_filter(narrow, SEEN, 0.5 * GRID)
    filter = in_stages(narrow, 60, exponents=(1 / 256, 1 / 16, 1.0), num_moves=2)
    keys = jax.random.split(jax.random.key(0), 600)
    run = mpfjax.monte_carlo(keys, filter, SEEN, lambda mixture: None)
    assert_unbiased(ratios_to(exact, run), loosest=0.05)


@pytest.mark.weekly
def test_particles_between_the_stages_follow_the_tempered_target():
    """One step of many particles, with moves enough to forget where they were drawn."""
    model = mpfjax.QuadraticModel(1.0, 4.0, -1.0, 1.0)  # which the prior tells as much as y_1
    filter = in_stages(model, 20_000, exponents=(0.9, 1.0), num_moves=8, least_step=0.5)
    mixture, _ = filter.step(jax.random.key(2), filter.init(jax.random.key(1)), SEEN[0])
    probabilities = np.asarray(grid_filter(model, SEEN[:1], GRID).probabilities[0], float)
    values, weights = np.asarray(mixture.particles, float), np.asarray(mixture.weights, float)
    for power in (1, 2, 4):
        truth = probabilities @ np.asarray(GRID, float) ** power
        error = np.sqrt(np.sum(weights**2 * (values**power - truth) ** 2))
        assert abs(weights @ values**power - truth) <= 4 * error


@pytest.mark.exactness
def test_one_stage_is_the_plain_propagation_and_ancestors_are_those_of_the_step_before():
    """Without stages between there is nothing to resample or move: weights are L."""
    still = mpfjax.QuadraticModel(1e-6, 0.5, -2.0, 2.0)
    before = make_mixture(np.linspace(-2, 2, 40), np.zeros(40), np.zeros(40), 1)
    for exponents in ((1.0,), (0.1, 1.0)):
        filter = in_stages(still, 40, exponents=exponents)
        after, info = filter.step(jax.random.key(1), before, SEEN[0])
        parents = np.asarray(before.particles)[np.asarray(after.ancestor_indices)]
        np.testing.assert_allclose(after.particles, parents, atol=1e-4)
        if len(exponents) == 1:
            log_likelihoods = np.asarray(still.log_likelihood(SEEN[0], before.particles), float)
            expected = np.log(np.mean(np.exp(log_likelihoods)))
            np.testing.assert_allclose(info.log_likelihood_increment, expected, rtol=1e-4)


@pytest.mark.exactness
def test_a_density_that_is_nan_is_said_and_not_resampled_away():
    filter = in_stages(TrickyQuadraticModel(0.3, 0.5, -2.0, 2.0), 20)
    with pytest.raises(RuntimeError, match="NaN or infinite"):
        filter.step(jax.random.key(2), filter.init(jax.random.key(1)), jnp.float32(BROKEN))
