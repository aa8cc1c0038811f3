"""Restarts: exact for their kernel, found again after being carried away, and cheap elsewhere."""

import jax
import numpy as np
import pytest
import scipy.stats

import mpfjax
from tests.marking import quick_of
from tests.user_models import ScalarLinear

MODEL = ScalarLinear()
# The fourth and fifth are where only a restart gets to.
OBSERVATIONS = np.array([0.3, -0.9, -1.2, 1.5, 1.4, np.nan, 0.5], np.float32)
PROBABILITY = 0.1
SEEDS = 400


def log_evidence_on_a_grid():
    """log p(y_1..y_t) where x_{t-1} is drawn anew with probability p, by sums over a grid."""
    points = np.linspace(-8, 8, 1601)
    normal = scipy.stats.norm.pdf
    prior = normal(points, 0.5)
    prior /= prior.sum()
    step = normal(points[None], 0.9 * points[:, None], 0.6) * (points[1] - points[0])
    law, total = prior, 0.0
    for y in OBSERVATIONS:
        law = ((1 - PROBABILITY) * law + PROBABILITY * prior) @ step
        law = law if np.isnan(y) else law * normal(y, points, 0.5)
        total += np.log(law.sum())
        law = law / law.sum()
    return total


FILTERS = {
    "particle filter": mpfjax.particle_filter(MODEL, 60),
    "mixture": mpfjax.mixture_particle_filter(MODEL, 120, 3, regroup_every=2),
    "look-ahead": mpfjax.with_lookahead(mpfjax.particle_filter(MODEL, 60)),
    "nested": mpfjax.with_proposals_per_particle(mpfjax.particle_filter(MODEL, 60), 3),
}


@pytest.mark.parametrize("name", quick_of(FILTERS, ["mixture"]))
def test_evidence_is_unbiased_for_the_kernel(name):
    filter = mpfjax.with_restarts(FILTERS[name], PROBABILITY)
    keys = jax.random.split(jax.random.key(0), SEEDS)
    runs = mpfjax.monte_carlo(keys, filter, OBSERVATIONS, lambda mixture: None, missing="skip")
    ratios = np.exp(np.asarray(runs.log_marginal_likelihood) - log_evidence_on_a_grid())
    error = ratios.std() / np.sqrt(SEEDS)
    assert abs(ratios.mean() - 1) < 4 * error
    assert error < 0.06
