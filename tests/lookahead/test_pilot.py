"""The look-ahead from a model's own noise; for unbiased Ẑ see `tests/together/test_chains.py`."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax.lookahead.pilot import PilotLookahead
from tests.examples import make_mixture


def ahead(model, observation, states, weights):
    """ν of states in one component."""
    mixture = make_mixture(states, np.log(weights), np.zeros(len(weights)), 1)

    @eqx.filter_jit
    def look(model, observation, mixture):
        return PilotLookahead().log_factors(mixture, mpfjax.Step(model, observation))

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


@pytest.mark.parametrize("noise", ["rqmc", "independent"])
def test_point_sets_bring_it_along_and_independent_noise_does_not(noise):
    model = mpfjax.QuadraticModel()
    move = mpfjax.mixture_particle_filter(model, 20, 2, noise=noise).moves[0]
    assert isinstance(getattr(move, "lookahead", None), PilotLookahead) == (noise == "rqmc")
    guided = mpfjax.GaussNewtonProposal()
    filter = mpfjax.mixture_particle_filter(model, 20, 2, noise=noise, proposal=guided)
    assert isinstance(filter.moves[0], mpfjax.Resample)
