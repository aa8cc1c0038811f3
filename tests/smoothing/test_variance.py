"""Errors of log Ẑ and of masses: of one run, against many runs and its exact pairs; of a batch."""

from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax import Filter, KMeans, Propagate, Resample
from mpfjax.exact import kalman_filter
from mpfjax.smoothing.variance import (
    batch_estimate,
    log_marginal_likelihood_variance,
    mixture_weight_errors,
)
from tests.marking import quick_of, weekly
from tests.registry import RandomLabels

ONE = mpfjax.LinearGaussianModel(A=[[0.9]], Q=[[0.3]], H=[[1.0]], R=[[0.4]], m0=[0.5], P0=[[1.0]])
OBJECTS = mpfjax.MultiObjectModel(ONE, 2)
SQUARE = mpfjax.QuadraticModel(0.3, 0.4, -2.0, 2.0, initial_draw="independent")
SEEN = np.array([[0.8], [0.3], [0.1], [-0.4], [0.9]], np.float32)


def nothing(mixture):
    return None


DRAWS = {"scheme": "multinomial"}


RANDOM_LABELS = RandomLabels()


def labelled(model, n, ess_threshold=1.0, regrouping=RANDOM_LABELS, m=3):
    """Components, of random members if nothing else, which are resampled apart."""
    moves = [Resample("multinomial", ess_threshold=ess_threshold), Propagate(), regrouping]
    return Filter(model, moves, n, m, initial_moves=[KMeans(3, reseed=True)])


SMALL = {
    "pf": (mpfjax.particle_filter(ONE, 30, **DRAWS), SEEN),
    "kmeans, adaptive": (labelled(ONE, 30, 0.5, KMeans()), SEEN),
    "dps": (
        mpfjax.map_moves(
            mpfjax.distributed_partitioned_sampling(OBJECTS, 30, reassembly="evidence"),
            lambda move: replace(move, **DRAWS) if isinstance(move, Resample) else move,
        ),
        np.stack([SEEN, -SEEN], axis=1),
    ),
}


def many(filter, observations, num_runs):
    """Many runs, log Ẑ and its variance from each."""
    keys = jax.random.split(jax.random.key(0), num_runs)
    filter = mpfjax.with_eve_indices(filter)
    runs = mpfjax.monte_carlo(keys, filter, observations, nothing)
    variances = jax.vmap(log_marginal_likelihood_variance)(runs)
    return runs, np.asarray(runs.log_marginal_likelihood, float), np.asarray(variances, float)


@cache
def exact_evidence(num_objects):
    runs = [kalman_filter(ONE, jnp.asarray(sign * SEEN)) for sign in (1, -1)[:num_objects]]
    return sum(float(run.log_marginal_likelihood) for run in runs)


@pytest.mark.parametrize("name", quick_of(SMALL, ["pf"], one_in=2))
def test_the_second_moment_is_unbiased(name):
    """E[Ẑ² (1 - V)] = Z², also where N is so small that Ẑ is far from normal."""
    filter, observations = SMALL[name]
    _, log_evidence, variances = many(filter, observations, 3000)
    ratios = np.exp(log_evidence - exact_evidence(getattr(filter.model, "num_objects", 1)))
    relative = np.sqrt(1 + 2 * variances) - 1  # what is returned is V + V² / 2
    estimates = ratios**2 * (1 - relative)
    standard_error = estimates.std() / np.sqrt(len(estimates))
    # Loose estimates would prove nothing: without the factors of the pairs it is off by more.
    assert standard_error < 0.05
    assert abs(estimates.mean() - 1) < 4 * standard_error


SQUARES = np.array([1.2, 0.8, 1.5, 1.0, 0.6, 0.9, 1.1, 1.3], np.float32)


def exact_pairs(run):
    """Both estimates with the factor of each pair, of a chain that starts with `Resample`."""
    before = [run.initial.component_indicators, *run.collected.component_indicators]
    ancestors, resampled = np.asarray(run.collected.ancestor_indices), np.asarray(run.resampled)
    n = len(before[0])
    factors, first = np.full((n, n), n / (n - 1)), np.arange(n)
    for t, parents in enumerate(ancestors):
        labels = np.asarray(before[t])[parents]
        k = np.bincount(labels, minlength=resampled.shape[1])
        grown = np.where((k > 1) & resampled[t], k / np.maximum(k - 1, 1), 1)
        same = labels[:, None] == labels
        factors = factors[np.ix_(parents, parents)] * np.where(same, grown[labels], 1)
        first = first[parents]
    weights = np.asarray(run.final.weights, float)
    counted = factors * (first[:, None] != first)
    labels = np.asarray(run.final.component_indicators)
    excess = [weights * ((labels == m) - weights[labels == m].sum()) for m in range(3)]
    masses = [max(-u @ counted @ u, 0) ** 0.5 for u in excess]
    relative = 1 - weights @ counted @ weights
    return relative + relative**2 / 2, np.array(masses)


@pytest.mark.exactness
@pytest.mark.parametrize("num_components", [1, *weekly([3])])
def test_averages_of_pairs_are_close_to_the_pairs_themselves(num_components):
    """And the report of a step has both errors; nothing else is changed."""
    filter = mpfjax.particle_filter(SQUARE, 80, **DRAWS)
    if num_components > 1:
        filter = labelled(SQUARE, 80, regrouping=KMeans())
    keys, own = jax.random.split(jax.random.key(5), 40), mpfjax.with_eve_indices(filter)
    runs = mpfjax.monte_carlo(keys, own, SQUARES)
    variances = jax.vmap(log_marginal_likelihood_variance)(runs)
    errors = np.asarray(jax.vmap(mixture_weight_errors)(runs))
    pairs = [exact_pairs(jax.tree.map(lambda leaf, b=b: leaf[b], runs)) for b in range(40)]
    exact, exact_errors = (np.array(each) for each in zip(*pairs, strict=True))
    if num_components == 1:
        np.testing.assert_allclose(variances, exact, atol=1e-5)
        np.testing.assert_allclose(errors, 0.0, atol=1e-4)
    else:
        for ours, theirs in ((variances, exact), (np.ravel(errors), np.ravel(exact_errors))):
            assert ours.mean() == pytest.approx(theirs.mean(), rel=0.05)
            assert np.corrcoef(ours, theirs)[0, 1] > 0.97
    plain = mpfjax.monte_carlo(keys, filter, SQUARES, nothing)
    np.testing.assert_array_equal(plain.final.particles, runs.final.particles)
    assert len(mpfjax.with_eve_indices(own).initial_moves) == len(filter.initial_moves) + 1
    last = jax.tree.map(lambda leaf: leaf[0], runs.final)
    moved, info = own.step(keys[0], last, SQUARES[0])
    np.testing.assert_allclose(info.mixture_weight_errors, mixture_weight_errors(moved), atol=1e-5)
    variance = float(log_marginal_likelihood_variance(moved))
    assert float(info.log_marginal_likelihood_error) ** 2 == pytest.approx(variance, rel=1e-3)


@pytest.mark.exactness
def test_one_step_and_zero_likelihood():
    filter = mpfjax.with_eve_indices(mpfjax.particle_filter(SQUARE, 40, **DRAWS))
    one = mpfjax.run_filter(jax.random.key(1), filter, SQUARES[:1])
    assert np.isfinite(log_marginal_likelihood_variance(one))
    lost = mpfjax.run_filter(jax.random.key(1), filter, np.float32([1.0, 1e30, 1.0]))
    assert lost.degenerate.any()
    assert float(log_marginal_likelihood_variance(lost)) == np.inf


@pytest.mark.weekly
def test_a_batch_is_the_jackknife_of_ratios():
    def above(mixture):
        return mixture.expectation(mixture.particles > 0)

    filter = mpfjax.mixture_particle_filter(SQUARE, 100, 2)
    keys = jax.random.split(jax.random.key(0), 8)
    runs = mpfjax.monte_carlo(keys, filter, np.float32([0.1, 0.2, 0.3]), nothing)
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
