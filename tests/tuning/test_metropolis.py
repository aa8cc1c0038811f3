"""Particle marginal Metropolis-Hastings: the log density, and what is done where it is broken."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.scipy.stats import norm

import mpfjax
from mpfjax.tuning import Interval, Positive, log_density, metropolis_hastings
from tests.user_models import ScalarLinear

OBSERVATIONS = jnp.array([1.5, 0.2, -0.4, 0.8, 1.9, 1.1, 0.3, -0.9, 0.4, 1.2])
A = {"a": lambda filter: filter.model.a}
INSIDE = Interval(-1.0, 1.0)


def log_prior(parameters):
    return norm.logpdf(parameters["a"], 0.3, 0.5)


FILTER = mpfjax.particle_filter(ScalarLinear(), 12)


def sample(num_steps=5, *, filter=FILTER, **options):
    options = {
        "log_prior": log_prior, "parameters": A, "transforms": {"a": INSIDE},
        "proposal_deviations": 1.5, "progress": False,
    } | options  # fmt: skip
    return metropolis_hastings(jax.random.key(0), filter, OBSERVATIONS, num_steps, **options)


class Breaking(ScalarLinear):
    """A likelihood that breaks where r is above 2, and is 1 elsewhere."""

    def log_likelihood(self, observation, states):
        return jnp.broadcast_to(jnp.where(self.r > 2, jnp.nan, 0.0), states.shape)


def test_the_log_density_is_prior_jacobian_and_likelihood():
    def log_prior(parameters):
        return jnp.where(parameters["r"] < 3, norm.logpdf(parameters["r"], 1.0, 0.5), -jnp.inf)

    def density_of(log_prior):
        filter = mpfjax.particle_filter(Breaking(r=0.5), 2)
        return log_density(
            filter, OBSERVATIONS, log_prior=log_prior, transforms={"r": Positive()},
            parameters={"r": lambda filter: filter.model.r},
        )  # fmt: skip

    density, key = density_of(log_prior), jax.random.key(0)
    values = jnp.log(jnp.array([0.3, 1.7, 2.5, 3.5]))
    found = jax.jit(jax.vmap(lambda u: density({"r": u}, key)))(values)
    np.testing.assert_allclose(
        found[:2], norm.logpdf(jnp.exp(values[:2]), 1, 0.5) + values[:2], rtol=1e-5
    )
    assert (found[2:] == -jnp.inf).all()
    assert density_of(lambda parameters: 0.0)({"r": values[0]}, key) == values[0]
    slope = jax.grad(lambda u: density({"r": u}, key))(values[0])
    assert float(slope) == pytest.approx(0.3 * (1 - 0.3) / 0.25 + 1, rel=1e-4)
    assert float(density.constrain(density.start)["r"]) == pytest.approx(0.5)


class Fragile(ScalarLinear):
    """A likelihood that breaks where a is above 0.9."""

    def log_likelihood(self, observation, states):
        honest = super().log_likelihood(observation, states)
        return jnp.where(self.a > 0.9, jnp.nan, honest)


@pytest.mark.exactness
def test_a_nan_is_rejected_and_counted():
    filter = mpfjax.particle_filter(Fragile(a=0.5), 12)
    with pytest.warns(UserWarning, match=r"was NaN or \+inf, taken for zero, \d+ times$"):
        run = sample(200, filter=filter, num_chains=4)
    assert run.stopped is None
    assert run.parameters["a"].shape == (4, 200)
    assert (run.parameters["a"] <= 0.9).all()
    assert run.accepted.any(axis=1).all()
    assert (run.num_invalid > 0).all()


def test_a_start_that_breaks_is_an_error():
    with pytest.raises(RuntimeError, match="was NaN or inf"):
        sample(filter=mpfjax.particle_filter(Fragile(a=0.95), 12), num_chains=4)
