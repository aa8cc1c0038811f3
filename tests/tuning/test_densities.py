"""The log density that other libraries' samplers take."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.scipy.stats import norm

import mpfjax
from mpfjax.tuning import Positive, log_density
from tests.user_models import ScalarLinear

OBSERVATIONS = jnp.array([1.5, 0.2, -0.4, 0.8])
R = {"r": lambda filter: filter.model.r}


def log_prior(parameters):
    return jnp.where(parameters["r"] < 3, norm.logpdf(parameters["r"], 1.0, 0.5), -jnp.inf)


class Fragile(ScalarLinear):
    """A likelihood that breaks where r is above 2, and is 1 elsewhere."""

    def log_likelihood(self, observation, states):
        return jnp.broadcast_to(jnp.where(self.r > 2, jnp.nan, 0.0), states.shape)


def density_of(filter, **options):
    options = {"log_prior": log_prior, "parameters": R, "transforms": {"r": Positive()}} | options
    return log_density(filter, OBSERVATIONS, **options)


def test_it_is_prior_jacobian_and_likelihood():
    density = density_of(mpfjax.particle_filter(Fragile(r=0.5), 2))
    values = jnp.log(jnp.array([0.3, 1.7, 2.5, 3.5]))
    found = jax.jit(jax.vmap(lambda u: density({"r": u}, jax.random.key(0))))(values)
    np.testing.assert_allclose(
        found[:2], norm.logpdf(jnp.exp(values[:2]), 1, 0.5) + values[:2], rtol=1e-5
    )
    assert (found[2:] == -jnp.inf).all()
    flat = density_of(density.problem.tree, log_prior=lambda parameters: 0.0)
    assert flat({"r": values[0]}, jax.random.key(0)) == values[0]
    slope = jax.grad(lambda u: density({"r": u}, jax.random.key(0)))(values[0])
    assert float(slope) == pytest.approx(0.3 * (1 - 0.3) / 0.25 + 1, rel=1e-4)
    assert float(density.constrain(density.start)["r"]) == pytest.approx(0.5)
    assert float(density.problem.at({"r": values[1]}).model.r) == pytest.approx(1.7)
