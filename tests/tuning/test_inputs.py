"""The posterior of a control's coefficient, by each sampler, against Kalman's on a grid."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax.exact import kalman_filter
from mpfjax.tuning import metropolis_hastings, particle_gibbs, smc2
from tests.marking import thorough
from tests.test_inputs import INPUTS, OBSERVATIONS, Driven, in_matrices

FILTER = mpfjax.particle_filter(Driven(), 100)
PARAMETERS = {"gain": lambda filter: filter.model.gain}


def log_prior(parameters):
    return -0.5 * parameters["gain"] ** 2


def sample_prior(key):
    return {"gain": jax.random.normal(key)}


@cache
def truth():
    """The mean and the deviation of the coefficient given all observations."""
    grid = np.linspace(-4.0, 5.0, 300, dtype=np.float32)

    def log_density(gain):
        model, inputs = in_matrices(gain)
        run = kalman_filter(model, OBSERVATIONS[:, None], inputs=inputs)
        return run.log_marginal_likelihood + log_prior({"gain": gain})

    values = np.asarray(jax.vmap(log_density)(jnp.asarray(grid)), float)
    weights = np.exp(values - values.max())
    weights /= weights.sum()
    mean = weights @ grid
    return mean, np.sqrt(weights @ (grid - mean) ** 2)


def by_metropolis(key):
    run = metropolis_hastings(
        key, FILTER, OBSERVATIONS, 400, log_prior=log_prior, proposal_deviations=0.8,
        num_chains=4, burn_in=50, parameters=PARAMETERS, inputs=INPUTS, progress=False,
    )  # fmt: skip
    return np.ravel(run.parameters["gain"]), None


def by_gibbs(key):
    run = particle_gibbs(
        key, FILTER, OBSERVATIONS, 300, log_prior=log_prior, proposal_deviations=0.8,
        num_chains=4, burn_in=50, parameters=PARAMETERS, inputs=INPUTS, progress=False,
    )  # fmt: skip
    return np.ravel(run.parameters["gain"]), None


def by_smc2(key):
    run = smc2(
        key, FILTER, OBSERVATIONS, 120, log_prior=log_prior, sample_prior=sample_prior,
        parameters=PARAMETERS, inputs=INPUTS, progress=False,
    )  # fmt: skip
    return np.ravel(run.parameters["gain"]), np.asarray(run.weights)


@pytest.mark.parametrize("sample", thorough([by_metropolis, by_gibbs, by_smc2]))
def test_posterior_of_a_coefficient(sample):
    draws, weights = sample(jax.random.key(5))
    mean, deviation = truth()
    weights = np.full(len(draws), 1 / len(draws)) if weights is None else weights
    found = weights @ draws
    assert abs(found - mean) < 0.35 * deviation
    assert np.sqrt(weights @ (draws - found) ** 2) == pytest.approx(deviation, rel=0.35)
