"""The quadratic model with its data, and its exact likelihood and score by the grid filter."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import mpfjax
from benchmarks.score_vs_particles import HIGH, LOW, simulate
from mpfjax.exact import grid_filter

GRID = (-3.0, 3.0, 1201)
COARSE_GRID = (-3.0, 3.0, 801)
# Drawn once: under double precision the same key would draw another set.
OBSERVATIONS = np.asarray(simulate(2)[1])


def build_quadratic(point: Array) -> mpfjax.QuadraticModel:
    """σ_x and σ_y from their logarithms."""
    return mpfjax.QuadraticModel(jnp.exp(point[0]), jnp.exp(point[1]), LOW, HIGH)


def exact_quadratic(grid: tuple[float, float, int]) -> Callable[[np.ndarray], tuple]:
    """log Z and its gradient by the grid filter, under the precision of the caller."""
    observations = jnp.asarray(OBSERVATIONS, float)
    points = jnp.linspace(*grid)

    def log_evidence(point: Array) -> Array:
        return grid_filter(build_quadratic(point), observations, points).log_marginal_likelihood

    both = jax.jit(jax.value_and_grad(log_evidence))
    return lambda point: tuple(np.asarray(v, float) for v in both(jnp.asarray(point, float)))
