"""Estimates of a batch of runs: by numpy, and beside batches repeated."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mpfjax import QuadraticModel, mixture_particle_filter, monte_carlo, run_filter
from mpfjax.smoothing.variance import batch_estimate
from tests.marking import thorough

MODEL = QuadraticModel(initial_draw="independent")
OBSERVATIONS = jnp.asarray(
    (2 * np.sin(2 * np.pi * np.arange(1, 31) / 100)) ** 2
    + 0.1 * np.random.default_rng(0).normal(size=30),
    jnp.float32,
)


def above(mixture):
    return mixture.average(mixture.particles > 0)


def batches(num_batches, size=8, n=100, **options):
    """Runs of a default mixture, (batches, runs)."""
    filter = mixture_particle_filter(MODEL, n, 2, **options)
    keys = jax.random.split(jax.random.key(0), num_batches * size)
    runs = monte_carlo(keys, filter, OBSERVATIONS[: 3 if num_batches == 1 else 30], lambda _: None)
    return jax.tree.map(lambda leaf: leaf.reshape(num_batches, size, *leaf.shape[1:]), runs)


def test_a_batch_is_the_jackknife_of_ratios_by_numpy():
    runs = jax.tree.map(lambda leaf: leaf[0], batches(1))
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


@pytest.mark.parametrize("noise", thorough(["independent", "rqmc"]))
def test_the_errors_are_within_a_quarter_of_those_over_repeated_batches(noise):
    runs = batches(200, 16, noise=noise)
    found = jax.vmap(lambda each: batch_estimate(each, above))(runs)
    for values, errors in (
        (found.value, found.error),
        (found.log_marginal_likelihood, found.log_marginal_likelihood_error),
    ):
        reported = float(np.sqrt(np.mean(np.asarray(errors) ** 2)))
        assert reported == pytest.approx(float(np.std(values, ddof=1)), rel=0.25)


def test_what_is_no_batch_is_refused():
    filter = mixture_particle_filter(MODEL, 20, 2)
    alone = run_filter(jax.random.key(0), filter, OBSERVATIONS[:2])
    with pytest.raises(ValueError, match="runs: one run"):
        batch_estimate(alone, above)
    few = jax.tree.map(lambda leaf: jnp.stack([leaf] * 3), alone)
    with pytest.raises(ValueError, match="runs: 3"):
        batch_estimate(few, above)
