"""Probabilities of pairs against sums over all assignments, and who gets whom."""

import itertools

import numpy as np
import pytest

from mpfjax.vision.tracking.associate import mahalanobis, marginals, one_to_one, probabilities
from mpfjax.vision.tracking.gaussian import Gaussian, overlapping
from mpfjax.vision.tracking.pairs import Pairs
from tests.assignments import enumerated


def possible(values):
    """The pairs of a matrix of costs, of which those that are infinite are none."""
    return Pairs.of(values, np.isfinite(values))


def matrix(pairs, none):
    values = np.full(pairs.shape, none)
    values[pairs.rows, pairs.columns] = pairs.values
    return values


def brute_force(log_odds):
    """The marginals, by summing over all assignments."""
    rows, columns = map(np.ones, log_odds.shape)
    return enumerated(np.exp(log_odds), rows, columns)[0]


@pytest.mark.parametrize(("loops", "bound"), [(False, 3e-3), (True, 0.15)])
def test_the_marginals_are_those_of_all_assignments(loops, bound):
    """Exact where the pairs form no loop, to what ends the messages, and else off by .03."""
    rng, gaps = np.random.default_rng(7), []
    for _ in range(20):
        log_odds = rng.normal(1, 2, (3, 4))
        if not loops:  # a chain: row 0 with columns 0 and 1, row 1 with 1 and 2, row 2 with 2 and 3
            log_odds[np.abs(np.arange(4)[None] - np.arange(3)[:, None] - 0.5) > 0.5] = -np.inf
        gaps.append(np.abs(marginals(log_odds) - brute_force(log_odds)))
    assert np.max(gaps) < bound
    assert np.mean(gaps) < bound / 5


def test_marginals_of_large_odds_are_those_of_all_assignments():
    """As detectors make them that err by half a hundredth of a box; larger ones do not overflow."""
    for log_odds in ([[12.0, 10.5], [11.5, 6.0]], [[12.0, 2.0], [3.0, -np.inf]], [[11.0], [8.0]]):
        expected = brute_force(np.array(log_odds))
        np.testing.assert_allclose(marginals(np.array(log_odds)), expected, atol=0.05)
    huge = np.array([[400.0, 350.0, -np.inf], [-900.0, 20.0, 19.0]])
    np.testing.assert_allclose(marginals(huge), [[1, 0, 0], [0, 0.73, 0.27]], atol=0.01)
    np.testing.assert_array_equal(marginals(np.full((2, 3), -np.inf)), np.zeros((2, 3)))


def test_lone_pairs_and_those_with_rivals_have_the_marginals_of_all():
    rng = np.random.default_rng(3)
    cost = rng.normal(-2, 5, (9, 8))
    cost[rng.uniform(0, 1, (9, 8)) > 0.2] = np.inf
    pairs = possible(cost)
    probability = matrix(pairs._replace(values=probabilities(pairs, 2.0)), 0.0)
    np.testing.assert_allclose(probability, marginals(-cost / 4), atol=1e-6)


def test_the_assignment_has_the_least_total_cost():
    """Against all assignments, where a row without a column costs nothing."""
    rng = np.random.default_rng(0)
    for _ in range(40):
        cost = rng.normal(-2, 5, (4, 5))
        cost[rng.uniform(0, 1, (4, 5)) > 0.7] = np.inf
        ways = itertools.product(range(-1, 5), repeat=4)
        apart = (way for way in ways if len({c for c in way if c >= 0}) == sum(c >= 0 for c in way))
        expected = min(sum(cost[r, c] for r, c in enumerate(way) if c >= 0) for way in apart)
        source = one_to_one(possible(cost))
        taken = source[source >= 0]
        assert len(set(taken)) == len(taken)
        assert cost[source >= 0, taken].sum() == pytest.approx(expected)
    tied = one_to_one(possible(np.full((3, 2), -0.5)))
    assert sorted(tied.tolist()) == [-1, 0, 1]
    assert one_to_one(possible(np.full((3, 2), np.inf))).tolist() == [-1, -1, -1]


def test_a_pairs_cost_is_students_density_in_boxes():
    """Against scipy's multivariate t distribution."""
    from scipy.stats import multivariate_t

    rng = np.random.default_rng(0)
    place = np.c_[rng.normal(100, 10, (2, 2)), rng.normal(3, 0.1, (2, 2))]
    variances, errors = rng.uniform(0.01, 0.02, (2, 4)), np.full(4, 0.05)
    moments = Gaussian(place, place * 0, variances, place, place)
    seen = place[:, None] + rng.normal(0, 0.5, (2, 3, 4))
    beside = rng.uniform(-3, 1, (2, 3))
    cost = matrix(mahalanobis(moments, errors, seen[0], beside), np.inf)
    for m in range(2):
        unit = np.array([*np.exp(place[m, 2:]), 1, 1])
        total = variances[m] / unit**2 + errors**2
        t = multivariate_t(np.zeros(4), np.diag(total), df=4)
        logs = np.array([t.logpdf((point - place[m]) / unit) for point in seen[0]])
        expected = -2 * (logs - t.logpdf(np.zeros(4))) + np.log(total).sum()
        np.testing.assert_allclose(cost[m], expected + beside[m], rtol=1e-9)


def test_pairs_that_are_left_out_by_x_or_y_alone_cost_more_than_none():
    rng = np.random.default_rng(0)
    place = np.c_[rng.uniform(0, 300, (40, 2)), rng.normal(3, 0.1, (40, 2))]
    moments = Gaussian(place, place, rng.uniform(0.01, 9, (40, 4)), place, place)
    beside = rng.uniform(-3, 1, (40, 40))
    errors, seen = np.full(4, 0.05), place + 0.2
    cost = matrix(mahalanobis(moments, errors, seen, beside), np.inf)
    # Where pairs cost so much less beside distance, none is left out.
    unlimited = matrix(mahalanobis(moments, errors, seen, beside - 4e3), np.inf) + 4e3
    near = np.isfinite(cost)
    assert 40 < near.sum() < 1300
    np.testing.assert_allclose(cost[near], unlimited[near], atol=1e-6)
    assert (unlimited[~near] >= 0).all()


def test_a_very_wide_prediction_still_forms_a_pair_with_what_lies_at_it():
    place = np.zeros((1, 4))
    wide = Gaussian(place, place, place + 1e4, place, place)
    assert mahalanobis(wide, np.zeros(4) + 0.1, place, np.zeros((1, 1))).values[0] < 0


def test_overlap_is_the_share_of_pixels():
    a, b = np.array([[10, 10, 8, 4], [30, 30, 2, 2]]), np.array([[12, 11, 8, 4]])
    grid = np.stack(np.meshgrid(np.arange(60), np.arange(60)), axis=-1) + 0.5
    inside = [(np.abs(grid - box[:2]) < box[2:] / 2).all(axis=-1) for box in (*a, *b)]
    expected = [[(one & inside[2]).sum() / (one | inside[2]).sum()] for one in inside[:2]]
    shares = matrix(overlapping(1.0 * a, 1.0 * b, 0.0), 0.0)
    np.testing.assert_allclose(shares, expected, rtol=1e-12)
