"""Posteriors of one parameter on a grid, by filters that are exact, and the cases they are of."""

from functools import cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.stats import norm

import mpfjax
from mpfjax import Filter, KMeans, Merge, Propagate, Resample, Split
from mpfjax.exact import grid_filter
from tests.user_models import ScalarLinear

# The coefficient a of a linear model, with a missing observation.
OBSERVATIONS = jnp.array([1.5, 0.2, jnp.nan, 0.8, 1.9, 1.1, 0.3, -0.9])
MEAN_OF_A, DEVIATION_OF_A = 0.3, 0.5
A = {"a": lambda filter: filter.model.a}
# The noise σ of the quadratic model's observations.
SQUARES = jnp.array([1.2, 0.3, 0.8, 1.6, 1.0])
SIGMA = {"sigma_y": lambda filter: filter.model.sigma_y}
MEAN_OF_LOG_SIGMA, DEVIATION_OF_LOG_SIGMA = -0.5, 0.7


def log_prior_of_a(parameters):
    return norm.logpdf(parameters["a"], MEAN_OF_A, DEVIATION_OF_A)


def log_prior_of_sigma(parameters):
    log_sigma = jnp.log(parameters["sigma_y"])
    return norm.logpdf(log_sigma, MEAN_OF_LOG_SIGMA, DEVIATION_OF_LOG_SIGMA) - log_sigma


def eager_mixture(num_particles=10):
    """A filter of the quadratic model that merges, splits and regroups at every step."""
    model = mpfjax.QuadraticModel(0.4, 0.7, -2.0, 2.0)
    moves = [Resample(), Propagate(model), Merge(2.0), Split(1.0, 0.1, min_share=0.0), KMeans(2)]
    return Filter(model, moves, num_particles, 3, initial_moves=[KMeans(2, reseed=True)])


class Exact(NamedTuple):
    """Mean and variance of the posterior, and log p(y_1..y_t)."""

    mean: float
    variance: float
    log_evidence: float


def _summary(grid, log_densities):
    grid, log_densities = np.asarray(grid, float), np.asarray(log_densities, float)
    density = np.exp(log_densities - log_densities.max())
    total = density.sum()
    density /= total
    mean = density @ grid
    log_evidence = np.log(total * (grid[1] - grid[0])) + log_densities.max()
    return Exact(mean, density @ (grid - mean) ** 2, log_evidence)


@cache
def posterior_of_a():
    """By a scalar Kalman filter, in which a missing observation is none."""

    def log_density(a):
        model = ScalarLinear(a=a)
        mean, variance, total = model.m, model.p**2, log_prior_of_a({"a": a})
        for y in np.asarray(OBSERVATIONS):
            mean, variance = a * mean, a**2 * variance + model.q**2
            if np.isfinite(y):
                innovation = variance + model.r**2
                total += norm.logpdf(y, mean, jnp.sqrt(innovation))
                gain = variance / innovation
                mean, variance = mean + gain * (y - mean), (1 - gain) * variance
        return total

    grid = jnp.linspace(-1.7, 2.3, 201)
    return _summary(grid, jax.jit(jax.vmap(log_density))(grid))


@cache
def posterior_of_log_sigma():
    """By the grid filter."""
    states = jnp.linspace(-5.0, 5.0, 301)

    def log_density(log_sigma):
        model = mpfjax.QuadraticModel(0.4, jnp.exp(log_sigma), -2.0, 2.0)
        evidence = grid_filter(model, SQUARES, states).log_marginal_likelihood
        return evidence + norm.logpdf(log_sigma, MEAN_OF_LOG_SIGMA, DEVIATION_OF_LOG_SIGMA)

    grid = jnp.linspace(-3.5, 2.5, 61)
    return _summary(grid, jax.jit(jax.vmap(log_density))(grid))
