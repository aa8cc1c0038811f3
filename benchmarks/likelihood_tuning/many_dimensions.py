"""Filters on a linear-Gaussian model of 25 dimensions of which one is observed, as PyDPF has it.

Errors are those that PyDPF publishes: the squared distance of filter means from Kalman's, and
|1 - Ẑ_t / Z_t| of the increments of the likelihood, both averaged over time.
"""

from time import process_time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import mpfjax
from benchmarks import harness
from mpfjax.exact import kalman_filter

NUM_PARTICLES, LENGTH = 100, 200
PUBLISHED = [
    {"filter": "pydpf", "mean": 1.068, "likelihood": 0.0706},
    {"filter": "pydpf, optimal proposal", "mean": 0.393, "likelihood": 0.0180},
]


def model_of(dimensions: int) -> mpfjax.LinearGaussianModel:
    """x_t = A x_{t-1} + N(0, I), A_ij = .38^(|i - j| + 1), y_t = x_t1 + N(0, 1)."""
    index = np.arange(dimensions)
    transition = 0.38 ** (np.abs(index[:, None] - index[None]) + 1.0)
    one = jnp.eye(dimensions)
    return mpfjax.LinearGaussianModel(
        A=jnp.asarray(transition, jnp.float32), Q=one, H=one[:1], R=one[:1, :1],
        m0=jnp.zeros(dimensions), P0=one,
    )  # fmt: skip


def filters_of(model: mpfjax.LinearGaussianModel) -> dict[str, mpfjax.Filter]:
    """Bootstrap and guided, with independent draws and with point sets."""
    # Exact for a linear model; an inflation of 1.1 would double the error of Ẑ in 25 dimensions.
    optimal = mpfjax.GaussNewtonProposal(num_iterations=1, inflation=1.0)
    return {
        noise + name: mpfjax.particle_filter(model, NUM_PARTICLES, proposal=proposal, noise=noise)
        for noise in ("independent", "rqmc")
        for name, proposal in (("", None), (", optimal proposal", optimal))
    }


def errors(dimensions: int, runs: int, seed: int) -> tuple[str, str, list[dict[str, Any]]]:
    """Both errors of each filter, over data sets, with standard errors."""
    model = model_of(dimensions)
    rng = np.random.default_rng(seed)
    states, rows = rng.normal(size=(runs, dimensions)), []
    for _ in range(LENGTH):
        states = states @ np.asarray(model.A, float).T + rng.normal(size=states.shape)
        rows.append(states[:, :1] + rng.normal(size=(runs, 1)))
    observations = jnp.asarray(np.stack(rows, axis=1), jnp.float32)

    def exact(y: Array) -> tuple[Array, Array]:
        run = kalman_filter(model, y)
        return run.means, run.log_likelihood_increments

    means, increments = jax.jit(jax.vmap(exact))(observations)
    keys, entries = jax.random.split(jax.random.key(seed), runs), []
    for name, filter in filters_of(model).items():

        def estimated(key: Array, y: Array, filter: Any = filter) -> tuple[Array, Array]:
            run = mpfjax.run_filter(key, filter, y, lambda mixture: mixture.mean())
            return run.collected, run.log_likelihood_increments

        call = jax.jit(jax.vmap(estimated))
        jax.block_until_ready(call(keys, observations))
        start = process_time()
        estimates, logs = jax.block_until_ready(call(keys, observations))
        squares = np.asarray(jnp.sum((estimates - means) ** 2, axis=-1).mean(axis=1))
        ratios = np.asarray(jnp.abs(1 - jnp.exp(logs - increments)).mean(axis=1))
        entries.append({
            "filter": name, "mean": squares.mean(), "likelihood": ratios.mean(),
            "mean_error": squares.std() / runs**0.5, "likelihood_error": ratios.std() / runs**0.5,
            "milliseconds": 1000 * (process_time() - start) / runs,
        })  # fmt: skip
    columns = {
        "filter": "{filter}", "error of the mean": "{mean:.3f}", "of Ẑ": "{likelihood:.4f}",
        "CPU ms": "{milliseconds:.0f}",
    }  # fmt: skip
    title = f"{dimensions} dimensions, N = {NUM_PARTICLES}"
    return title, harness.table(columns, entries + PUBLISHED), entries
