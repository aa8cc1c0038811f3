"""The look-ahead from a model's own noise; that Ẑ stays unbiased is in `tests/test_chains.py`."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from benchmarks.masses.models import Mirror
from mpfjax.lookahead.pilot import PilotLookahead
from tests.examples import make_mixture
from tests.user_models import Batched


def ahead(model, observation, states, weights):
    """ν of states in one component."""
    mixture = make_mixture(states, np.log(weights), np.zeros(len(weights)), 1)

    @eqx.filter_jit
    def look(model, observation, mixture):
        return PilotLookahead(model).at_step_of(mixture)(observation, mixture.particles)

    return np.exp(np.asarray(look(model, observation, mixture), float))


def test_it_is_the_mean_of_both_likelihoods_shrunk_by_their_correlation():
    """Beside numpy's, on weighted states of which the two likelihoods partly agree."""
    rng = np.random.default_rng(0)
    model = mpfjax.QuadraticModel(sigma_x=0.15, sigma_y=1.0)
    states, weights = rng.normal(1.5, 0.5, size=400), rng.dirichlet(np.ones(400))
    both = np.stack([np.exp(-0.5 * (2.0 - (states + e) ** 2) ** 2) for e in (0.15, -0.15)])
    mean = np.sum(weights * both) / 2
    gaps = both - mean
    r = np.sum(weights * gaps[0] * gaps[1]) / np.sum(weights * gaps**2) * 2
    assert 0.1 < r < 0.6, "at a bound of the trust"
    expected = 1 + 2 * r / (1 + r) * (both.mean(axis=0) / mean - 1)
    found = ahead(model, jnp.float32(2.0), jnp.asarray(states, jnp.float32), weights)
    np.testing.assert_allclose(found, expected, rtol=2e-3)


def test_nothing_is_selected_where_a_step_is_wider_than_the_likelihood():
    states = jnp.linspace(0.9, 1.1, 50)
    found = ahead(mpfjax.QuadraticModel(0.5, 0.1), jnp.float32(1.0), states, np.full(50, 1 / 50))
    np.testing.assert_array_equal(found, 1.0)


def test_where_a_step_is_narrow_three_quarters_of_the_likelihood_are_trusted():
    states = jnp.linspace(0.0, 4.0, 50)
    found = ahead(mpfjax.QuadraticModel(1e-4, 1.0), jnp.float32(1.0), states, np.full(50, 1 / 50))
    likelihoods = np.exp(-0.5 * (1.0 - np.linspace(0.0, 4.0, 50) ** 2) ** 2)
    np.testing.assert_allclose(found, 1 / 4 + 3 / 4 * likelihoods / likelihoods.mean(), rtol=1e-2)


@pytest.mark.thorough
def test_it_halves_the_mean_squared_error_of_log_z_on_the_mirror_image():
    """Of 60 runs with keys that nothing was chosen on; the ratio expected is .36."""
    model = Mirror()
    observations = model.simulated(40, 0)
    keys = jax.random.split(jax.random.key(77), 60)

    def spread(filter):
        return np.var(mpfjax.monte_carlo(keys, filter, observations).log_marginal_likelihood)

    plain = mpfjax.with_point_sets(mpfjax.mixture_particle_filter(model, 400, 4))
    assert spread(mpfjax.with_lookahead(plain)) < 0.6 * spread(plain)


def first_move(model, **options):
    return mpfjax.mixture_particle_filter(model, 20, 2, **options).moves[0]


def test_point_sets_bring_it_along_and_independent_noise_does_not():
    model = mpfjax.QuadraticModel()
    move = first_move(model, noise="rqmc")
    assert isinstance(move, mpfjax.AuxiliaryResample)
    assert isinstance(move.lookahead, PilotLookahead)
    guided = {"proposal": mpfjax.GaussNewtonProposal(model)}
    assert isinstance(first_move(model), mpfjax.Resample)
    assert isinstance(first_move(model, noise="rqmc", **guided), mpfjax.Resample)


def test_a_model_that_is_not_made_of_noise_is_refused():
    with pytest.raises(ValueError, match="transition_from_noise, which PilotLookahead needs"):
        PilotLookahead(Batched())
