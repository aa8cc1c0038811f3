"""Partitioned sampling and DPS against a grid, and their bookkeeping by hand."""

from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax import MultiObjectModel, PairwiseRepulsion, Partitioned, Resample
from mpfjax.moves.objects.partitioned import circular_orders
from tests.examples import make_mixture, stack, walker
from tests.marking import weekly
from tests.unbiased import assert_unbiased

KEY = jax.random.key(0)
MEANS, NOISES = (0.0, 1.0, -1.0), (0.5, 0.8, 1.0)
OBJECTS = [walker(mean, noise) for mean, noise in zip(MEANS, NOISES, strict=True)]
OBSERVATIONS = jnp.array(
    [[[0.5], [0.2], [-1.5]], [[1.0], [-0.3], [0.5]], [[1.2], [0.9], [-0.2]]]
)  # fmt: skip
STRENGTH, RADIUS = 3.0, 1.5
REPULSION = PairwiseRepulsion(STRENGTH, RADIUS)
PAIR = MultiObjectModel(stack(OBJECTS[:2]), 2, REPULSION)
APART, REPELLING = (MultiObjectModel(stack(OBJECTS), 3, psi) for psi in (None, REPULSION))
NUM_RUNS = 600


@eqx.filter_jit
def apply(move, mixture, model, observation):
    return move(KEY, mixture, mpfjax.Step(model, observation))


def normal(x, variance):
    return np.exp(-0.5 * x**2 / variance) / np.sqrt(2 * np.pi * variance)


def repulsion(grid, strength, radius):
    """ψ of two objects at each pair of places, by its formula."""
    squares = ((grid[:, None] - grid[None]) / radius) ** 2
    return np.exp(-strength * np.maximum(1 - squares, 0) ** 2)


def pair_on_a_grid(means, observations, strength, radius):
    """log p(y_1..y_t) and E[x_t | y_1..y_t] of a pair that repels, by quadrature over both."""
    grid = np.linspace(-6, 7, 521)
    cell = grid[1] - grid[0]
    psi = repulsion(grid, strength, radius)
    density = np.outer(*(normal(grid - mean, 1.0) for mean in means))
    transition = normal(grid[:, None] - 0.9 * grid[None], 0.4) * cell
    log_evidence = 0.0
    for first, second in np.asarray(observations)[..., 0]:
        density = transition @ density @ transition.T
        density *= np.outer(normal(first - grid, NOISES[0]), normal(second - grid, NOISES[1])) * psi
        mass = density.sum() * cell**2
        log_evidence += np.log(mass)
        density /= mass
    return log_evidence, np.array([grid @ density.sum(axis=1 - j) * cell**2 for j in (0, 1)])


def assert_both_unbiased(log_estimates, means, log_evidence, exact_means):
    """E[Ẑ/Z] = 1 and E[Ẑ/Z x̂] = E[x | y]."""
    ratios = np.exp(np.asarray(log_estimates, float) - log_evidence)
    assert_unbiased(ratios, loosest=0.05)
    assert_unbiased(ratios[:, None] * np.asarray(means), exact_means)


FILTERS = {
    "dps": lambda: mpfjax.distributed_partitioned_sampling(PAIR, 60, reassembly="evidence"),
    "ps": lambda: mpfjax.partitioned_sampling(PAIR, 60, (1, 0)),
}


@pytest.mark.exactness
@pytest.mark.parametrize("name", ["dps", *weekly(["ps"])])
def test_a_pair_that_repels_is_unbiased(name):
    keys, seen = jax.random.split(jax.random.key(3), NUM_RUNS), OBSERVATIONS[:, :2]
    runs = mpfjax.monte_carlo(keys, FILTERS[name](), seen, lambda mixture: mixture.mean()[:, 0])
    exact = pair_on_a_grid(MEANS[:2], seen, STRENGTH, RADIUS)
    assert_both_unbiased(runs.log_marginal_likelihood, runs.collected[:, -1], *exact)


@pytest.mark.exactness
@pytest.mark.parametrize("orders", [[(2, 0, 1), (1, 0, 2)], None])
def test_without_resampling_weights_are_those_of_the_joint_state(orders):
    """Every likelihood and every pair counts once, in any order and component."""
    rng = np.random.default_rng(0)
    log_weights = np.where(np.arange(40) % 7 == 0, -np.inf, rng.normal(size=40))
    labels = rng.integers(0, 2, 40)
    mixture = make_mixture(rng.normal(size=(40, 3, 1)), log_weights, labels, 2)
    between = Resample(ess_threshold=0.0, allocation="equal")
    moved = apply(Partitioned(orders, resample=between), mixture, REPELLING, OBSERVATIONS[0])
    before = mixture.log_weights[moved.ancestor_indices]
    expected = before + REPELLING.log_likelihood(OBSERVATIONS[0], moved.particles)
    filled = np.asarray(moved.occupied)
    found = moved.log_weights + moved.log_scale
    np.testing.assert_allclose(found[filled], expected[filled], rtol=1e-5)
    parents = np.asarray(moved.ancestor_indices)[filled]
    assert sorted(parents) == sorted(np.flatnonzero(log_weights > -np.inf))
    np.testing.assert_array_equal(moved.component_indicators[filled], labels[parents])


@pytest.mark.exactness
def test_the_object_moved_last_keeps_every_hypothesis():
    """It tells which order each component took."""
    mixture = make_mixture(np.zeros((90, 3, 1)), np.zeros(90), np.repeat(np.arange(3), 30), 3)

    def moved_last(orders):
        moved = apply(Partitioned(orders), mixture, APART, OBSERVATIONS[0])
        particles, labels = np.asarray(moved.particles), np.asarray(moved.component_indicators)
        distinct = [[len(np.unique(particles[labels == c, j])) for j in range(3)] for c in range(3)]
        return [np.flatnonzero(np.array(row) == 30).tolist() for row in distinct]

    assert moved_last(circular_orders(3)) == [[2], [0], [1]]
    assert moved_last([(0, 2, 1), (0, 1, 2), (2, 1, 0)]) == [[1], [2], [0]]


class HalfBlind(mpfjax.QuadraticModel):
    """An object that can only be seen right of y; -inf elsewhere."""

    def log_likelihood(self, observation, states):
        return jnp.where(states > observation, -states, -jnp.inf)


@cache
def of_three_places(reassembly):
    """A move, three components of ten particles at places of their own, and their model."""
    model = MultiObjectModel(HalfBlind(0.1, 0.1, -1.0, 1.0), 2, shared_observation=True)
    labels = np.repeat(np.arange(3), 10)
    states = np.array([5.0, -5.0, 4.0])[labels][:, None] * np.ones((1, 2))
    mixture = make_mixture(states, 0.1 * np.arange(30), labels, 3)
    orders = [(0, 1), (1, 0), (0, 1)]
    return Partitioned(orders, reassembly=reassembly), mixture, model


@pytest.mark.exactness
@pytest.mark.parametrize("reassembly", ["prior", "evidence"])
def test_what_dies_leaves_its_slots_and_where_all_is_lost_particles_follow_their_dynamics(
    reassembly,
):
    move, before, model = of_three_places(reassembly)
    after = apply(move, before, model, jnp.array(0.0))
    assert after.active.tolist() == [True, False, True]
    assert after.component_counts.tolist() == [15, 0, 15]
    assert (np.asarray(after.particles) > 3).all()
    lost = apply(move, before, model, jnp.array(50.0))
    assert float(lost.log_mass) == -np.inf
    np.testing.assert_array_equal(lost.component_indicators, before.component_indicators)
    np.testing.assert_allclose(lost.particles, before.particles, atol=0.6)
