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


@pytest.mark.parametrize(("sigma_x", "sigma_y", "trust"), [(0.5, 0.1, 0.0), (1e-4, 1.0, 0.75)])
def test_wide_steps_select_nothing_and_narrow_ones_trust_three_quarters(sigma_x, sigma_y, trust):
    """Of the likelihood, or where a step is wider than it is."""
    states = np.linspace(0.9, 1.1, 50) if trust == 0 else np.linspace(0.0, 4.0, 50)
    model = mpfjax.QuadraticModel(sigma_x, sigma_y)
    found = ahead(model, jnp.float32(1.0), jnp.asarray(states), np.full(50, 1 / 50))
    likelihoods = np.exp(-0.5 * ((1.0 - states**2) / sigma_y) ** 2)
    expected = 1 - trust + trust * likelihoods / likelihoods.mean()
    np.testing.assert_allclose(found, expected, rtol=1e-2 * (trust > 0))


@pytest.mark.parametrize("noise", ["rqmc", "independent"])
def test_point_sets_bring_it_along_and_independent_noise_does_not(noise):
    model = mpfjax.QuadraticModel()
    move = mpfjax.mixture_particle_filter(model, 20, 2, noise=noise).moves[0]
    assert isinstance(getattr(move, "lookahead", None), PilotLookahead) == (noise == "rqmc")
    guided = mpfjax.GaussNewtonProposal()
    filter = mpfjax.mixture_particle_filter(model, 20, 2, noise=noise, proposal=guided)
    assert isinstance(filter.moves[0], mpfjax.Resample)
