"""Stochastic volatility with leverage: the return before is an input, against a filter in numpy."""

from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from jax.scipy.stats import norm

import mpfjax
from mpfjax.tuning import Interval, fit, metropolis_hastings, particle_gibbs, smc2
from tests.marking import thorough

LENGTH, NUM_PARTICLES, NUM_SEEDS = 100, 2000, 40
MU, PHI, SIGMA, RHO = -0.5, 0.95, 0.3, -0.7
START = SIGMA / np.sqrt(1 - PHI**2)  # the standard deviation of h_0


class Leverage(mpfjax.AbstractStateSpaceModel):
    """The model of docs/model.md, whose h_t is correlated with the return before."""

    rho: Any
    inputs: Any = None

    def sample_initial(self, key, num_particles):
        return MU + START * jax.random.normal(key, (num_particles,))

    def log_initial(self, states):
        return norm.logpdf(states, MU, START)

    def law(self, before):
        rho = self.rho * self.inputs["is_known"]
        shock = self.inputs["return"] * jnp.exp(-before / 2)
        return MU + PHI * (before - MU) + SIGMA * rho * shock, SIGMA * jnp.sqrt(1 - rho**2)

    def sample_transition(self, key, states):
        mean, deviation = self.law(states)
        return mean + deviation * jax.random.normal(key, states.shape)

    def log_transition(self, states, previous_states):
        return norm.logpdf(states, *self.law(previous_states))

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


def inputs_of(returns):
    """The return before, and whether there was one."""
    return {
        "return": np.concatenate([[0.0], returns[:-1]]),
        "is_known": np.concatenate([[0.0], np.ones(LENGTH - 1)]),
    }


@cache
def by_numpy(rho=RHO, num_seeds=NUM_SEEDS):
    """log Z of every seed, by a bootstrap filter in double precision."""
    returns = simulated()
    return np.array([bootstrap(returns, rho, seed) for seed in range(num_seeds)])


def bootstrap(returns, rho, seed):
    """log Z of one run, resampled at each step."""
    generator = np.random.default_rng(seed)
    h = MU + START * generator.normal(size=NUM_PARTICLES)
    total = 0.0
    for t, seen in enumerate(returns):
        noise = generator.normal(size=NUM_PARTICLES)
        if t > 0:
            shock = returns[t - 1] / np.exp(h / 2)
            noise = rho * shock + np.sqrt(1 - rho**2) * noise
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
    before = inputs_of(returns)
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


BOUNDS = (-0.99, 0.5)
RHO_BY_NAME: Any = {
    "parameters": {"rho": lambda filter: filter.model.rho},
    "transforms": {"rho": Interval(*BOUNDS)},
}


@cache
def by_grid():
    """Of rho given the returns: where the likelihood is highest, its posterior's mean, deviation.

    Under a uniform prior, by the filter in numpy. The posterior is a sum over the grid, in which
    the noise of its points averages out; at the top a cubic takes it out.
    """
    grid = np.linspace(*BOUNDS, 25)
    values = np.array([by_numpy(float(rho), 8) for rho in grid])
    log_z = np.log(np.exp(values - values.max()).mean(axis=1))
    weights = np.exp(log_z) / np.exp(log_z).sum()
    mean = weights @ grid
    near = np.abs(grid - grid[np.argmax(log_z)]) < 0.35
    fine = np.linspace(*grid[near][[0, -1]], 500)
    top = np.polynomial.Polynomial.fit(grid[near], log_z[near], 3)(fine)
    return fine[np.argmax(top)], mean, np.sqrt(weights @ (grid - mean) ** 2)


def uniform_prior(parameters):
    return 0.0 * parameters["rho"]


def by_fit(key, filter, options):
    runs = [
        fit(key, filter, optimizer=optax.adam(0.1), num_steps=30, num_seeds=16, **options)
        for key in jax.random.split(key, 3)
    ]
    return np.array([run.history["rho"][-10:].mean() for run in runs])


def by_chains(sample, num_steps):
    def of_each_chain(key, filter, options):
        run = sample(
            key, filter, num_steps=num_steps, log_prior=uniform_prior, burn_in=50, num_chains=8,
            proposal_deviations=0.5, **options,
        )  # fmt: skip
        return run.parameters["rho"].mean(axis=1)

    return of_each_chain


def by_smc2(key, filter, options):
    def sample_prior(key):
        return {"rho": jax.random.uniform(key, minval=BOUNDS[0], maxval=BOUNDS[1])}

    runs = [
        smc2(key, filter, num_samples=120, log_prior=uniform_prior, sample_prior=sample_prior,
             **options)
        for key in jax.random.split(key, 6)
    ]  # fmt: skip
    return np.array([run.mean("rho") for run in runs])


ESTIMATES = {
    "fit": by_fit,
    "metropolis_hastings": by_chains(metropolis_hastings, 100),
    "particle_gibbs": by_chains(particle_gibbs, 250),
    "smc2": by_smc2,
}


@pytest.mark.parametrize("name", thorough(ESTIMATES))
def test_all_that_is_tuned_agrees_on_leverage(name):
    """fit ends at the likelihood's maximum, the samplers have its mean: those of numpy's filter."""
    best, mean, deviation = by_grid()
    gradient = "stop" if name == "fit" else "none"
    filter = mpfjax.particle_filter(Leverage(jnp.array(-0.3)), 100, gradient=gradient)
    returns = simulated()
    series = mpfjax.Series(returns, inputs_of(returns))
    given = {"observations": series, "progress": False}
    found = ESTIMATES[name](jax.random.key(1), filter, RHO_BY_NAME | given)
    error = found.std(ddof=1) / np.sqrt(len(found))
    assert error < 0.2 * deviation
    assert abs(found.mean() - (best if name == "fit" else mean)) < 4 * error + 0.1 * deviation
