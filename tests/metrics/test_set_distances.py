"""OSPA and GOSPA against every pairing of small sets."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax.metrics import crps, gospa, log_score, ospa, track_switches
from tests import switching
from tests.marking import exactness

CUTOFF = 20.0
SIZES = list(itertools.product(range(5), range(5)))


def random_sets(seed, num_estimates, num_truths):
    """Close enough together that pairs lie on both sides of the cutoff, and pairings compete."""
    rng = np.random.default_rng(seed)
    return rng.uniform(0, 40, (num_estimates, 2)), rng.uniform(0, 40, (num_truths, 2))


def of_each(metric, pairs, **settings):
    """The metric of every pair of sets, each field as an array."""
    found = [metric(*sets, **settings) for sets in pairs]
    return type(found[0])(*np.array(found).T)


def every_pairing(estimates, truths, cutoff, order, cost_alone):
    """The least of sum min(d, c)^p + cost_alone * (number left over), over all pairings."""
    if len(estimates) > len(truths):
        estimates, truths = truths, estimates
    distance = np.linalg.norm(estimates[:, None] - truths[None], axis=-1)
    costs = np.minimum(distance, cutoff) ** order
    return cost_alone * (len(truths) - len(estimates)) + min(
        sum(costs[i, j] for i, j in enumerate(pairing))
        for pairing in itertools.permutations(range(len(truths)), len(estimates))
    )


@pytest.mark.parametrize("order", [3.5, *exactness([1.0, 2.0])])
def test_ospa_is_the_least_over_every_pairing(order):
    pairs = [random_sets(seed, *sizes) for sizes in SIZES for seed in range(3)]
    best = [every_pairing(*pair, CUTOFF, order, CUTOFF**order) for pair in pairs]
    sizes = [max(*map(len, pair), 1) for pair in pairs]
    found = of_each(ospa, pairs, cutoff=CUTOFF, exponent=order)
    np.testing.assert_allclose(found.distance, np.divide(best, sizes) ** (1 / order), rtol=2e-5)
    alone = [abs(len(x) - len(y)) * CUTOFF**order for x, y in pairs]
    np.testing.assert_allclose(found.cardinality, np.divide(alone, sizes), rtol=2e-5)
    localised = np.subtract(best, alone) / sizes
    np.testing.assert_allclose(found.localisation, localised, rtol=2e-4, atol=1e-6 * CUTOFF**order)


def test_gospa_is_the_least_over_every_pairing():
    pairs = [random_sets(seed, *sizes) for sizes in SIZES for seed in range(3)]
    best = [every_pairing(*pair, CUTOFF, 2.0, CUTOFF**2 / 2) for pair in pairs]
    found = of_each(gospa, pairs, cutoff=CUTOFF, exponent=2.0)
    np.testing.assert_allclose(found.distance, np.sqrt(best), rtol=2e-5)
    parts = found.localisation + found.missed + found.false
    np.testing.assert_allclose(parts, best, rtol=2e-5)


def test_what_is_left_over_is_missed_or_false():
    none, two = np.zeros((0, 2)), np.zeros((2, 2))
    assert gospa(none, none, cutoff=7.0) == (0, 0, 0, 0)
    missed = gospa(none, two, cutoff=7.0, exponent=2.0)
    np.testing.assert_allclose(missed, [7.0, 0, 49.0, 0], rtol=1e-6)
    false = gospa(two, none, cutoff=7.0, exponent=1.0)
    np.testing.assert_allclose(false, [7.0, 0, 0, 7.0], rtol=1e-6)


def test_switches_are_counted_where_an_object_has_another_label_than_before():
    """Two objects at 0 and 10: a swap is two, a gap none, a new label after a gap one."""
    nan = np.nan
    estimates = np.array([[0, 10], [0, 10], [0, nan], [0, 10], [0, 40]], float)[..., None]
    labels = np.array([[1, 2], [2, 1], [2, 1], [2, 3], [2, 9]])
    truths = np.tile(np.array([0.0, 10.0])[:, None], (5, 1, 1))
    assert track_switches(estimates, labels, truths, cutoff=5.0) == 3
    assert track_switches(estimates, labels, truths[:, :1], cutoff=5.0) == 1


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
