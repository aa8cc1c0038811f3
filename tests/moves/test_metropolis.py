"""Metropolis moves: what they leave as it is, and whom they take for a particle's parent."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax import (
    Every,
    Filter,
    GaussianRegeneration,
    KMeans,
    MetropolisAdjustedLangevin,
    Propagate,
    RandomWalkMetropolis,
    Resample,
)
from mpfjax.exact import kalman_filter
from mpfjax.moves.base import AbstractMarkovMove
from mpfjax.moves.propagation.propagate import Predict, Reweight
from mpfjax.running.islands import IslandInteraction
from tests.marking import thorough
from tests.user_models import ScalarLinear

EYE = jnp.eye(2)
MODEL = mpfjax.LinearGaussianModel(
    jnp.array([[0.9, 0.2], [0.0, 0.8]]), EYE, EYE, 0.05 * EYE, jnp.zeros(2), EYE
)
OBSERVATIONS = jnp.array([[1.0, 0.5], [2.0, -1.0]])


class Watch(AbstractMarkovMove):
    """Puts the parents where the test finds them; moves nothing."""

    needs_parents = property(lambda self: True)

    def __call__(self, key, mixture, observation=None):
        return mixture.replace(memory=mixture.memory | {"parents": mixture.parents})

    def initial_memory(self, num_components):
        return {"parents": jnp.zeros((64, 2))}


@pytest.mark.parametrize("move", [RandomWalkMetropolis, *thorough([MetropolisAdjustedLangevin])])
def test_a_move_leaves_the_target_as_it_is(move):
    """Of exact draws from p(x_1 | x_0, y_1), many steps later: the mean and the covariance."""
    n = 4000
    key_parents, key_states, key_move = jax.random.split(jax.random.key(0), 3)
    parents = jax.random.normal(key_parents, (n, 2))
    precision = jnp.eye(2) + jnp.eye(2) / 0.05
    predicted = MODEL.transition_mean(parents)
    gain = jnp.linalg.inv(precision) / 0.05
    mean = predicted + (OBSERVATIONS[:1] - predicted) @ gain
    noise = jax.random.normal(key_states, (n, 2)) @ jnp.linalg.cholesky(jnp.linalg.inv(precision)).T
    mixture = Filter(MODEL, [Propagate(MODEL)], n).init(key_parents)
    mixture = mixture.replace(particles=mean + noise, parents=parents)
    moved = eqx.filter_jit(move(MODEL, 2))(key_move, mixture, OBSERVATIONS[0])
    residuals = np.asarray(moved.particles - mean)
    changed = np.any(residuals != np.asarray(noise), axis=1)
    assert 0.3 < changed.mean() < 1.0
    error = np.sqrt(1 / np.asarray(precision)[0, 0] / n)
    np.testing.assert_array_less(np.abs(residuals.mean(axis=0)), 4 * error)
    expected = np.linalg.inv(precision)
    np.testing.assert_allclose(np.cov(residuals.T), expected, atol=6 * expected[0, 0] / n**0.5)
    np.testing.assert_array_equal(moved.log_weights, mixture.log_weights)


@pytest.mark.parametrize(
    "again", [Resample("multinomial"), Every(2, [Resample("multinomial")])], ids=["each", "every"]
)
def test_parents_follow_their_particles(again):
    """Through resampling before and after the propagation, they are the states of the ancestors."""
    watched = Watch()
    moves = [Resample(), Propagate(MODEL), again, watched]
    filter = Filter(MODEL, moves, 64, 3, initial_moves=[KMeans(3, reseed=True)])
    run = mpfjax.run_filter(jax.random.key(0), filter, OBSERVATIONS)
    before, after = run.collected.particles[0], run.final
    assert after.parents is None
    np.testing.assert_array_equal(after.memory["parents"], before[after.ancestor_indices])
    assert len(np.unique(after.ancestor_indices)) >= 3


@pytest.mark.thorough
def test_stages_halve_the_error_where_the_likelihood_is_narrow():
    """In four dimensions, log Ẑ of 200 particles against Kalman's; times are in `benchmarks`."""
    eye = jnp.eye(4)
    model = mpfjax.LinearGaussianModel(0.9 * eye, eye, eye, 0.01 * eye, jnp.zeros(4), eye)
    observations = jax.random.normal(jax.random.key(1), (5, 4))
    truth = kalman_filter(model, observations).log_marginal_likelihood
    moves = [Resample(), Predict(model), Reweight(model, 0.05), Resample()]
    moves += [RandomWalkMetropolis(model, 3, exponent=0.05), Reweight(model, 0.95)]
    keys = jax.random.split(jax.random.key(2), 64)
    errors = [
        mpfjax.monte_carlo(keys, filter, observations, lambda m: None).log_marginal_likelihood
        - truth
        for filter in (mpfjax.particle_filter(model, 200), Filter(model, moves, 200))
    ]
    plain, staged = (np.sqrt(np.mean(np.square(error))) for error in errors)
    assert staged < 0.5 * plain


@pytest.mark.parametrize(
    "move", thorough([RandomWalkMetropolis, MetropolisAdjustedLangevin]), ids=["walk", "langevin"]
)
def test_the_score_passes_through_the_move(move):
    """With "stop", the average gradient is that of the exact log-likelihood."""
    model, observations = ScalarLinear(), jnp.array([0.5, 1.0, 0.2])

    def exact(a):
        own = eqx.tree_at(lambda m: m.a, model, a).in_matrices()
        return kalman_filter(own, observations[:, None]).log_marginal_likelihood

    def estimate(a, key):
        own = eqx.tree_at(lambda m: m.a, model, a)
        moves = [
            Propagate(own, gradient="stop"),
            Resample(gradient="stop"),
            move(own, 2, gradient="stop"),
        ]
        filter = Filter(own, moves, 500)
        return mpfjax.run_filter(key, filter, observations, lambda m: None).log_marginal_likelihood

    keys = jax.random.split(jax.random.key(4), 200)
    scores = jax.jit(jax.vmap(jax.grad(estimate), (None, 0)))(model.a, keys)
    error = np.std(scores) / np.sqrt(len(keys))
    assert abs(np.mean(scores) - jax.grad(exact)(model.a)) < 4 * error + 0.01


class TestArguments:
    def test_chains_without_one_parent_are_named(self):
        move = RandomWalkMetropolis(MODEL)
        with pytest.raises(ValueError, match="IslandInteraction leaves no particle one parent"):
            Filter(MODEL, [Propagate(MODEL), IslandInteraction(), move], 8)
        regenerated = Every(2, [GaussianRegeneration()])
        with pytest.raises(ValueError, match="GaussianRegeneration leaves no particle one parent"):
            Filter(MODEL, [Propagate(MODEL), regenerated, move], 8)
        with pytest.raises(ValueError, match="comes before any propagation"):
            move(jax.random.key(0), Filter(MODEL, [Propagate(MODEL)], 8).init(jax.random.key(0)), 0)

    @pytest.mark.parametrize(
        ("option", "message"),
        [
            ({"num_steps": 0}, "num_steps: 0"),
            ({"least_step": 1.0}, "least_step: 1"),
            ({"exponent": 0.0}, "exponent: 0"),
            ({"gradient": "soft"}, "gradient: 'soft'"),
        ],
    )
    def test_options_are_named(self, option, message):
        with pytest.raises(ValueError, match=message):
            MetropolisAdjustedLangevin(MODEL, **option)
        with pytest.raises(ValueError, match="exponent: 2"):
            Reweight(MODEL, 2.0)
