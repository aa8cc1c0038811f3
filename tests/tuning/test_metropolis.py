"""What particle marginal Metropolis-Hastings does with broken densities."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.scipy.stats import norm

import mpfjax
from mpfjax.tuning import Interval, metropolis_hastings
from tests.user_models import ScalarLinear, nothing_traced

OBSERVATIONS = jnp.array([1.5, 0.2, -0.4, 0.8, 1.9, 1.1, 0.3, -0.9, 0.4, 1.2])
A = {"a": lambda filter: filter.model.a}
INSIDE = Interval(-1.0, 1.0)


def log_prior(parameters):
    return norm.logpdf(parameters["a"], 0.3, 0.5)


def sample(num_steps=5, *, filter=None, key=None, **options):
    options = {
        "log_prior": log_prior, "parameters": A, "transforms": {"a": INSIDE},
        "proposal_deviations": 1.5, "progress": False,
    } | options  # fmt: skip
    filter = mpfjax.particle_filter(ScalarLinear(), 12) if filter is None else filter
    key = jax.random.key(0) if key is None else key
    return metropolis_hastings(key, filter, OBSERVATIONS, num_steps, **options)


def test_the_likelihoods_are_those_of_the_states():
    """They change when, and only when, a step moves."""
    run = sample(30, num_chains=3)
    moved = np.diff(run.log_marginal_likelihoods, axis=1) != 0
    np.testing.assert_array_equal(np.diff(run.parameters["a"], axis=1) != 0, moved)
    np.testing.assert_array_equal(run.accepted[:, 1:], moved)


class Fragile(ScalarLinear):
    """A likelihood that breaks where a is above 0.9."""

    def log_likelihood(self, observation, states):
        honest = super().log_likelihood(observation, states)
        return jnp.where(self.a > 0.9, jnp.nan, honest)


def test_a_nan_is_rejected_and_counted():
    filter = mpfjax.particle_filter(Fragile(a=0.5), 12)
    with pytest.warns(UserWarning, match=r"zero density: log_marginal_likelihood \d+ times$"):
        run = sample(200, filter=filter, num_chains=4)
    assert run.stopped is None
    assert run.parameters["a"].shape == (4, 200)
    assert (run.parameters["a"] <= 0.9).all()
    assert run.accepted.any(axis=1).all()
    assert (run.num_invalid["log_marginal_likelihood"] > 0).all()
    assert not run.num_invalid["log_prior"].any()


def test_a_prior_that_is_nan_outside_its_support_is_zero_there():
    def sided(parameters):
        return jnp.log(0.9 - parameters["a"])

    filter = mpfjax.particle_filter(Fragile(a=0.5), 12)
    with pytest.warns(UserWarning, match=r"zero density: log_prior \d+ times$"):
        run = sample(60, filter=filter, num_chains=4, log_prior=sided)
    assert (run.parameters["a"] <= 0.9).all()
    assert not run.num_invalid["log_marginal_likelihood"].any()


def test_what_the_prior_rules_out_is_never_reached():
    """Not even a likelihood that is NaN there."""

    def low(parameters):
        return jnp.where(parameters["a"] > 0.9, -jnp.inf, 0.0)

    filter = mpfjax.particle_filter(Fragile(a=0.5), 12)
    run = sample(60, filter=filter, num_chains=4, log_prior=low)
    assert run.stopped is None
    assert (run.parameters["a"] <= 0.9).all()


def test_a_start_that_breaks_is_an_error():
    with pytest.raises(RuntimeError, match="was NaN or inf"):
        sample(filter=mpfjax.particle_filter(Fragile(a=0.95), 12))


def test_calls_share_one_program():
    """Of any length, burn-in and thinning."""
    sample(3)
    with nothing_traced():
        sample(40, burn_in=7, thinning=3, key=jax.random.key(5))
