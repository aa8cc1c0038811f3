"""A control's coefficient, by `fit` and by each sampler, against the Kalman filter's likelihood."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import mpfjax
from mpfjax.exact import kalman_filter
from mpfjax.tuning import (
    fit,
    log_density,
    metropolis_hastings,
    particle_gibbs,
    smc2,
    standard_errors,
)
from tests.marking import thorough
from tests.test_inputs import INPUTS, OBSERVATIONS, TRACED, Driven, in_matrices

FILTER = mpfjax.particle_filter(Driven(), 100)
SERIES = mpfjax.Series(OBSERVATIONS, INPUTS)
PARAMETERS = {"gain": lambda filter: filter.model.gain}


def log_prior(parameters):
    return -0.5 * parameters["gain"] ** 2


def sample_prior(key):
    return {"gain": jax.random.normal(key)}


def log_evidence(gain):
    """log p(y_1..y_t), exactly."""
    model, inputs = in_matrices(gain)
    run = kalman_filter(model, mpfjax.Series(OBSERVATIONS[:, None], inputs))
    return run.log_marginal_likelihood


@cache
def truth():
    """The mean and the deviation of the coefficient given all observations."""
    grid = np.linspace(-4.0, 5.0, 300, dtype=np.float32)

    def log_posterior(gain):
        return log_evidence(gain) + log_prior({"gain": gain})

    values = np.asarray(jax.vmap(log_posterior)(jnp.asarray(grid)), float)
    weights = np.exp(values - values.max())
    weights /= weights.sum()
    mean = weights @ grid
    return mean, np.sqrt(weights @ (grid - mean) ** 2)


def by_metropolis(key):
    run = metropolis_hastings(
        key, FILTER, SERIES, 400, log_prior=log_prior, proposal_deviations=0.8,
        num_chains=4, burn_in=50, parameters=PARAMETERS, progress=False,
    )  # fmt: skip
    return np.ravel(run.parameters["gain"]), None


def by_gibbs(key):
    run = particle_gibbs(
        key, FILTER, SERIES, 300, log_prior=log_prior, proposal_deviations=0.8,
        num_chains=4, burn_in=50, parameters=PARAMETERS, progress=False,
    )  # fmt: skip
    return np.ravel(run.parameters["gain"]), None


def by_smc2(key):
    run = smc2(
        key, FILTER, SERIES, 120, log_prior=log_prior, sample_prior=sample_prior,
        parameters=PARAMETERS, progress=False,
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


@pytest.mark.thorough
def test_fit_ends_where_the_likelihood_is_highest():
    """log Z is a parabola in the coefficient, so that two derivatives tell where and how wide."""
    slope, curvature = jax.grad(log_evidence)(0.0), jax.hessian(log_evidence)(0.0)
    filter = mpfjax.particle_filter(Driven(), 200, gradient="stop")
    key, given = jax.random.key(0), {"parameters": PARAMETERS}
    run = fit(key, filter, SERIES, optax.adam(0.1), 60, num_seeds=32, progress=False, **given)
    late = run.history["gain"][-20:]
    assert late.mean() == pytest.approx(float(-slope / curvature), abs=0.1)
    found = standard_errors(key, run.filter, SERIES, num_seeds=256, **given)
    assert found["gain"] == pytest.approx(float(-curvature) ** -0.5, rel=0.15)


@pytest.mark.thorough
def test_the_score_of_the_posterior():
    """The gradient that other libraries' samplers take, over seeds, beside the exact one."""
    filter = mpfjax.particle_filter(Driven(), 200, gradient="stop")
    given = {"log_prior": log_prior, "parameters": PARAMETERS}
    density = log_density(filter, SERIES, **given)
    keys = jax.random.split(jax.random.key(2), 200)
    score = jax.jit(jax.vmap(jax.grad(density), (None, 0)))
    for gain in (0.0, 1.2):
        found = np.asarray(score({"gain": jnp.array(gain)}, keys)["gain"])
        error = found.std() / np.sqrt(len(found))
        assert 0 < error < 0.2
        assert abs(found.mean() - (jax.grad(log_evidence)(gain) - gain)) < 4 * error + 0.02


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["fit", "metropolis_hastings", "particle_gibbs", "smc2"])
def test_other_inputs_compile_nothing_again(name):
    filter = mpfjax.particle_filter(Driven(), 10, gradient="stop" if name == "fit" else "none")
    key, given = jax.random.key(0), {"parameters": PARAMETERS, "progress": False}
    by_name = {
        "fit": lambda series: fit(
            key, filter, series, optax.sgd(0.1), 2, **given
        ),
        "metropolis_hastings": lambda series: metropolis_hastings(
            key, filter, series, 2, log_prior=log_prior, **given
        ),
        "particle_gibbs": lambda series: particle_gibbs(
            key, filter, series, 2, log_prior=log_prior, **given
        ),
        "smc2": lambda series: smc2(
            key, filter, series, 12, log_prior=log_prior, sample_prior=sample_prior, **given,
        ),
    }  # fmt: skip
    by_name[name](SERIES)
    before = len(TRACED)
    other = jax.tree.map(lambda leaf: 0.5 * leaf, INPUTS)
    by_name[name](mpfjax.Series(OBSERVATIONS, other))
    assert len(TRACED) == before > 0
