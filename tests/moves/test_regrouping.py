"""K-means, merging, splitting and the other groups, on mixtures made by hand."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax import (
    Exclusion,
    Filter,
    GroupBy,
    KMeans,
    Merge,
    Pool,
    Propagate,
    Prune,
    QuadraticModel,
    RandomPartition,
    Resample,
    Split,
)
from tests.examples import AT_START, make_mixture

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
    return np.asarray(eqx.filter_jit(move)(KEY, mixture, AT_START).component_indicators)


class TestKMeans:
    @pytest.mark.parametrize(("living", "m"), [(3, 3), (5, 6), (37, 40)])
    def test_equals_lloyds_algorithm(self, living, m):
        """Whatever the weights; empty slots pull no centroid, and the dead stay dead."""
        states, start = RNG.normal(size=(200, 3)), RNG.integers(0, living, 200)
        empty = RNG.random(200) < 0.2
        states[empty] *= 1000
        log_weights = np.where(empty, -np.inf, 5 * RNG.normal(size=200))
        mixture = make_mixture(states, log_weights, start, m)
        expected = lloyd(states[~empty], start[~empty], m, 4)
        np.testing.assert_array_equal(labels_after(KMeans(4), mixture)[~empty], expected)

    def test_reseeding_finds_clouds_that_share_a_label(self):
        mixture = clouds([[0, 0], [20, 0], [0, 20]], [15, 30, 45], num_components=3)
        mixture = mixture.replace(component_indicators=jnp.zeros(90, jnp.int32))
        found = labels_after(KMeans(10, reseed=True), mixture)
        groups = [set(found[:15]), set(found[15:45]), set(found[45:])]
        assert all(len(group) == 1 for group in groups)
        assert len(set.union(*groups)) == 3

    def test_features_and_scale_decide_what_is_near(self):
        states = np.array([[0.0, 0.0], [0.0, 10.0], [1.0, 0.0], [1.0, 10.0]])
        mixture = make_mixture(states, np.zeros(4), [0, 0, 0, 1], 2)
        by_second = KMeans(5, features=lambda states: states[:, 1])
        np.testing.assert_array_equal(labels_after(by_second, mixture), [0, 1, 0, 1])
        by_first = KMeans(5, scale=(0.01, 100.0))
        np.testing.assert_array_equal(labels_after(by_first, mixture), [0, 0, 1, 1])


def lloyd(states, labels, num_components, iterations):
    """The textbook's: centroids of the groups, then each point to the nearest."""
    for _ in range(iterations):
        distances = np.full((len(states), num_components), np.inf)
        for m in set(labels):
            distances[:, m] = ((states - states[labels == m].mean(axis=0)) ** 2).sum(axis=1)
        labels = distances.argmin(axis=1)
    return labels


def two_at(gap):
    return make_mixture(np.array([[0.0, 0.0], [gap, 0.0]]), np.zeros(2), [0, 1], 2)


def of_weights(*weights):
    return make_mixture(np.array([0.0, 10, 10, 0]), np.log(weights), [0, 0, 1, 1], 2)


WITHIN_ONE = Merge(None, max_distance=1.0)
BY_DISTANCE = Merge(None, max_distance=1.0, scale=(3.0, 1.0))
MERGED = {
    "overlap": (Merge(1.0), clouds([[0, 0], [0.2, 0], [10, 0], [10, 8]], [40] * 4), [0, 0, 2, 3]),
    "chain": (Merge(2.0), clouds([[3.0], [1.5], [0.0], [40.0]], [200] * 4), [0, 0, 0, 3]),
    "within two deviations": (Merge(2.0), clouds([[0.0], [1.8]], [4000] * 2), [0, 0]),
    "beyond two deviations": (Merge(2.0), clouds([[0.0], [2.2]], [4000] * 2), [0, 1]),
    "within a distance": (BY_DISTANCE, two_at(2.7), [0, 0]),
    "beyond a distance": (BY_DISTANCE, two_at(3.3), [0, 1]),
    "both conditions": (
        Merge(2.0, max_distance=1.0),
        clouds([[0.0], [3.0]], [50] * 2, scale=10.0),
        [0, 1],
    ),
    "weighted": (WITHIN_ONE, of_weights(0.999, 0.001, 0.001, 0.999), [0, 0]),
    "weighted apart": (WITHIN_ONE, of_weights(0.999, 0.001, 0.999, 0.001), [0, 1]),
}


class TestMerge:
    @pytest.mark.parametrize("case", MERGED)
    def test_what_overlaps_becomes_one_with_the_lowest_label(self, case):
        move, mixture, expected = MERGED[case]
        found = labels_after(move, mixture).reshape(len(expected), -1)
        np.testing.assert_array_equal(found, np.tile(expected, (found.shape[1], 1)).T)

    def test_patience_counts_steps_in_a_row(self):
        near, far = clouds([[0.0], [0.1]], [30, 30]), clouds([[0.0], [50.0]], [30, 30])
        merge = Merge(2.0, patience=3)
        memory = merge.initial_memory(mpfjax.Step(MODEL, None), 6)
        merged = []
        for mixture in (near, near, far, near, near, near, near):
            moved = eqx.filter_jit(merge)(KEY, mixture.replace(memory=memory), AT_START)
            memory = moved.memory
            merged.append(int(moved.component_indicators[-1]) == 0)
        # After a merge both labels start a count of their own.
        assert merged == [False, False, False, False, False, True, False]


class TestSplit:
    def one(self, states, num_components=4, log_weights=None):
        states = np.asarray(states, float)
        log_weights = np.zeros(len(states)) if log_weights is None else log_weights
        return make_mixture(states, log_weights, np.zeros(len(states)), num_components)

    @pytest.mark.exactness
    def test_a_diffuse_component_splits_at_the_gap(self):
        states = np.concatenate([RNG.normal(size=70), 12 + RNG.normal(size=30)])
        found = labels_after(Split(), self.one(states[:, None]))
        # The lighter part takes the free label.
        np.testing.assert_array_equal(found, np.repeat([0, 1], [70, 30]))

    @pytest.mark.exactness
    def test_a_gaussian_a_uniform_and_a_point_do_not_split(self):
        for states in (RNG.normal(size=(500, 1)), RNG.random((500, 1)), np.ones((500, 1))):
            assert (labels_after(Split(), self.one(states)) == 0).all()

    @pytest.mark.parametrize(
        ("move", "splits"),
        [
            (Split(4.0, min_distance=2.0, scale=5.0), True),
            (Split(4.0, min_distance=3.0, scale=5.0), False),
            (Split(min_share=0.05), True),
            (Split(min_share=0.2), False),
        ],
    )
    def test_the_halves_must_be_min_distance_apart_and_hold_min_share_of_the_mass(
        self, move, splits
    ):
        states = np.concatenate([RNG.normal(size=50), 12 + RNG.normal(size=50)])[:, None]
        mixture = self.one(states, log_weights=np.log(np.repeat([0.9, 0.1], 50) / 50))
        assert labels_after(move, mixture).max() == splits

    @pytest.mark.exactness
    def test_there_are_never_more_than_m_components_and_the_clearest_splits(self):
        parts = [RNG.normal(size=40) + centre for centre in (0, 12, 200, 260)]
        states = np.concatenate(parts)[:, None]
        mixture = make_mixture(states, np.zeros(160), np.repeat([0, 1], 80), 3)
        found = labels_after(Split(), mixture)
        assert (found[:80] == 0).all()
        assert set(found[80:]) == {1, 2}
        full = mixture.replace(num_components=2)
        np.testing.assert_array_equal(labels_after(Split(), full), np.repeat([0, 1], 80))
        assert list(np.asarray(Split().is_diffuse(full))) == [True, True]
        free = labels_after(Split(), mixture.replace(num_components=4)).reshape(4, 40)
        assert (free == free[:, :1]).all()
        assert len(np.unique(free)) == 4

    @pytest.mark.exactness
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


class TestPoolAndRandomPartition:
    MIXTURE = clouds([[0, 0], [5, 5]], [10, 13])
    PAIR = MIXTURE.replace(num_components=2)
    SIZES = (4, 4, 4, 4, 4, 3)

    def test_pool_puts_everything_into_one_component(self):
        assert (labels_after(Pool(), self.MIXTURE) == 0).all()

    @pytest.mark.parametrize(("mixture", "sizes"), [(MIXTURE, SIZES), (PAIR, [12, 11])])
    def test_sets_are_of_equal_size_and_without_replacement(self, mixture, sizes):
        labels = labels_after(RandomPartition(), mixture)
        assert np.bincount(labels).tolist() == [*sizes]

    def test_filled_slots_are_dealt_before_empty_ones(self):
        log_weights = np.where(np.arange(30) % 3 == 0, 0.0, -np.inf)
        mixture = make_mixture(np.zeros(30), log_weights, np.zeros(30), 5)
        labels = labels_after(RandomPartition(), mixture)
        assert np.bincount(labels[::3]).tolist() == [2] * 5

    def test_every_particle_comes_into_every_set_equally_often(self):
        move = RandomPartition()
        draw = jax.jit(jax.vmap(lambda key: move(key, self.PAIR, AT_START).component_indicators))
        labels = np.asarray(draw(jax.random.split(KEY, 4000)))
        assert np.abs(labels.mean(axis=0) - 11 / 23).max() < 4.5 * 0.5 / np.sqrt(4000)
        together = np.mean(labels[:, :1] == labels[:, 1:], axis=0)
        expected = (12 * 11 + 11 * 10) / (23 * 22)
        assert np.abs(together - expected).max() < 4.5 * 0.5 / np.sqrt(4000)


def side(states):
    return (states > 0).astype(jnp.int32)


MODEL = QuadraticModel(0.3, 0.5, -2.0, 2.0)


class TestGroupBy:
    @pytest.mark.exactness
    @pytest.mark.parametrize("label", [-1, 2])
    def test_a_label_outside_is_a_named_error_unless_its_slot_is_empty(self, label):
        labels = np.array([0, label, 0], np.int32)
        group = GroupBy(lambda states: jnp.asarray(labels) + 0 * states.astype(jnp.int32))
        weightless = make_mixture(np.zeros(3), [0.0, -np.inf, 0.0], [0, 0, 0], 2)
        assert int(group(KEY, weightless, AT_START).component_indicators.max()) < 2
        weighed = make_mixture(np.zeros(3), np.zeros(3), [0, 0, 0], 2)
        assert np.isnan(group(KEY, weighed, AT_START).log_scale)
        moves = [Resample(), Propagate(), GroupBy(lambda states: 2 * side(states))]
        with pytest.raises(RuntimeError, match="GroupBy"):
            mpfjax.run_filter(KEY, Filter(MODEL, moves, 20, 2), jnp.ones(3))

    @pytest.mark.exactness
    @pytest.mark.parametrize("label", [side, lambda states: states > 0])
    def test_each_label_keeps_its_particles_however_improbable_it_is(self, label):
        """Observations of x² say nothing of the sign; a plain filter of 20 loses one."""
        moves = [Resample(), Propagate(), GroupBy(label)]
        kept = Filter(MODEL, moves, 20, 2, initial_moves=[GroupBy(label)])
        run = mpfjax.run_filter(KEY, kept, jnp.full(100, 3.0), lambda m: m.component_counts)
        assert int(run.collected.min()) == 10
        assert kept.step(KEY, run.final, 3.0)[1].labels_ran_out


@pytest.mark.parametrize("masses", [(0.6, 0.1, 0.2, 0.0999, 1e-4, 1e-6), (1,)])
def test_only_what_is_below_the_share_of_the_heaviest_is_pruned(masses):
    log_weights = np.repeat(np.log(np.array(masses) / 3), 3)
    before = make_mixture(np.zeros(len(masses) * 3), log_weights,
                          np.repeat(np.arange(len(masses)), 3), len(masses))  # fmt: skip
    after, lives = Prune(1e-3)(KEY, before, AT_START), np.array(masses) >= 1e-3 * max(masses)
    np.testing.assert_array_equal(after.active, lives)
    kept = lives[np.asarray(before.component_indicators)]
    np.testing.assert_array_equal(after.log_weights[kept], before.log_weights[kept])
    assert Prune().approximate
    assert Prune(1e-3)(KEY, before, mpfjax.Step(MODEL, None)) is before


def second(states):
    return states[:, 1].astype(np.int32)


@pytest.mark.parametrize(
    ("group", "objects", "shares"),
    [(None, [0, 1, 2], [1, 1, 1]), (second, [0, 0, 1], [0.8, 0.2, 1])],
)
def test_particles_are_weighed_down_by_the_means_of_others(group, objects, shares):
    """Of components at 1, 50 and 5; in groups not by hypotheses about their own object."""
    places, labels = np.array([0.0, 2.0, 50.0, 4.0, 6.0, 7.0]), np.array([0, 0, 1, 2, 2, 2])
    log_weights = np.append(np.log([0.2, 0.2, 0.1, 0.3, 0.2]), -np.inf)
    mixture = make_mixture(np.stack([places, labels == 2], axis=1), log_weights, labels, 4)
    move = Exclusion(
        strength=2.0, radius=0.5, scale=(10.0,), features=lambda states: states[:, :1], group=group
    )
    moved = eqx.filter_jit(move)(KEY, mixture, mpfjax.Step(MODEL, jnp.float32(0.0)))
    bumps = np.exp(-(((places[:, None] - [1.0, 50.0, 5.0]) / 10) ** 2) / (2 * 0.5**2))
    of_others = np.array(objects)[labels][:, None] != objects
    expected = 2 * np.sum(bumps * of_others * shares, axis=1)
    lowered = np.asarray(mixture.log_weights - moved.log_weights)
    np.testing.assert_allclose(lowered[:5], expected[:5], atol=1e-5)
    assert moved.log_weights[5] == -np.inf
    np.testing.assert_array_equal(moved.particles, mixture.particles)


def test_pruning_compares_within_a_group_only():
    states = np.array([[0.0], [0.0], [0.0], [1.0]])
    mixture = make_mixture(states, np.log([0.5, 5e-4, 4e-3, 1e-4]), [0, 1, 2, 3], 4)
    prune = Prune(least_share=2e-3, group=lambda states: states[:, 0].astype(np.int32))
    moved = prune(KEY, mixture, mpfjax.Step(MODEL, jnp.float32(0.0)))
    assert moved.active.tolist() == [True, False, True, True]
