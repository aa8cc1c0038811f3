"""Clusters of objects against Kalman filters and quadrature, and their merging by hand."""

from functools import cache

import chex
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax import MultiObjectModel, PairwiseRepulsion
from mpfjax.exact import kalman_filter
from mpfjax.moves.objects.clusters import PropagateInClusters
from tests.examples import stack, walker

KEY = jax.random.key(0)
NUM_RUNS = 600


MEANS, NOISES = (-0.5, 4.0, -2.5), (0.5, 0.8, 1.0)
OBJECTS = [walker(mean, noise) for mean, noise in zip(MEANS, NOISES, strict=True)]
OBSERVATIONS = jnp.array(
    [[[0.2], [3.0], [-2.5]], [[1.0], [1.5], [-1.5]], [[1.2], [1.2], [-1.2]]]
)  # fmt: skip
APART = MultiObjectModel(stack(OBJECTS), 3)
STRENGTH, RADIUS = 3.0, 0.8
PAIR = MultiObjectModel(stack(OBJECTS[:2]), 2, PairwiseRepulsion(STRENGTH, RADIUS))


def labels_of(mixture):
    return mixture.memory["clusters"]["labels"]


@eqx.filter_jit
def estimates(keys, filter, observations):
    """log Ẑ, the means at the end and the clusters' labels after each step, of a run a key."""

    def run(key):
        collect = lambda mixture: (mixture.mean(), labels_of(mixture))  # noqa: E731
        run = mpfjax.run_filter(key, filter, observations, collect)
        means, labels = run.collected
        return run.log_marginal_likelihood, means[-1, :, 0], labels

    return jax.vmap(run)(keys)


def assert_unbiased(log_estimates, means, log_evidence, exact_means):
    """E[Ẑ/Z] = 1 and E[Ẑ/Z x̂] = E[x | y] within 4 standard errors."""
    ratios = np.exp(np.asarray(log_estimates, float) - log_evidence)
    error = ratios.std() / np.sqrt(len(ratios))
    assert error < 0.03
    assert abs(ratios.mean() - 1) < 4 * error
    weighted = ratios[:, None] * np.asarray(means)
    z = (weighted.mean(axis=0) - exact_means) / (weighted.std(axis=0) / np.sqrt(len(ratios)))
    assert np.abs(z).max() < 4


def normal(x, variance):
    return np.exp(-0.5 * x**2 / variance) / np.sqrt(2 * np.pi * variance)


def psi(x, y):
    return np.exp(-STRENGTH * np.maximum(1 - ((x - y) / RADIUS) ** 2, 0) ** 2)


@cache
def pair_on_a_grid():
    """log p(y_1..y_3) and E[x_3 | y_1..y_3] of the pair, by quadrature over both objects."""
    grid = np.linspace(-5, 7, 481)
    cell = grid[1] - grid[0]
    density = np.outer(*(normal(grid - mean, 1.0) for mean in MEANS[:2]))
    transition = normal(grid[:, None] - 0.9 * grid[None], 0.4) * cell
    log_evidence = 0.0
    for first, second in np.asarray(OBSERVATIONS)[:, :2, 0]:
        density = transition @ density @ transition.T
        density *= np.outer(normal(first - grid, NOISES[0]), normal(second - grid, NOISES[1]))
        density *= psi(grid[:, None], grid[None])
        mass = density.sum() * cell**2
        log_evidence += np.log(mass)
        density /= mass
    return log_evidence, np.array([grid @ density.sum(axis=1 - j) * cell**2 for j in (0, 1)])


class TestAgainstExactAnswers:
    @pytest.mark.thorough
    def test_a_pair_that_repels_is_unbiased(self):
        """In some runs the pair meets at once, in others later."""
        filter = mpfjax.clustered_particle_filter(PAIR, 20)
        assert not filter.approximate
        keys = jax.random.split(jax.random.key(1), NUM_RUNS)
        log_estimates, means, labels = estimates(keys, filter, OBSERVATIONS[:, :2])
        assert_unbiased(log_estimates, means, *pair_on_a_grid())
        is_merged = np.asarray(labels)[:, :, 1] == 0
        assert 0.05 < is_merged[:, 0].mean() < 0.99
        assert (is_merged[:, 1:] >= is_merged[:, :-1]).all()

    @pytest.mark.thorough
    def test_three_that_meet_in_one_step_are_unbiased(self):
        """Against quadrature over all three, y_1 only."""
        close = (0.0, 1.0, -1.0)
        objects = stack([walker(mean, noise) for mean, noise in zip(close, NOISES, strict=True)])
        model = MultiObjectModel(objects, 3, PAIR.interaction)
        seen = 0.3 * OBSERVATIONS[:1]
        grid = np.linspace(-6, 6, 161)
        cell = grid[1] - grid[0]
        parts = [
            normal(grid - 0.9 * mean, 0.81 + 0.4) * normal(float(y) - grid, noise)
            for mean, y, noise in zip(close, seen[0, :, 0], NOISES, strict=True)
        ]
        table = psi(grid[:, None], grid[None])
        density = np.einsum("i,j,k,ij,ik,jk->ijk", *parts, table, table, table)
        mass = density.sum() * cell**3
        axes = ((1, 2), (0, 2), (0, 1))
        exact = np.array([grid @ density.sum(axis=axis) * cell**3 / mass for axis in axes])
        filter = mpfjax.clustered_particle_filter(model, 20)
        keys = jax.random.split(jax.random.key(2), NUM_RUNS)
        log_estimates, means, labels = estimates(keys, filter, seen)
        assert_unbiased(log_estimates, means, np.log(mass), exact)
        assert (np.asarray(labels) == 0).all(axis=(1, 2)).mean() > 0.9

    @pytest.mark.thorough
    def test_crossing_keeps_a_state_that_holds_the_past(self):
        """Two AR2 objects in one cluster, against Kalman filters of (x_t, x_{t-1})."""
        transition = jnp.array([[1.5, -0.5], [1.0, 0.0]])
        noise = jnp.diag(jnp.array([0.3, 0.0]))
        exact = mpfjax.LinearGaussianModel(
            transition, noise, jnp.array([[1.0, 0.0]]), jnp.array([[0.5]]), jnp.zeros(2), jnp.eye(2)
        )
        runs = [kalman_filter(exact, OBSERVATIONS[:, j]) for j in (0, 1)]
        filter = mpfjax.clustered_particle_filter(
            MultiObjectModel(Momentum(), 2), 45, start="together"
        )
        keys = jax.random.split(jax.random.key(3), NUM_RUNS)
        assert_unbiased(
            *estimates(keys, filter, OBSERVATIONS[:, :2])[:2],
            sum(float(run.log_marginal_likelihood) for run in runs),
            np.array([run.means[-1, 0] for run in runs]),
        )
        before = filter.init(KEY)
        after, _ = filter.step(KEY, before, OBSERVATIONS[0, :2])
        pasts, parents = np.asarray(after.particles[:, :, 1]), np.asarray(before.particles[:, :, 0])
        of_one_row = (pasts[:, None] == parents[None]).all(axis=2)
        assert of_one_row.any(axis=1).all()


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


@pytest.mark.thorough
def test_objects_apart_are_independent_filters_row_order_aside():
    seen = OBSERVATIONS[0]
    plain, filter = mpfjax.independent_particle_filters, mpfjax.clustered_particle_filter
    start = plain(APART, 50).init(KEY)
    expected, info = plain(APART, 50).step(KEY, start, seen)
    apart = filter(APART, 50)
    mixture, own = apart.step(KEY, apart.init(KEY), seen)
    np.testing.assert_allclose(own.log_likelihood_increment, info.log_likelihood_increment)
    rows = np.asarray(mixture.particles)
    # Two programs: some versions of XLA round their sums differently.
    np.testing.assert_allclose(
        np.sort(rows, axis=0), np.sort(expected.particles, axis=0), rtol=1e-5, atol=1e-6
    )
    assert not np.array_equal(rows, expected.particles)
    assert labels_of(mixture).tolist() == [0, 1, 2]


@pytest.mark.thorough
def test_what_one_object_is_shown_costs_another_no_hypotheses():
    """Three objects in one cluster, the second of them seen sharply."""
    sharp = MultiObjectModel(stack([walker(0.0), walker(1.0, 1e-4), walker(-1.0)]), 3)
    counts = []
    for filter in (
        mpfjax.clustered_particle_filter(sharp, 100, start="together"),
        mpfjax.partitioned_sampling(sharp, 100),
    ):
        mixture, _ = filter.step(KEY, filter.init(KEY), OBSERVATIONS[0])
        counts.append(len(np.unique(mixture.particles[:, 0])))
    crossing, partitioned = counts
    assert crossing > 30
    assert partitioned < 15


def placed(model, places, filter):
    """The filter's x_0 with every object of every particle at a place of its own."""
    mixture = filter.init(KEY)
    states = jnp.asarray(places)[None] + 0.01 * mixture.particles[:, :, 0]
    return mixture.replace(particles=states[:, :, None])


class Still(mpfjax.LinearGaussianModel):
    """An object that hardly moves and is hardly seen."""

    def __init__(self):
        one = jnp.eye(1)
        super().__init__(one, 1e-4 * one, one, 100.0 * one, jnp.zeros(1), one)


STILL = MultiObjectModel(Still(), 4, PairwiseRepulsion(2.0, 1.0), per_object=False)
NOTHING = jnp.zeros((4, 1))


class TestClusters:
    def test_who_touches_merges_and_stays(self):
        """Object 2 touches 0 and 3, which do not touch each other."""
        filter = mpfjax.clustered_particle_filter(STILL, 30)
        mixture = placed(STILL, [0.0, 9.0, 0.8, 1.6], filter)
        mixture, info = filter.step(KEY, mixture, NOTHING)
        assert labels_of(mixture).tolist() == [0, 1, 0, 0]
        assert np.isfinite(info.log_likelihood_increment)
        apart = mixture.replace(particles=mixture.particles + 5.0 * jnp.arange(4.0)[None, :, None])
        apart, _ = filter.step(KEY, apart, NOTHING)
        assert labels_of(apart).tolist() == [0, 1, 0, 0]
        predicted, _ = filter.predict(KEY, apart)
        assert labels_of(predicted).tolist() == [0, 1, 0, 0]

    def test_who_stays_apart_for_long_enough_is_split_where_asked(self):
        filter = mpfjax.clustered_particle_filter(STILL, 30, split_after=2)
        assert filter.approximate
        mixture = placed(STILL, [0.0, 9.0, 0.8, 1.6], filter)
        mixture, _ = filter.step(KEY, mixture, NOTHING)
        assert labels_of(mixture).tolist() == [0, 1, 0, 0]
        shift = jnp.array([0.0, 0.0, 0.0, 5.0])[None, :, None]
        mixture = mixture.replace(particles=mixture.particles + shift)
        seen = []
        for _ in range(3):
            mixture, _ = filter.step(KEY, mixture, NOTHING)
            seen.append(labels_of(mixture).tolist())
        assert seen == [[0, 1, 0, 0], [0, 1, 0, 3], [0, 1, 0, 3]]

    def test_what_cannot_be_leaves_the_particles_to_their_dynamics(self):
        """A pair that excludes each other altogether, on one spot."""

        def never(states, others):
            return jnp.where(jnp.abs(states - others)[:, 0] < 1.0, -jnp.inf, 0.0)

        model = MultiObjectModel(Still(), 2, never, per_object=False)
        filter = mpfjax.clustered_particle_filter(model, 20)
        before = placed(model, [0.0, 0.0], filter)
        after, info = filter.step(KEY, before, NOTHING[:2])
        assert bool(info.degenerate)
        assert labels_of(after).tolist() == [0, 1]
        np.testing.assert_allclose(after.particles, before.particles, atol=0.1)


@pytest.mark.thorough
def test_gradient_is_finite_through_meeting_objects():
    filter = mpfjax.clustered_particle_filter(PAIR, 20, start="together")

    @eqx.filter_jit
    @eqx.filter_grad
    def slope(filter):
        return mpfjax.run_filter(KEY, filter, OBSERVATIONS[:2, :2]).log_marginal_likelihood

    gradient = slope(filter)
    chex.assert_tree_all_finite(gradient)
    assert float(gradient.model.interaction.strength) != 0


@pytest.mark.usefixtures("as_installed")
def test_bad_input():
    named = mpfjax.clustered_particle_filter
    with pytest.raises(ValueError, match="start: 'anywhere' is not one of"):
        named(APART, 10, start="anywhere")
    with pytest.raises(ValueError, match="split_after: 0 is not a whole"):
        named(APART, 10, split_after=0)
    with pytest.raises(ValueError, match="scheme: 'optimal'"):
        named(APART, 10, scheme="optimal")
    with pytest.raises(ValueError, match=r"(?s)model: LinearGaussianModel.*is not a MultiObject"):
        named(walker(), 10)

    class WithoutDensity(mpfjax.AbstractStateSpaceModel):
        sample_initial = Momentum.sample_initial
        sample_transition = Momentum.sample_transition
        log_likelihood = Momentum.log_likelihood
        expected = Momentum.expected

    blind = MultiObjectModel(WithoutDensity(), 2, PairwiseRepulsion(1.0, 1.0))
    with pytest.raises(ValueError, match="WithoutDensity defines no log_transition"):
        named(blind, 10)
    named(MultiObjectModel(WithoutDensity(), 2), 10)
    mixture = mpfjax.distributed_partitioned_sampling(APART, 20).init(KEY)
    with pytest.raises(ValueError, match="mixture: 3 components, not one"):
        PropagateInClusters(APART)(KEY, mixture, OBSERVATIONS[0])
