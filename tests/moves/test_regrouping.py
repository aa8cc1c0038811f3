"""K-means, merging and splitting on clouds made by hand."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mpfjax import Filter, KMeans, Merge, Pool, QuadraticModel, RandomPartition, Split
from mpfjax.moves.regrouping.features import summarise, summarise_about
from mpfjax.moves.regrouping.kmeans import farthest_first
from mpfjax.moves.regrouping.merge import lowest_connected
from mpfjax.moves.regrouping.split import free_labels
from tests.examples import make_mixture

KEY = jax.random.key(0)
RNG = np.random.default_rng(0)


def clouds(centres, sizes, scale=1.0, num_components=6, weights=None, labels=None):
    """Gaussian clouds around the centres, each its own component."""
    own = np.repeat(np.arange(len(sizes)), sizes)
    centres = np.asarray(centres, float)
    spread = np.broadcast_to(scale, len(sizes))[own]
    states = centres[own] + spread[:, None] * RNG.normal(size=(len(own), centres.shape[1]))
    log_weights = np.zeros(len(own)) if weights is None else np.log(weights)[own]
    return make_mixture(states, log_weights, own if labels is None else labels, num_components)


def labels_after(move, mixture):
    return np.asarray(eqx.filter_jit(move)(KEY, mixture).component_indicators)


class TestKMeans:
    def test_equals_lloyds_algorithm(self):
        states = RNG.normal(size=(200, 3))
        start = RNG.integers(0, 5, 200)
        mixture = make_mixture(states, RNG.normal(size=200), start, 6)
        for iterations in (1, 4):
            expected = lloyd(states, start, 6, iterations)
            found = labels_after(KMeans(iterations), mixture)
            np.testing.assert_array_equal(found, expected)

    def test_empty_slots_pull_no_centroid(self):
        states = np.array([[100.0], [101.0], [1000.0], [110.0], [111.0], [-1000.0]])
        log_weights = np.array([0, 0, -np.inf, 0, 0, -np.inf])
        mixture = make_mixture(states, log_weights, [0, 1, 0, 1, 1, 1], 3)
        found = labels_after(KMeans(5), mixture)
        np.testing.assert_array_equal(found[[0, 1, 3, 4]], [0, 0, 1, 1])

    def test_a_dead_component_stays_dead(self):
        mixture = clouds([[0, 0], [9, 9]], [20, 20])
        moved = eqx.filter_jit(KMeans())(KEY, mixture)
        np.testing.assert_array_equal(moved.active, [True, True, False, False, False, False])

    def test_weights_play_no_part(self):
        states, start = RNG.normal(size=(60, 2)), RNG.integers(0, 3, 60)
        light = make_mixture(states, np.zeros(60), start, 3)
        heavy = make_mixture(states, 5 * RNG.normal(size=60), start, 3)
        np.testing.assert_array_equal(labels_after(KMeans(), light), labels_after(KMeans(), heavy))

    def test_reseeding_finds_clouds_that_share_a_label(self):
        mixture = clouds([[0, 0], [20, 0], [0, 20]], [15, 30, 45], num_components=3)
        mixture = mixture.replace(component_indicators=jnp.zeros(90, jnp.int32))
        found = labels_after(KMeans(10, reseed=True), mixture)
        groups = [set(found[:15]), set(found[15:45]), set(found[45:])]
        assert all(len(group) == 1 for group in groups)
        assert len(set.union(*groups)) == 3

    def test_features_and_scale_decide_what_is_near(self):
        states = np.array([[0.0, 0.0], [0.0, 10.0], [1.0, 0.0], [1.0, 10.0]])
        mixture = make_mixture(states, np.zeros(4), [0, 0, 1, 1], 2)
        np.testing.assert_array_equal(labels_after(KMeans(1), mixture), [0, 0, 1, 1])
        mixture = make_mixture(states, np.zeros(4), [0, 1, 0, 1], 2)
        apart = KMeans(5, scale=(0.01, 100.0))
        # In these units the first coordinate is all that matters, though the labels differ in the
        # second; on the second alone nothing changes.
        by_second = KMeans(5, features=lambda states: states[:, 1])
        np.testing.assert_array_equal(labels_after(by_second, mixture), [0, 1, 0, 1])
        tilted = make_mixture(states, np.zeros(4), [0, 0, 0, 1], 2)
        assert labels_after(apart, tilted)[2] == 1
        assert labels_after(apart, tilted)[1] == 0

    def test_farthest_first_starts_far_out_and_spreads(self):
        points = jnp.array([[0.0], [1.0], [2.0], [10.0], [-50.0]])
        occupied = jnp.array([True, True, True, True, False])
        seeds = farthest_first(points, occupied, 3)
        np.testing.assert_array_equal(seeds.ravel(), [10.0, 0.0, 2.0])


def lloyd(states, labels, num_components, iterations):
    """The textbook's: centroids of the groups, then each point to the nearest."""
    for _ in range(iterations):
        distances = np.full((len(states), num_components), np.inf)
        for m in set(labels):
            distances[:, m] = ((states - states[labels == m].mean(axis=0)) ** 2).sum(axis=1)
        labels = distances.argmin(axis=1)
    return labels


class TestMerge:
    def test_clouds_that_overlap_merge_and_those_apart_do_not(self):
        mixture = clouds([[0, 0], [0.2, 0], [10, 0], [10, 8]], [40, 40, 40, 40])
        found = labels_after(Merge(1.0), mixture)
        np.testing.assert_array_equal(found, np.repeat([0, 0, 2, 3], 40))

    @pytest.mark.parametrize(("gap", "merges"), [(1.8, True), (2.2, False)])
    def test_the_border_is_max_deviations_pooled_deviations(self, gap, merges):
        mixture = clouds([[0.0], [gap]], [4000, 4000])
        assert (labels_after(Merge(2.0), mixture)[-1] == 0) == merges

    @pytest.mark.parametrize(("gap", "merges"), [(0.9, True), (1.1, False)])
    def test_the_border_is_max_distance_in_units_of_scale(self, gap, merges):
        states = np.array([[0.0, 0.0], [3.0 * gap, 0.0]])
        mixture = make_mixture(states, np.zeros(2), [0, 1], 2)
        merged = Merge(None, 1.0, scale=(3.0, 1.0))
        assert (labels_after(merged, mixture)[1] == 0) == merges

    def test_both_conditions_must_hold_where_both_are_given(self):
        mixture = clouds([[0.0], [3.0]], [50, 50], scale=10.0)
        assert labels_after(Merge(2.0), mixture)[-1] == 0
        assert labels_after(Merge(2.0, 1.0), mixture)[-1] == 1

    def test_chains_of_overlap_become_one_with_the_lowest_label(self):
        mixture = clouds([[3.0], [1.5], [0.0], [40.0]], [200] * 4)
        found = labels_after(Merge(2.0), mixture)
        np.testing.assert_array_equal(found, np.repeat([0, 0, 0, 3], 200))

    def test_means_are_weighted(self):
        states = np.array([[0.0], [10.0], [10.0], [0.0]])
        log_weights = np.log([0.999, 0.001, 0.001, 0.999])
        mixture = make_mixture(states, log_weights, [0, 0, 1, 1], 2)
        assert labels_after(Merge(None, 1.0), mixture)[-1] == 0

    def test_dead_components_merge_with_nothing(self):
        mixture = clouds([[0.0], [30.0]], [20, 20], labels=np.repeat([2, 4], 20))
        np.testing.assert_array_equal(labels_after(Merge(), mixture), np.repeat([2, 4], 20))

    def test_patience_counts_steps_in_a_row(self):
        near, far = clouds([[0.0], [0.1]], [30, 30]), clouds([[0.0], [50.0]], [30, 30])
        merge = Merge(2.0, patience=3)
        memory = merge.initial_memory(6)
        merged = []
        for mixture in (near, near, far, near, near, near, near):
            moved = eqx.filter_jit(merge)(KEY, mixture.replace(memory=memory))
            memory = merge.forget(moved.memory, ~moved.active)
            merged.append(int(moved.component_indicators[-1]) == 0)
        # After a merge both labels start a count of their own.
        assert merged == [False, False, False, False, False, True, False]

    def test_a_label_that_is_taken_again_has_no_past(self):
        """A label that Merge frees and Split takes in the same step starts its counts anew."""
        merge = Merge(None, 0.7, patience=3)
        near = np.linspace(-0.25, 0.75, 40)  # the halves' means are 0.5 apart
        states = np.concatenate([near, np.full(10, -10), np.full(10, 12)])
        mixture = make_mixture(states[:, None], np.zeros(60), np.repeat([0, 1, 2], 20), 3)
        # 0 and 1 overlap for the third time, 1 and 2, whose mean lies at 1, for the second.
        durations = jnp.array([[0, 2, 0], [2, 0, 1], [0, 1, 0]], jnp.int32)
        mixture = mixture.replace(memory={"overlap_durations": durations})
        seen = lambda key, mixture, observation: mixture  # noqa: E731
        filter = Filter(QuadraticModel(), [merge, Split(), seen], 60, 3)
        moved, _ = eqx.filter_jit(filter._step)(KEY, mixture, jnp.zeros(()))
        labels = np.asarray(moved.component_indicators)
        assert set(labels[:40]) == {0}
        assert set(labels[40:]) == {1, 2}
        durations = np.asarray(moved.memory["overlap_durations"])
        assert (durations[1] == 0).all()
        assert (durations[:, 1] == 0).all()

    def test_connected_components_of_a_graph(self):
        adjacent = np.zeros((7, 7), bool)
        for i, j in ((6, 5), (5, 4), (4, 3), (1, 2)):
            adjacent[i, j] = adjacent[j, i] = True
        np.testing.assert_array_equal(
            lowest_connected(jnp.asarray(adjacent)), [0, 1, 1, 3, 3, 3, 3]
        )


class TestSplit:
    def one(self, states, num_components=4, log_weights=None):
        states = np.asarray(states, float)
        log_weights = np.zeros(len(states)) if log_weights is None else log_weights
        return make_mixture(states, log_weights, np.zeros(len(states)), num_components)

    def test_a_diffuse_component_splits_at_the_gap(self):
        states = np.concatenate([RNG.normal(size=70), 12 + RNG.normal(size=30)])
        found = labels_after(Split(), self.one(states[:, None]))
        # The lighter part takes the free label.
        np.testing.assert_array_equal(found, np.repeat([0, 1], [70, 30]))

    @pytest.mark.parametrize("seed", range(5))
    def test_a_gaussian_and_a_uniform_do_not_split(self, seed):
        rng = np.random.default_rng(seed)
        for states in (rng.normal(size=(500, 1)), rng.random((500, 1)), rng.normal(size=(500, 3))):
            assert (labels_after(Split(), self.one(states)) == 0).all()

    def test_the_halves_must_be_min_distance_apart_in_units_of_scale(self):
        states = np.concatenate([RNG.normal(size=50), 12 + RNG.normal(size=50)])[:, None]
        assert labels_after(Split(4.0, 2.0, scale=5.0), self.one(states)).max() == 1
        assert labels_after(Split(4.0, 3.0, scale=5.0), self.one(states)).max() == 0

    def test_the_lighter_half_must_hold_min_share_of_the_mass(self):
        states = np.concatenate([RNG.normal(size=50), 12 + RNG.normal(size=50)])[:, None]
        log_weights = np.log(np.repeat([0.9, 0.1], 50))
        mixture = self.one(states, log_weights=log_weights)
        assert labels_after(Split(min_share=0.05), mixture).max() == 1
        assert labels_after(Split(min_share=0.2), mixture).max() == 0

    def test_there_are_never_more_than_m_components_and_the_clearest_splits(self):
        parts = [RNG.normal(size=40) + centre for centre in (0, 12, 200, 260)]
        states = np.concatenate(parts)[:, None]
        mixture = make_mixture(states, np.zeros(160), np.repeat([0, 1], 80), 3)
        found = labels_after(Split(), mixture)
        assert (found[:80] == 0).all()
        assert set(found[80:]) == {1, 2}
        full = mixture.replace(num_components=2)
        np.testing.assert_array_equal(labels_after(Split(), full), np.repeat([0, 1], 80))

    @pytest.mark.thorough
    def test_more_modes_than_labels_share_them_without_losing_mass(self):
        """Three clouds and two labels: one is full of two, which `is_diffuse` tells."""
        modes = np.repeat([0, 1, 1], 40)
        states = np.repeat([0.0, 20.0, 40.0], 40) + RNG.normal(size=120)
        mixture = make_mixture(states[:, None], RNG.normal(size=120), modes, 2)
        found = eqx.filter_jit(Split())(KEY, mixture)
        np.testing.assert_array_equal(found.log_weights, mixture.log_weights)
        np.testing.assert_array_equal(found.component_indicators, modes)
        assert list(np.asarray(Split().is_diffuse(mixture))) == [False, True]
        # With a label more, the second cloud of the two has one of its own.
        free = eqx.filter_jit(Split())(KEY, mixture.replace(num_components=3))
        assert len(np.unique(free.component_indicators)) == 3

    def test_two_splits_at_once_take_different_labels(self):
        parts = [RNG.normal(size=40) + centre for centre in (0, 12, 200, 260)]
        mixture = make_mixture(
            np.concatenate(parts)[:, None], np.zeros(160), np.repeat([1, 3], 80), 6
        )
        found = labels_after(Split(), mixture)
        groups = [set(found[40 * i : 40 * i + 40]) for i in range(4)]
        assert all(len(group) == 1 for group in groups)
        assert len(set.union(*groups)) == 4

    @pytest.mark.parametrize("room", [None, 3000, 40])
    def test_a_sample_finds_the_halves_that_all_particles_show(self, room):
        """Copies stand side by side; a part of one in 20 of a component is in a sample of 32."""
        whole = 4000 if room is None else room
        sizes = [whole // 2, whole // 20, whole // 4, whole // 5]
        centres = np.repeat([0.0, 12.0, 200.0, 260.0], sizes)
        parent = np.repeat([0, 0, 1, 1], sizes)
        log_weights = np.zeros(4000)
        log_weights[len(centres) :] = -np.inf
        empty = 4000 - len(centres)
        states = np.pad(centres, (0, empty)) + RNG.normal(size=4000)
        mixture = make_mixture(states[:, None], log_weights, np.pad(parent, (0, empty)), 5)
        if room is not None:
            mixture = mixture.replace(usable_slots=jnp.asarray(len(centres)))
        filled = np.asarray(mixture.occupied)
        by_sample, by_all = (
            labels_after(Split(min_share=0.01, sample_size=size), mixture)[filled]
            for size in (32, None)
        )
        np.testing.assert_array_equal(by_sample, by_all)
        assert len(np.unique(by_all)) == 4

    def test_a_sample_is_spread_over_all_usable_slots(self):
        """Of 100 slots where 2 * 32 are enough, every second is taken, not the first 64."""
        states = np.concatenate([np.zeros(66), np.full(34, 9.0), np.zeros(900)])
        log_weights = np.where(np.arange(1000) < 100, 0.0, -np.inf)
        mixture = make_mixture(states[:, None], log_weights, np.zeros(1000), 2)
        mixture = mixture.replace(usable_slots=jnp.asarray(100))
        np.testing.assert_array_equal(labels_after(Split(), mixture)[:100], states[:100] == 9)

    def test_two_points_split_and_one_does_not(self):
        assert labels_after(Split(), self.one([[0.0], [0.0], [5.0], [5.0]])).max() == 1
        assert labels_after(Split(), self.one([[5.0]] * 4)).max() == 0

    def test_free_labels_go_to_the_highest_priority(self):
        found = free_labels(
            jnp.array([True, False, True, True, False]),
            jnp.array([1.0, 9.0, 3.0, 2.0, 0.0]),
            jnp.array([True, False, True, True, False]),
        )
        np.testing.assert_array_equal(found, [0, 1, 1, 4, 4])


class TestPoolAndRandomPartition:
    MIXTURE = clouds([[0, 0], [5, 5]], [10, 13])

    def test_pool_puts_everything_into_one_component(self):
        assert (labels_after(Pool(), self.MIXTURE) == 0).all()

    @pytest.mark.parametrize(("num_sets", "sizes"), [(None, [4, 4, 4, 4, 4, 3]), (2, [12, 11])])
    def test_sets_are_of_equal_size_and_without_replacement(self, num_sets, sizes):
        labels = labels_after(RandomPartition(num_sets), self.MIXTURE)
        assert np.bincount(labels).tolist() == sizes

    def test_filled_slots_are_dealt_before_empty_ones(self):
        log_weights = np.where(np.arange(30) % 3 == 0, 0.0, -np.inf)
        mixture = make_mixture(np.zeros(30), log_weights, np.zeros(30), 5)
        labels = labels_after(RandomPartition(), mixture)
        assert np.bincount(labels[::3]).tolist() == [2] * 5

    def test_every_particle_comes_into_every_set_equally_often(self):
        move = RandomPartition(2)
        draw = jax.jit(jax.vmap(lambda key: move(key, self.MIXTURE).component_indicators))
        labels = np.asarray(draw(jax.random.split(KEY, 4000)))
        share = labels.mean(axis=0)
        assert np.abs(share - 11 / 23).max() < 4.5 * 0.5 / np.sqrt(4000)
        together = np.mean(labels[:, :1] == labels[:, 1:], axis=0)
        expected = (12 * 11 + 11 * 10) / (23 * 22)
        assert np.abs(together - expected).max() < 4.5 * 0.5 / np.sqrt(4000)

    @pytest.mark.usefixtures("as_installed")
    def test_bad_input(self):
        with pytest.raises(ValueError, match="num_sets: 0 is not a whole"):
            RandomPartition(0)
        with pytest.raises(ValueError, match="num_sets: 7 is more than num_components, 6"):
            RandomPartition(7)(KEY, self.MIXTURE)


@pytest.mark.parametrize("num_groups", [3, 12])
@pytest.mark.parametrize("num_features", [1, 3, 10])
def test_moments_of_groups_equal_those_of_numpy(num_groups, num_features):
    features = RNG.normal(size=(300, num_features)) + 5
    weights = RNG.random(300) * (RNG.random(300) < 0.8)
    labels = RNG.integers(0, num_groups - 1, 300)  # the last group is empty
    points = 5 + RNG.normal(size=(num_groups, num_features))
    jitted = jnp.asarray(features), jnp.asarray(weights), jnp.asarray(labels)
    two_passes = eqx.filter_jit(summarise)(*jitted, num_groups)
    gaps = jnp.asarray(features - points[labels])
    one_pass = eqx.filter_jit(summarise_about)(jnp.asarray(points), gaps, *jitted[1:])
    for found in (two_passes, one_pass):
        for group in range(num_groups - 1):
            own = labels == group
            mass = weights[own].sum()
            mean = np.average(features[own], axis=0, weights=weights[own])
            covariance = np.cov(features[own].T, aweights=weights[own], ddof=0).reshape(
                num_features, num_features
            )
            np.testing.assert_allclose(found.masses[group], mass, rtol=1e-5)
            np.testing.assert_allclose(found.means[group], mean, rtol=1e-5)
            np.testing.assert_allclose(found.covariances[group], covariance, atol=1e-5)
        for empty in (found.masses[-1], found.means[-1], found.covariances[-1]):
            np.testing.assert_array_equal(empty, 0)
