"""x_0 chosen among K N draws by the first observation: an ordinary initial move."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal

import mpfjax
from mpfjax.exact import kalman_filter
from mpfjax.moves.initial import SelectInitial, selection_weights
from tests.moves.start.test_sampler import PLACES, WithKeys
from tests.unbiased import assert_unbiased, ratios_to
from tests.user_models import ScalarLinear

KEY = jax.random.key(0)
OBSERVATIONS = np.array([3.0, 3.3, 3.1], np.float32)


# x_0 from N(0, 30²), then a random walk, seen with a small error.
WIDE = ScalarLinear(a=1.0, q=0.3, r=0.3, m=0.0, p=30.0)


def make(num_draws):
    return mpfjax.with_initial_selection(mpfjax.particle_filter(WIDE, 100), num_draws)


def nothing(mixture):
    del mixture


@pytest.mark.exactness
def test_log_z_varies_less():
    """That it is unbiased is asked in `tests/matrix`."""
    exact = kalman_filter(WIDE.in_matrices(), OBSERVATIONS[:, None]).log_marginal_likelihood
    one, eight = (
        mpfjax.monte_carlo(jax.random.split(KEY, 500), make(k), OBSERVATIONS, nothing)
        for k in (1, 8)
    )
    errors = [np.mean((run.log_marginal_likelihood - exact) ** 2) for run in (one, eight)]
    assert errors[1] < 0.36 * errors[0], errors


@pytest.mark.exactness
def test_without_an_observation_it_does_nothing():
    gap = OBSERVATIONS.copy()
    gap[0] = np.nan
    run, plain = (mpfjax.run_filter(KEY, make(k), gap, missing="skip") for k in (4, 1))
    np.testing.assert_array_equal(run.initial.log_weights, plain.initial.log_weights)
    assert run.initial.log_scale == 0


@pytest.mark.exactness
def test_what_a_chain_weighs_before_it_propagates_counts():
    """x_0 is seen once more, with an error of 2, by a move at the head of the chain."""

    def tilt(key, mixture, now):
        log_factors = jax.scipy.stats.norm.logpdf(now.observation, mixture.particles, 2.0)
        return mixture.reweight(log_factors)

    model, observation = ScalarLinear(a=1.0, q=0.3, r=0.3, m=0.0, p=3.0), 1.5
    filter = mpfjax.Filter(
        model, [tilt, mpfjax.Resample(), mpfjax.Propagate()], 200,
        initial_moves=[SelectInitial(8)],
    )  # fmt: skip
    keys = jax.random.split(KEY, 400)
    found = mpfjax.monte_carlo(keys, filter, np.array([observation], np.float32), nothing)
    # Both observations are normal given x_0 of variance 9.
    both = multivariate_normal([0, 0], [[9 + 4, 9], [9, 9 + 0.09 + 0.09]])
    assert_unbiased(ratios_to(both.logpdf([observation] * 2), found))


@pytest.mark.exactness
def test_impossible_and_empty_particles():
    """How far likelihoods are trusted otherwise is in `tests/lookahead/test_pilot.py`."""
    log_factors = jnp.array([[0.0, -jnp.inf, jnp.nan, 5.0], [0.0, -jnp.inf, 0.0, 5.0]])
    found = np.asarray(selection_weights(log_factors, jnp.array([1.0, 1.0, 1.0, 0.0])))
    assert np.all(np.isfinite(found))
    assert found[0] > 1 > found[1] >= 0.25
    np.testing.assert_array_equal(selection_weights(jnp.full((2, 3), -jnp.inf), jnp.ones(3)), 1.0)


@pytest.mark.exactness
def test_a_prior_too_wide_for_its_draws_is_told(recwarn):
    """Of 800 draws on a plane hardly one is near y_1; on a line some ten are."""
    wide = mpfjax.mixture_particle_filter(WithKeys(), 200, 2)
    with pytest.warns(
        RuntimeWarning, match=r"hardly any draw of x_0.*with_initialisation.*log_initial"
    ):
        mpfjax.monte_carlo(jax.random.split(KEY, 4), wide, PLACES[:1], nothing)
    recwarn.clear()
    mpfjax.run_filter(KEY, mpfjax.with_initialisation(wide, 1), PLACES[:1], nothing)
    mpfjax.run_filter(KEY, mpfjax.mixture_particle_filter(WIDE, 200, 2), OBSERVATIONS, nothing)
    assert not recwarn.list
