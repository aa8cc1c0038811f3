"""Particle marginal Metropolis-Hastings against the exact posterior, and what it refuses."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.scipy.stats import norm

import mpfjax
from mpfjax.exact import kalman_filter
from mpfjax.tuning import Interval, Positive, metropolis_hastings
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


def test_the_posterior_is_the_exact_one():
    """Of a in (-1, 1), with so few particles that log Z-hat is far from log Z."""
    grid = jnp.linspace(-0.999, 0.999, 401)

    def log_density(a):
        model = ScalarLinear(a=a).in_matrices()
        evidence = kalman_filter(model, OBSERVATIONS[:, None]).log_marginal_likelihood
        return evidence + log_prior({"a": a})

    log_densities = np.asarray(jax.jit(jax.vmap(log_density))(grid), float)
    density = np.exp(log_densities - log_densities.max())
    density /= density.sum()
    a = np.asarray(grid, float)
    mean = density @ a
    moments = np.array([mean, density @ (a - mean) ** 2])
    run = sample(450, num_chains=60)
    chains = run.parameters["a"][:, 50:]
    assert chains.shape == (60, 400)
    found = np.stack([chains.mean(axis=1), ((chains - mean) ** 2).mean(axis=1)], axis=1)
    error = found.std(axis=0, ddof=1) / np.sqrt(len(found))
    assert (error < 0.08 * np.sqrt(moments[1])).all()
    assert (np.abs(found.mean(axis=0) - moments) < 4 * error).all()
    assert 0.1 < run.acceptance_rate < 0.9
    assert run.stopped is None


@pytest.mark.thorough
def test_the_likelihoods_are_those_of_the_states():
    """They change when, and only when, a step moves, and spread about the exact one."""
    run = sample(30, num_chains=3)
    moved = np.diff(run.log_marginal_likelihoods, axis=1) != 0
    np.testing.assert_array_equal(np.diff(run.parameters["a"], axis=1) != 0, moved)
    np.testing.assert_array_equal(run.accepted[:, 1:], moved)
    many = mpfjax.particle_filter(ScalarLinear(), 4000)
    last = sample(2, filter=many)
    model = ScalarLinear(a=jnp.asarray(last.parameters["a"][0, -1])).in_matrices()
    exact = kalman_filter(model, OBSERVATIONS[:, None]).log_marginal_likelihood
    assert last.log_marginal_likelihoods[0, -1] == pytest.approx(float(exact), abs=0.2)


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


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"num_steps": 0}, "num_steps: 0"),
        ({"num_chains": 0}, "num_chains: 0"),
        ({"proposal_deviations": 0.0}, "proposal_deviations: a: 0.0"),
        ({"proposal_deviations": {"b": 1.0}}, r"proposal_deviations: those of \['b'\]"),
        ({"proposal_deviations": {"a": np.ones(2)}}, r"proposal_deviations: .* nor \(\) numbers"),
        ({"log_prior": lambda p: 0 * p["a"] - jnp.inf}, "log_prior: -inf at the start"),
        ({"transforms": {"a": Interval(2.0, 3.0)}}, "a starts at"),
        ({"transforms": {"b": Positive()}}, r"transforms: \['b'\]"),
        ({"filter": mpfjax.gaussian_particle_filter(ScalarLinear(), 12)}, "filter: "),
    ],
)
def test_bad_arguments_are_refused_by_name(options, named):
    with pytest.raises(ValueError, match=named):
        sample(**options)


@pytest.mark.usefixtures("as_installed")
@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"key": 0}, "key: 0 is no typed key"),
        ({"key": jax.random.PRNGKey(0)}, "key: .*old kind"),
        ({"filter": 3}, "filter: 3 is not a filter"),
        ({"num_steps": 2.0}, "num_steps: 2.0"),
        ({"num_chains": None}, "num_chains: None"),
        ({"log_prior": None}, "log_prior: None"),
        ({"log_prior": lambda p: None}, "log_prior: None at the start"),
        ({"log_prior": lambda p: jnp.ones(2) * p["a"]}, "log_prior: .* is no floating"),
        ({"proposal_deviations": "wide"}, "proposal_deviations: 'wide' of a"),
        ({"proposal_deviations": None}, "proposal_deviations: "),
        ({"parameters": "a"}, "parameters: 'a'"),
        ({"transforms": "a"}, "transforms: 'a'"),
    ],
)
def test_wrong_types_are_refused_by_name(options, named):
    with pytest.raises(ValueError, match=named):
        sample(**options)


def test_calls_share_one_program():
    """Of any length, burn-in and thinning."""
    sample(3)
    with nothing_traced():
        sample(40, burn_in=7, thinning=3, key=jax.random.key(5))


@pytest.mark.thorough
def test_all_of_the_model_is_sampled_where_nothing_is_named():
    run = sample(2, parameters=None, transforms=None, log_prior=lambda p: -sum(
        0.5 * value**2 for value in p.values()
    ), proposal_deviations=0.01)  # fmt: skip
    assert run.parameters.keys() == set("aqhrmp")
    assert eqx.is_array_like(run.log_marginal_likelihoods)
