"""Propagation in stages; that it is unbiased in every chain is in `tests/test_chains.py`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax import PropagateTempered, Resample
from mpfjax.exact import grid_filter, kalman_filter

NARROW = mpfjax.QuadraticModel(0.5, 0.02, -2.0, 2.0)
SEEN = jnp.array([1.0, 1.4, 0.9, 0.6, 1.1])
GRID = jnp.linspace(-4.0, 4.0, 4001)


def in_stages(model, num_particles, **options):
    moves = [Resample(), PropagateTempered(model, **options)]
    return mpfjax.Filter(model, moves, num_particles)


EYE = np.eye(4, dtype=np.float32)
FOUR = mpfjax.LinearGaussianModel(
    A=0.9 * EYE, Q=EYE, H=EYE, R=0.01 * EYE, m0=np.zeros(4, np.float32), P0=EYE
)


def log_errors(filter, seen, exact):
    """Of log Ẑ, over runs."""
    keys = jax.random.split(jax.random.key(0), 200)
    found = mpfjax.monte_carlo(keys, filter, seen, lambda mixture: None)
    return np.asarray(found.log_marginal_likelihood, float) - float(exact)


@pytest.mark.thorough
def test_it_costs_less_than_more_particles_where_the_likelihood_is_narrow_in_four_dimensions():
    seen = jnp.asarray(np.random.default_rng(0).normal(size=(5, 4)), jnp.float32)
    exact = kalman_filter(FOUR, seen).log_marginal_likelihood
    # 100 particles, each with 1 + 4 * 3 evaluations of the likelihood, and as many in one stage.
    stages = log_errors(in_stages(FOUR, 100, num_moves=4), seen, exact)
    plain = log_errors(mpfjax.particle_filter(FOUR, 1300), seen, exact)
    assert np.sqrt(np.mean(stages**2)) < 0.5 * np.sqrt(np.mean(plain**2))


def test_the_marginal_likelihood_is_unbiased():
    exact = grid_filter(NARROW, SEEN, GRID).log_marginal_likelihood
    filter = in_stages(NARROW, 100, exponents=(1 / 256, 1 / 16, 1.0), num_moves=2)
    ratios = np.exp(log_errors(filter, SEEN, exact))
    assert abs(ratios.mean() - 1) <= 4 * ratios.std() / np.sqrt(len(ratios))


@pytest.mark.thorough
def test_particles_between_the_stages_follow_the_tempered_target():
    """One step of many particles, with moves enough to forget where they were drawn."""
    model = mpfjax.QuadraticModel(1.0, 4.0, -1.0, 1.0)  # which the prior tells as much as y_1
    filter = in_stages(model, 20_000, exponents=(0.9, 1.0), num_moves=20)
    mixture, _ = filter.step(jax.random.key(2), filter.init(jax.random.key(1)), SEEN[0])
    probabilities = np.asarray(grid_filter(model, SEEN[:1], 2 * GRID).probabilities[0], float)
    values, weights = np.asarray(mixture.particles, float), np.asarray(mixture.weights, float)
    for power in (1, 2, 4):
        truth = probabilities @ (2 * np.asarray(GRID, float)) ** power
        moments = values**power
        error = np.sqrt(np.sum(weights**2 * (moments - truth) ** 2))
        assert abs(weights @ moments - truth) <= 4 * error


def test_one_stage_is_the_plain_propagation():
    """Without stages between there is nothing to resample or move: weights are L."""
    filter = in_stages(NARROW, 50, exponents=(1.0,))
    mixture, info = filter.step(jax.random.key(2), filter.init(jax.random.key(1)), SEEN[0])
    log_likelihoods = np.asarray(NARROW.log_likelihood(SEEN[0], mixture.particles), float)
    np.testing.assert_allclose(
        float(info.log_likelihood_increment), np.log(np.mean(np.exp(log_likelihoods))), rtol=1e-4
    )


def test_ancestors_are_those_of_the_step_before():
    still = mpfjax.QuadraticModel(1e-6, 0.5, -2.0, 2.0)
    filter = in_stages(still, 40)
    before = filter.init(jax.random.key(0))
    after, _ = filter.step(jax.random.key(1), before, SEEN[0])
    parents = np.asarray(before.particles)[np.asarray(after.ancestor_indices)]
    np.testing.assert_allclose(after.particles, parents, atol=1e-4)


class _Broken(mpfjax.QuadraticModel):
    def log_likelihood(self, observation, states):
        return jnp.where(states > 0, jnp.nan, super().log_likelihood(observation, states))


def test_a_density_that_is_nan_is_said_and_not_resampled_away():
    filter = in_stages(_Broken(0.3, 0.5, -2.0, 2.0), 20)
    with pytest.raises(Exception, match="NaN or infinite"):
        filter.step(jax.random.key(2), filter.init(jax.random.key(1)), SEEN[0])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"exponents": (0.5, 0.2, 1.0)}, "exponents"),
        ({"exponents": (0.1, 0.5)}, "exponents"),
        ({"exponents": ()}, "exponents"),
        ({"num_moves": 0}, "num_moves"),
        ({"least_step": 1.5}, "least_step"),
        ({"resample": Resample(sort_by="hilbert")}, "sort_by"),
        ({"resample": 0.5}, "resample"),
    ],
)
def test_what_will_not_do_is_named(as_installed, options, message):
    with pytest.raises(ValueError, match=message):
        PropagateTempered(NARROW, **options)


def test_a_model_that_is_not_made_of_noise_is_refused():
    class OfDraws(mpfjax.AbstractStateSpaceModel):
        def sample_initial(self, key, num_particles):
            return jnp.zeros(num_particles)

        def sample_transition(self, key, states):
            return states

        def log_likelihood(self, observation, states):
            return states

    with pytest.raises(ValueError, match="transition_from_noise"):
        PropagateTempered(OfDraws())
