"""Clusters of objects against quadrature, and their merging by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax import MultiObjectModel, PairwiseRepulsion
from mpfjax.moves.objects.clusters import PropagateInClusters
from tests.examples import stack, walker
from tests.moves.test_partitioned import NOISES, assert_both_unbiased, pair_on_a_grid

KEY = jax.random.key(0)
MEANS, STRENGTH, RADIUS = (-0.5, 4.0), 3.0, 0.8
OBSERVATIONS = jnp.array([[[0.2], [3.0], [-2.5]], [[1.0], [1.5], [-1.5]], [[1.2], [1.2], [-1.2]]])
REPULSION = PairwiseRepulsion(STRENGTH, RADIUS)


PAIR = MultiObjectModel(stack([*map(walker, MEANS, NOISES)]), 2, REPULSION)


def labels_of(mixture):
    return mixture.memory["clusters"]["labels"]


@pytest.mark.weekly
def test_a_pair_that_repels_is_unbiased():
    """In some runs the pair meets at once, in others later."""
    filter, seen = mpfjax.clustered_particle_filter(PAIR, 20), OBSERVATIONS[:, :2]
    assert not filter.approximate

    def collect(mixture):
        return mixture.mean()[:, 0], labels_of(mixture)

    runs = mpfjax.monte_carlo(jax.random.split(KEY, 600), filter, seen, collect)
    means, labels = map(np.asarray, runs.collected)
    exact = pair_on_a_grid(MEANS, seen, STRENGTH, RADIUS)
    assert_both_unbiased(runs.log_marginal_likelihood, means[:, -1], *exact)
    is_merged = labels[:, :, 1] == 0
    assert 0.05 < is_merged[:, 0].mean() < 0.99
    assert (is_merged[:, 1:] >= is_merged[:, :-1]).all()


class Momentum(mpfjax.AbstractStateSpaceModel):
    """x_t = x_{t-1} + 0.5 (x_{t-1} - x_{t-2}) + noise; the states are (x_t, x_{t-1})."""

    def sample_initial(self, key, num_particles):
        return jax.random.normal(key, (num_particles, 2))

    def expected(self, states):
        return 1.5 * states[:, 0] - 0.5 * states[:, 1]

    def sample_transition(self, key, states):
        noise = jnp.sqrt(0.3) * jax.random.normal(key, states.shape[:1])
        return jnp.stack([self.expected(states) + noise, states[:, 0]], axis=1)

    def log_transition(self, states, previous_states):
        return -0.5 * (states[:, 0] - self.expected(previous_states)) ** 2 / 0.3

    def with_history(self, states, previous_states):
        return jnp.stack([states[:, 0], previous_states[:, 0]], axis=1)

    def log_likelihood(self, observation, states):
        return jax.scipy.stats.norm.logpdf(observation[0] - states[:, 0], scale=jnp.sqrt(0.5))


@pytest.mark.exactness
def test_crossing_keeps_a_state_that_holds_the_past():
    """Of two AR2 objects in one cluster, whose evidence is that of `test_chains.py`."""
    filter = mpfjax.Filter(MultiObjectModel(Momentum(), 2), [PropagateInClusters("together")], 45)
    before = filter.init(KEY)
    after, _ = filter.step(KEY, before, OBSERVATIONS[0, :2])
    pasts, parents = np.asarray(after.particles[:, :, 1]), np.asarray(before.particles[:, :, 0])
    of_one_row = (pasts[:, None] == parents[None]).all(axis=2)
    assert of_one_row.any(axis=1).all()


ONE = jnp.eye(1)
# An object that hardly moves and is hardly seen.
STILL = mpfjax.LinearGaussianModel(ONE, 1e-4 * ONE, ONE, 100.0 * ONE, jnp.zeros(1), ONE)


def placed(places, filter):
    """The filter's x_0 with every object of every particle at a place of its own."""
    mixture = filter.init(KEY)
    states = jnp.asarray(places)[None] + 0.01 * mixture.particles[:, :, 0]
    return mixture.replace(particles=states[:, :, None])


def test_who_touches_merges_and_stays_in_the_cluster():
    """Object 2 touches 0 and 3, which do not touch each other; then 3 goes away."""
    model = MultiObjectModel(STILL, 4, PairwiseRepulsion(2.0, 1.0), per_object=False)
    filter = mpfjax.clustered_particle_filter(model, 30)
    assert not filter.approximate
    seen = jnp.zeros((4, 1))
    mixture, info = filter.step(KEY, placed([0.0, 9.0, 0.8, 1.6], filter), seen)
    assert np.isfinite(info.log_likelihood_increment)
    assert labels_of(mixture).tolist() == [0, 1, 0, 0]
    away = jnp.array([0.0, 0.0, 0.0, 5.0])[None, :, None]
    mixture = mixture.replace(particles=mixture.particles + away)
    for _ in range(2):
        mixture, _ = filter.step(KEY, mixture, seen)
        assert labels_of(mixture).tolist() == [0, 1, 0, 0]


@pytest.mark.exactness
def test_what_cannot_be_leaves_the_particles_to_their_dynamics():
    """A pair that excludes each other altogether, on one spot."""

    def never(states, others):
        return jnp.where(jnp.abs(states - others)[:, 0] < 1.0, -jnp.inf, 0.0)

    model = MultiObjectModel(STILL, 2, never, per_object=False)
    filter = mpfjax.clustered_particle_filter(model, 20)
    before = placed([0.0, 0.0], filter)
    after, info = filter.step(KEY, before, jnp.zeros((2, 1)))
    assert bool(info.degenerate)
    assert labels_of(after).tolist() == [0, 1]
    np.testing.assert_allclose(after.particles, before.particles, atol=0.1)
