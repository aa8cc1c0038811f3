"""The contracts of every smoother in the registry, on every kind of filter."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from tests.marking import quick_of
from tests.registry import CHAINS
from tests.smoothing.exact_smoothers import gaussian_smoother, grid_smoother, grid_trajectories
from tests.smoothing.registry import CASES, INPUTS, MODELS, QUICK_CASES, SMOOTHERS, statistics_for

NUM_RUNS = 1000
GRID = np.linspace(-4.0, 4.0, 401)


@cache
def on_the_grid(length):
    """The smoothing distribution of the two modes after some of the observations."""
    model, observations = MODELS["two modes"]
    log_initial = np.asarray(model.log_initial(jnp.asarray(GRID, jnp.float32)), float)
    log_transition = -0.5 * ((GRID[None] - GRID[:, None]) / float(model.sigma_x)) ** 2
    noise = (observations[:length, None] - GRID[None] ** 2) / float(model.sigma_y)
    return grid_smoother(log_initial, log_transition, np.nan_to_num(-0.5 * noise**2))


@cache
def exact_terms(name, length):
    """The expected statistics of the steps 1, ..., length given the observations up to there."""
    model, observations = MODELS[name]
    if name == "two modes":
        smoothed, pairs = on_the_grid(length)
        means, squares = smoothed @ GRID, smoothed @ GRID**2
        products = np.einsum("sij,i,j->s", pairs, GRID, GRID)
        return np.stack([means[:-1], means[1:], squares[1:], products], axis=1)
    inputs = INPUTS[name][:length]
    means, covariance = gaussian_smoother(model, observations[:length], inputs)
    num, d = means.shape
    second = covariance.reshape(num, d, num, d) + np.einsum("si,tj->sitj", means, means)
    steps = range(1, num)
    rows = [
        np.concatenate([means[t - 1], means[t], *(second[s, :, t].ravel() for s in (t, t - 1))])
        for t in steps
    ]
    return np.array(rows)


@cache
def exact_trajectories(name):
    """Draws of x_0, ..., x_t given all observations."""
    model, observations = MODELS[name]
    rng = np.random.default_rng(0)
    if name == "two modes":
        return grid_trajectories(rng, NUM_RUNS, GRID, *on_the_grid(len(observations)))
    means, covariance = gaussian_smoother(model, observations, INPUTS[name])
    drawn = rng.multivariate_normal(means.ravel(), covariance, NUM_RUNS)
    return drawn.reshape(NUM_RUNS, *means.shape).astype(np.float32)


@cache
def estimates(program, chain, name):
    """log Ẑ after each step of many runs, and the rows of each smoother of the program."""
    (model, observations), inputs = MODELS[name], INPUTS[name]
    filter, observations = CHAINS[chain](model), jnp.asarray(observations)
    smoother = SMOOTHERS.get(program)

    def one(key, trajectory):
        key_run, *keys = jax.random.split(key, 1 + len(SMOOTHERS))
        if smoother is None:
            series = mpfjax.Series.skipping(observations, inputs)
            run = mpfjax.run_filter(key_run, filter, series)
            rows = {
                other: each.of_run(own_key, filter, run, inputs)
                for own_key, (other, each) in zip(keys, SMOOTHERS.items(), strict=True)
                if each.of_run
            }
            return run.log_likelihood_increments, rows
        if smoother.online:
            increments, rows = smoother.online(key_run, filter, observations, inputs)
        else:
            rows = smoother.kernel(key_run, filter, observations, trajectory, inputs)
            # What the given trajectory has itself is known: the change is known better.
            before, after = trajectory[:-1], trajectory[1:]
            rows -= jax.vmap(statistics_for(model))(before[:, None], after[:, None])[:, 0]
            increments = jnp.zeros(len(observations))
        return increments, {program: rows}

    trajectories = None
    if smoother and smoother.kernel:
        trajectories = jnp.asarray(exact_trajectories(name))
    keys = jax.random.split(jax.random.key(0), NUM_RUNS)
    increments, rows = jax.jit(jax.vmap(one))(keys, trajectories)
    return np.cumsum(np.asarray(increments, float), axis=1), jax.tree.map(np.asarray, rows)


def expected_rows(smoother, name, length):
    """What the rows of a smoother are estimates of, and the step whose Ẑ makes them unbiased."""
    last = np.arange(length)
    if smoother.summed:
        return np.array([exact_terms(name, s + 1).sum(axis=0) for s in last]), last
    lag = length if smoother.lag is None else smoother.lag
    settled = np.minimum(last + lag, length - 1)
    return np.array([exact_terms(name, s + 1)[r] for r, s in enumerate(settled)]), settled


@pytest.mark.exactness
@pytest.mark.parametrize(("name", "chain", "model"), quick_of(CASES, QUICK_CASES, one_in=40))
def test_means_covariances_and_pairs_are_the_exact_ones(name, chain, model):
    """Times Ẑ/Z every estimate is unbiased: within four standard errors."""
    smoother = SMOOTHERS[name]
    program = "of a run" if smoother.of_run else name
    log_evidence, rows = estimates(program, chain, model)
    ratios = np.exp(log_evidence - log_evidence.max(axis=0))
    ratios /= ratios.mean(axis=0)
    assert ratios.std(axis=0).max() < 1.5  # or they would prove nothing
    expected, settled = expected_rows(smoother, model, rows[name].shape[1])
    if smoother.kernel:
        expected = 0.0  # of the change
    errors = ratios[:, settled, None] * (rows[name] - expected)
    z = errors.mean(axis=0) / (errors.std(axis=0) / np.sqrt(NUM_RUNS))
    assert np.abs(z).max() < 4, z


# Nothing seen, a step of zero likelihood between others, and one step alone.
ODD = {"nothing seen": [np.nan] * 3, "zero likelihood": [1.0, 1e30, np.nan], "one step": [1.0]}
ONLINE = [name for name, smoother in SMOOTHERS.items() if smoother.online]


@pytest.mark.parametrize("odd", quick_of(ODD, ["zero likelihood"], one_in=2))
@pytest.mark.parametrize("name", quick_of(["of a run", *ONLINE], ["of a run"]))
def test_rows_are_finite(name, odd):
    model, _ = MODELS["two modes"]
    filter = mpfjax.particle_filter(model, 20)
    observations = np.float32(ODD[odd])
    if name == "of a run":
        run = mpfjax.run_filter(jax.random.key(1), filter, observations, missing="skip")
        key = jax.random.key(2)
        rows = [each.of_run(key, filter, run) for each in SMOOTHERS.values() if each.of_run]
        increments = run.log_likelihood_increments
    else:
        increments, rows = SMOOTHERS[name].online(jax.random.key(1), filter, observations)
        rows = [rows]
    for each in rows:
        assert each.shape == (len(observations), 4)
        assert np.isfinite(each).all()
    assert np.isinf(increments).any() == (1e30 in observations)


@pytest.mark.exactness
def test_statistics_are_those_that_are_expected():
    """Of trajectories drawn from the exact distribution, so that the truth is not of one kind."""
    for name, (model, observations) in MODELS.items():
        drawn, statistics = exact_trajectories(name), statistics_for(model)
        rows = np.stack(
            [statistics(drawn[:, t], drawn[:, t + 1]) for t in range(len(observations))], axis=1
        )
        errors = rows - exact_terms(name, len(observations))
        z = errors.mean(axis=0) / (errors.std(axis=0) / np.sqrt(NUM_RUNS))
        assert np.abs(z).max() < 4, z
