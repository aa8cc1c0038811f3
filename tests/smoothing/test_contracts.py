"""The contracts of every smoother in the registry, on every kind of filter."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from tests.marking import quick_of
from tests.registry import CHAINS
from tests.smoothing import registry
from tests.smoothing.registry import OBSERVATIONS, QUADRATIC, SMOOTHERS
from tests.unbiased import assert_unbiased

NUM_RUNS, LENGTH = 1000, len(OBSERVATIONS)
GRID = np.linspace(-4.0, 4.0, 401)


def grid_smoother(log_initial, log_transition, log_likelihoods):
    """P(x_s = grid point | y) for s = 0, ..., t, and of the pairs (x_{s-1}, x_s).

    `log_transition[i, j]` is log D(j | i); `log_likelihoods` is (t, g).
    """
    kernel = np.exp(log_transition)
    likelihoods = np.exp(log_likelihoods)
    forward = [np.exp(log_initial) / np.exp(log_initial).sum()]
    for likelihood in likelihoods:
        joint = (forward[-1] @ kernel) * likelihood
        forward.append(joint / joint.sum())
    backward = [np.ones(len(log_initial))]
    for likelihood in likelihoods[::-1]:
        message = kernel @ (likelihood * backward[-1])
        backward.append(message / message.sum())
    backward = backward[::-1]
    smoothed = [f * b / (f @ b) for f, b in zip(forward, backward, strict=True)]
    pairs = []
    for s, likelihood in enumerate(likelihoods):
        joint = forward[s][:, None] * kernel * (likelihood * backward[s + 1])[None]
        pairs.append(joint / joint.sum())
    return np.array(smoothed), np.array(pairs)


def grid_trajectories(rng, num, points, smoothed, pairs):
    """Trajectories (num, t + 1) drawn from what `grid_smoother` found."""
    indices = [rng.choice(len(points), num, p=smoothed[0])]
    for pair in pairs:
        upto = np.cumsum(pair[indices[-1]], axis=1)
        quantiles = rng.random(num) * upto[:, -1]
        indices.append((upto <= quantiles[:, None]).sum(axis=1))
    return points[np.stack(indices, axis=1)].astype(np.float32)


@cache
def on_the_grid(length):
    """The smoothing distribution after some of the observations."""
    log_initial = np.asarray(QUADRATIC.log_initial(jnp.asarray(GRID, jnp.float32)), float)
    log_transition = -0.5 * ((GRID[None] - GRID[:, None]) / float(QUADRATIC.sigma_x)) ** 2
    noise = (OBSERVATIONS[:length, None] - GRID[None] ** 2) / float(QUADRATIC.sigma_y)
    return grid_smoother(log_initial, log_transition, np.nan_to_num(-0.5 * noise**2))


@cache
def exact_terms(length):
    """The expected statistics of the steps 1, ..., length given the observations up to there."""
    smoothed, pairs = on_the_grid(length)
    means, squares = smoothed @ GRID, smoothed @ GRID**2
    products = np.einsum("sij,i,j->s", pairs, GRID, GRID)
    return np.stack([means[:-1], means[1:], squares[1:], products], axis=1)


@cache
def exact_trajectories():
    """Draws of x_0, ..., x_t given all observations."""
    return grid_trajectories(np.random.default_rng(0), NUM_RUNS, GRID, *on_the_grid(LENGTH))


@cache
def estimates(name, chain):
    """log Ẑ after each step of many runs, and the rows of a smoother."""
    filter, observations = CHAINS[chain](QUADRATIC), jnp.asarray(OBSERVATIONS)
    smoother = SMOOTHERS[name]

    def one(key, trajectory):
        increments, rows = smoother.rows(key, filter, observations, trajectory)
        if smoother.kernel:
            # What the given trajectory has itself is known: the change is known better.
            rows -= registry.statistics(trajectory[:-1], trajectory[1:])
        return increments, rows

    keys = jax.random.split(jax.random.key(0), NUM_RUNS)
    increments, rows = jax.jit(jax.vmap(one))(keys, jnp.asarray(exact_trajectories()))
    return np.cumsum(np.asarray(increments, float), axis=1), np.asarray(rows)


def expected_rows(smoother):
    """What the rows of a smoother are estimates of, and the step whose Ẑ makes them unbiased."""
    last = np.arange(LENGTH)
    if smoother.summed:
        return np.array([exact_terms(s + 1).sum(axis=0) for s in last]), last
    settled = np.minimum(last + (LENGTH if smoother.lag is None else smoother.lag), LENGTH - 1)
    return np.array([exact_terms(s + 1)[r] for r, s in enumerate(settled)]), settled


@pytest.mark.exactness
@pytest.mark.parametrize(
    ("name", "chain"), quick_of(registry.CASES, registry.QUICK_CASES, one_in=20)
)
def test_means_squares_and_pairs_are_the_exact_ones(name, chain):
    """Times Ẑ/Z every estimate is unbiased: within four standard errors."""
    smoother = SMOOTHERS[name]
    log_evidence, rows = estimates(name, chain)
    ratios = np.exp(log_evidence - log_evidence.max(axis=0))
    ratios /= ratios.mean(axis=0)
    assert ratios.std(axis=0).max() < 1.5  # or they would prove nothing
    expected, settled = expected_rows(smoother)
    if smoother.kernel:
        expected = 0.0  # of the change
    errors = ratios[:, settled, None] * (rows - expected)
    assert_unbiased(errors, 0.0)


# Nothing seen, a step of zero likelihood between others, and one step alone.
ODD = {"nothing seen": [np.nan] * 3, "zero likelihood": [1.0, 1e30, np.nan], "one step": [1.0]}
WITH_EVIDENCE = [name for name, smoother in SMOOTHERS.items() if not smoother.kernel]


@pytest.mark.parametrize("odd", quick_of(ODD, ["zero likelihood"], one_in=2))
@pytest.mark.parametrize("name", quick_of(WITH_EVIDENCE, WITH_EVIDENCE[:3]))
def test_rows_are_finite(name, odd):
    filter, observations = mpfjax.particle_filter(QUADRATIC, 20), np.float32(ODD[odd])
    increments, rows = SMOOTHERS[name].rows(jax.random.key(1), filter, observations)
    assert rows.shape == (len(observations), 4)
    assert np.isfinite(rows).all()
    assert np.isinf(increments).any() == (1e30 in observations)
