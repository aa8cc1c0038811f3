"""Stochastic volatility with leverage: the return before is an input, against a filter in numpy."""

from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.scipy.stats import norm

import mpfjax
from tests.marking import thorough

LENGTH, NUM_PARTICLES, NUM_SEEDS = 100, 2000, 40
MU, PHI, SIGMA, RHO = -0.5, 0.95, 0.3, -0.7


class Leverage(mpfjax.AbstractStateSpaceModel):
    """The model of docs/model.md, whose h_t is correlated with the return before."""

    rho: float
    inputs: Any = None

    def sample_initial(self, key, num_particles):
        spread = SIGMA / np.sqrt(1 - PHI**2)
        return MU + spread * jax.random.normal(key, (num_particles,))

    def sample_transition(self, key, states):
        rho = self.rho * self.inputs["is_known"]
        shock = self.inputs["return"] * jnp.exp(-states / 2)
        noise = jax.random.normal(key, states.shape)
        return MU + PHI * (states - MU) + SIGMA * (rho * shock + jnp.sqrt(1 - rho**2) * noise)

    def log_likelihood(self, observation, states):
        return norm.logpdf(observation, 0.0, jnp.exp(states / 2))


def simulated():
    """Returns of the model, by numpy."""
    generator = np.random.default_rng(4)
    h, returns = MU, []
    for _ in range(LENGTH):
        shock, other = generator.normal(size=2)
        returns.append(np.exp(h / 2) * shock)
        h = MU + PHI * (h - MU) + SIGMA * (RHO * shock + np.sqrt(1 - RHO**2) * other)
    return np.array(returns)


@cache
def by_numpy():
    """log Z of every seed, by a bootstrap filter in double precision."""
    returns = simulated()
    return np.array([bootstrap(returns, seed) for seed in range(NUM_SEEDS)])


def bootstrap(returns, seed):
    """log Z of one run, resampled at each step."""
    generator = np.random.default_rng(seed)
    h = MU + SIGMA / np.sqrt(1 - PHI**2) * generator.normal(size=NUM_PARTICLES)
    total = 0.0
    for t, seen in enumerate(returns):
        noise = generator.normal(size=NUM_PARTICLES)
        if t > 0:
            shock = returns[t - 1] / np.exp(h / 2)
            noise = RHO * shock + np.sqrt(1 - RHO**2) * noise
        h = MU + PHI * (h - MU) + SIGMA * noise
        weights = np.exp(-0.5 * seen**2 * np.exp(-h) - 0.5 * h) / np.sqrt(2 * np.pi)
        total += np.log(weights.mean())
        h = generator.choice(h, NUM_PARTICLES, p=weights / weights.sum())
    return total


def nothing(mixture):
    return None


@pytest.mark.parametrize("name", thorough(["pf", "mpf"]))
def test_evidence_is_that_of_a_filter_in_numpy(name):
    """log Z, averaged over seeds, within .1; without leverage it is far from it."""
    returns = simulated()
    expected = by_numpy()
    before = {
        "return": np.concatenate([[0.0], returns[:-1]]),
        "is_known": np.concatenate([[0.0], np.ones(LENGTH - 1)]),
    }
    keys = jax.random.split(jax.random.key(0), NUM_SEEDS)

    def found(rho):
        model = Leverage(rho)
        if name == "pf":
            filter = mpfjax.particle_filter(model, NUM_PARTICLES)
        else:
            filter = mpfjax.mixture_particle_filter(model, NUM_PARTICLES, 2)
        run = mpfjax.monte_carlo(keys, filter, returns, nothing, inputs=before)
        return np.asarray(run.log_marginal_likelihood, float)

    ours = found(RHO)
    errors = [np.std(values) / np.sqrt(NUM_SEEDS) for values in (expected, ours)]
    assert np.hypot(*errors) < 0.03
    assert abs(ours.mean() - expected.mean()) < 0.1
    assert abs(found(0.0).mean() - expected.mean()) > 0.5
