"""Resampling at its edges; what every scheme must keep is in `test_contracts.py`."""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mpfjax import Resample
from mpfjax.moves.resampling.allocation import place_slots
from mpfjax.moves.resampling.ancestors import random_points
from mpfjax.operations import prefix_sums
from tests.examples import make_mixture
from tests.marking import quick_of, thorough

SCHEMES = ("systematic", "stratified", "multinomial", "residual", "ssp")
NEARLY_ONE = 1 - 2.0**-24

over_schemes = pytest.mark.parametrize("scheme", SCHEMES)


def offspring(mixture, moved):
    """How many slots each particle got, from filled slots only."""
    filled = np.asarray(moved.occupied)
    ancestors = np.asarray(moved.ancestor_indices)[filled]
    return np.bincount(ancestors, minlength=mixture.num_particles)


def assert_sound(mixture, moved):
    """No slot fed from a particle of zero weight, no border recombined, no mass moved."""
    weights = np.exp(np.asarray(mixture.log_component_weights))
    filled = np.asarray(moved.occupied)
    parents = np.asarray(moved.ancestor_indices)[filled]
    assert (weights[parents] > 0).all()
    labels = np.asarray(mixture.component_indicators)[parents]
    np.testing.assert_array_equal(np.asarray(moved.component_indicators)[filled], labels)
    # Thousands of equal shares in float32 add up to their whole but for rounding.
    np.testing.assert_allclose(
        moved.log_mixture_weights, mixture.log_mixture_weights, rtol=1e-5, atol=1e-3
    )


def large_mixture(kind, n, m, in_order=False):
    """Components mixed, or side by side, as after a resampling that nothing regrouped."""
    rng = np.random.default_rng(7)
    labels = rng.integers(0, m, n)
    if in_order:
        labels = np.sort(labels)
    log_weights = rng.normal(size=n)
    if kind == "empty slots":
        log_weights[rng.random(n) < 0.5] = -np.inf
    elif kind == "underflowing weights":
        log_weights[rng.random(n) < 0.5] -= 200.0
    elif kind == "masses 200 nats apart":
        log_weights -= 200.0 * labels
    elif kind == "dead components":
        log_weights[labels % 2 == 1] = -np.inf
    elif kind == "no weight at the ends":
        for label in range(m):
            members = np.flatnonzero(labels == label)
            log_weights[members[:3]] -= 200.0
            log_weights[members[-3:]] -= 200.0
    return make_mixture(rng.normal(size=n), log_weights, labels, m)


KINDS = (
    "random weights",
    "empty slots",
    "underflowing weights",
    "masses 200 nats apart",
    "dead components",
    "no weight at the ends",
)


def draw(move, mixture, seed=0):
    return redraw(move, jax.random.key(seed), mixture)


@eqx.filter_jit
def redraw(move, key, mixture):
    return move(key, mixture)


@eqx.filter_jit
def redraw_with(move, key, uniform, mixture):
    """The move with every uniform draw set to one value, unless that is NaN."""
    honest = jax.random.uniform

    def patched(key, shape=(), dtype=float, **options):
        drawn = honest(key, shape, dtype, **options)
        return jnp.where(jnp.isnan(uniform), drawn, uniform.astype(drawn.dtype))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(jax.random, "uniform", patched)
        return move(key, mixture)


class TestAtScale:
    """float32 has no room for a hundred thousand exact cumulative weights: guards must hold."""

    @pytest.mark.parametrize("scheme", quick_of(SCHEMES, ["systematic"]))
    @pytest.mark.parametrize("num_components", [9, *thorough([1])])
    def test_no_particle_of_zero_weight_is_ever_fed(self, scheme, num_components):
        """Not with random draws, nor with uniform draws at their ends."""
        for kind, in_order in itertools.product(KINDS, (False, True)):
            mixture = large_mixture(kind, 100_000, num_components, in_order)
            for seed, uniform in enumerate((np.nan, 0.0, NEARLY_ONE)):
                key, value = jax.random.key(seed), jnp.asarray(uniform, jnp.float32)
                assert_sound(mixture, redraw_with(Resample(scheme), key, value, mixture))

    def test_systematic_offspring_are_proportional_to_the_weights(self):
        mixture = large_mixture("random weights", 100_000, 4)
        counts = offspring(mixture, draw(Resample(), mixture, 0))
        expected = expected_offspring(mixture, 25_000)
        # The cumulative weights are off by up to their rounding, the counts by one more.
        assert np.abs(counts - expected).max() < 1.05
        halves = np.arange(100_000) < 50_000
        assert abs(counts[halves].sum() - expected[halves].sum()) < 10


def expected_offspring(mixture, per_component):
    return per_component * np.exp(np.asarray(mixture.log_component_weights, float))


@pytest.mark.parametrize("scheme", ["systematic", "ssp"])
@pytest.mark.parametrize("num_components", [1, 3, 6])
def test_offspring_are_the_floor_or_the_ceiling_of_what_is_expected(scheme, num_components):
    rng = np.random.default_rng(8)
    labels = rng.permutation(np.arange(60) % num_components)
    mixture = make_mixture(rng.normal(size=60), rng.normal(size=60), labels, num_components)
    expected = expected_offspring(mixture, 60 // num_components)
    for seed in range(50):
        counts = offspring(mixture, draw(Resample(scheme, allocation="equal"), mixture, seed))
        assert (counts >= np.floor(expected - 1e-4)).all()
        assert (counts <= np.ceil(expected + 1e-4)).all()


@pytest.mark.thorough
def test_who_stands_in_order_beside_a_run_that_does_not_is_resampled_alike():
    """Runs put their particles in order together; for one that has them so, nothing changes."""
    mixtures = [
        large_mixture("underflowing weights", 600, 5, in_order) for in_order in (True, False)
    ]
    key, resample = jax.random.key(4), Resample()
    together = jax.tree.map(lambda *leaves: jnp.stack(leaves), *mixtures)
    both = jax.jit(jax.vmap(resample, (None, 0)))(key, together)
    for index, mixture in enumerate(mixtures):
        found = jax.tree.map(lambda leaf: leaf[index], both)  # noqa: B023
        assert_sound(mixture, found)
        alone = draw(resample, mixture, 4)
        np.testing.assert_array_equal(found.ancestor_indices, alone.ancestor_indices)


class TestSSP:
    def test_two_neighbours_are_not_drawn_together_as_systematic_resampling_draws_them(self):
        """Four particles expect 0.5 each: a systematic draw has but two outcomes."""
        mixture = make_mixture(np.arange(8.0), np.log(np.tile([0.25, 0.75], 4)), np.zeros(8), 1)
        keys = jax.random.split(jax.random.key(0), 2000)
        outcomes = {}
        for scheme in ("systematic", "ssp"):
            moved = jax.jit(jax.vmap(lambda key: Resample(scheme)(key, mixture)))(keys)  # noqa: B023
            drawn = np.asarray(moved.ancestor_indices)
            counts = np.stack([(drawn == i).sum(axis=1) for i in range(8)], axis=1)
            outcomes[scheme] = np.unique(counts, axis=0)
            covariance = np.cov(counts.T)
            # No two particles are drawn together more often than apart.
            off_diagonal = covariance[~np.eye(8, dtype=bool)]
            if scheme == "ssp":
                assert off_diagonal.max() < 4 * 0.25 / np.sqrt(2000)
        assert len(outcomes["systematic"]) == 2
        assert len(outcomes["ssp"]) > 10

    def test_the_sums_of_a_component_do_not_move_by_more_than_one_offspring(self):
        """In any stretch that the tree pairs first, the number of offspring is settled there."""
        rng = np.random.default_rng(3)
        mixture = make_mixture(rng.normal(size=64), rng.normal(size=64), np.zeros(64), 1)
        expected = expected_offspring(mixture, 64)
        for seed in range(20):
            counts = offspring(mixture, draw(Resample("ssp"), mixture, seed))
            assert counts.sum() == 64
            halves = counts.reshape(2, 32).sum(axis=1) - expected.reshape(2, 32).sum(axis=1)
            assert np.abs(halves).max() < 1


class TestSystematic:
    def test_components_draw_their_offsets_independently(self):
        labels = np.repeat([0, 1], 10)
        log_weights = np.tile(np.log([0.05, 0.95] * 5), 2)
        mixture = make_mixture(np.arange(20.0), log_weights, labels, 2)
        keys = jax.random.split(jax.random.key(0), 2000)
        moved = jax.jit(jax.vmap(lambda key: Resample()(key, mixture)))(keys)
        first = np.asarray(moved.ancestor_indices == 0).any(axis=1)
        second = np.asarray(moved.ancestor_indices == 10).any(axis=1)
        correlation = np.corrcoef(first, second)[0, 1]
        assert abs(correlation) < 4 / np.sqrt(2000)


class TestResidual:
    def test_every_particle_gets_the_whole_part_of_what_is_expected(self):
        rng = np.random.default_rng(9)
        mixture = make_mixture(rng.normal(size=60), rng.normal(size=60), np.arange(60) % 3, 3)
        expected = expected_offspring(mixture, 20)
        for seed in range(20):
            counts = offspring(
                mixture, draw(Resample("residual", allocation="equal"), mixture, seed)
            )
            assert (counts >= np.floor(expected - 1e-4)).all()

    @pytest.mark.parametrize("size", [7, 99])
    def test_equal_weights_leave_nothing_to_chance(self, size):
        mixture = make_mixture(np.arange(size), np.zeros(size), np.zeros(size), 1)
        for seed in range(5):
            counts = offspring(
                mixture, draw(Resample("residual", allocation="equal"), mixture, seed)
            )
            assert (counts == 1).all()


class TestAllocation:
    def test_equal_shares_differ_by_at_most_one(self):
        rng = np.random.default_rng(10)
        labels = rng.choice([0, 2, 3], 50, p=[0.8, 0.15, 0.05])
        mixture = make_mixture(rng.normal(size=50), rng.normal(size=50), labels, 5)
        counts = np.asarray(draw(Resample(allocation="equal"), mixture, 0).component_counts)
        assert counts.sum() == 50
        assert (counts[[1, 4]] == 0).all()
        living = counts[[0, 2, 3]]
        assert living.max() - living.min() <= 1

    def test_a_fixed_number_leaves_the_other_slots_empty(self):
        rng = np.random.default_rng(11)
        labels = rng.choice([0, 2], 50)
        mixture = make_mixture(rng.normal(size=50), rng.normal(size=50), labels, 4)
        moved = draw(Resample(particles_per_component=8), mixture)
        np.testing.assert_array_equal(moved.component_counts, [8, 0, 8, 0])
        assert (np.asarray(moved.log_weights) == -np.inf).sum() == 50 - 16
        again = draw(Resample(particles_per_component=20), moved)
        np.testing.assert_array_equal(again.component_counts, [20, 0, 20, 0])

    def test_a_component_that_is_not_due_keeps_its_particles_and_weights(self):
        log_weights = np.concatenate([np.arange(10) / 10, [5.0] + [0.0] * 9])
        mixture = make_mixture(np.arange(20.0), log_weights, np.repeat([0, 1], 10), 2)
        move = Resample(ess_threshold=0.5)
        np.testing.assert_array_equal(move.would_resample(mixture), [False, True])
        moved = draw(move, mixture)
        np.testing.assert_array_equal(moved.ancestor_indices[:10], np.arange(10))
        np.testing.assert_array_equal(moved.log_weights[:10], mixture.log_weights[:10])
        assert float(moved.component_effective_sample_sizes[1]) == pytest.approx(10, rel=1e-4)

    def test_is_due_compares_each_components_own_sample_size(self):
        rng = np.random.default_rng(12)
        mixture = make_mixture(rng.normal(size=90), 2 * rng.normal(size=90), np.arange(90) % 3, 4)
        sizes, counts = mixture.component_effective_sample_sizes, mixture.component_counts
        for threshold in (0.1, 0.2, 0.3, 0.9):
            expected = (np.asarray(sizes) < threshold * np.asarray(counts)) & (counts > 0)
            np.testing.assert_array_equal(
                Resample(ess_threshold=threshold).would_resample(mixture), expected
            )
        assert not Resample(ess_threshold=0.0).would_resample(mixture).any()
        np.testing.assert_array_equal(Resample().would_resample(mixture), [True, True, True, False])


class TestSorted:
    def test_neighbours_in_line_are_neighbours_in_space(self):
        rng = np.random.default_rng(13)
        mixture = make_mixture(rng.normal(size=60), rng.normal(size=60), np.arange(60) % 3, 3)
        moved = draw(Resample(sort_by=lambda states: states), mixture)
        for m in range(3):
            members = np.asarray(moved.particles)[np.asarray(moved.component_indicators) == m]
            assert (np.diff(members) >= 0).all()


@over_schemes
def test_the_offspring_of_a_single_component_are_unbiased(scheme):
    """M = 1 takes a shorter path through the code; `test_contracts.py` takes the general one."""
    rng = np.random.default_rng(14)
    mixture = make_mixture(rng.normal(size=60), rng.normal(size=60), np.zeros(60), 1)
    keys = jax.random.split(jax.random.key(0), 4000)
    moved = jax.jit(jax.vmap(lambda key: Resample(scheme)(key, mixture)))(keys)
    counts = np.stack(
        [np.bincount(row, minlength=60) for row in np.asarray(moved.ancestor_indices)]
    )
    gap = counts.mean(axis=0) - expected_offspring(mixture, 60)
    assert (np.abs(gap) < 4.5 * counts.std(axis=0) / np.sqrt(4000) + 1e-3).all()


@pytest.mark.parametrize("particles_per_component", [None, 30])
def test_one_component_that_is_not_due_keeps_its_particles_among_empty_slots(
    particles_per_component,
):
    empty = np.arange(40) % 4 == 1
    mixture = make_mixture(np.arange(40.0), np.where(empty, -np.inf, 0.0), np.zeros(40), 1)
    move = Resample("systematic", 0.5, particles_per_component)
    assert not np.asarray(move.would_resample(mixture)).any()
    moved = draw(move, mixture)
    np.testing.assert_array_equal(moved.log_weights, mixture.log_weights)
    np.testing.assert_array_equal(moved.particles, mixture.particles)


@pytest.mark.parametrize("num_components", [1, 6])
def test_what_has_no_mass_gets_none(num_components):
    """As an island does that has died."""
    mixture = make_mixture(
        np.zeros((12, 1)), np.zeros(12), np.arange(12) % num_components, num_components
    )
    mixture = mixture.replace(log_weights=jnp.full(12, -jnp.inf))
    moved = draw(Resample(), mixture)
    np.testing.assert_array_equal(moved.log_weights, -np.inf)


@pytest.mark.parametrize("word", [0, 2**32 - 1])
def test_points_stay_within_their_components_stretch_of_slots(word):
    """The largest uniform numbers round up onto the border, which is the next component's."""
    targets = jnp.asarray([1, 25_000, 2**20, 74_999], jnp.int32)
    slots = place_slots(targets, 2**20 + 100_000)
    ends = np.asarray(slots.firsts) + np.asarray(targets)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(prefix_sums, "bits", lambda key, shape: jnp.full(shape, word, jnp.uint32))
        ends_of_unit = {0: 0.0, 2**32 - 1: NEARLY_ONE}
        patch.setattr(
            prefix_sums, "uniform", lambda key, shape: jnp.full(shape, ends_of_unit[word])
        )
        points = jax.jit(lambda key: random_points(key, slots, targets))(jax.random.key(0))
    own = np.asarray(slots.components)
    assert (points.whole >= np.asarray(slots.firsts)[own]).all()
    assert (points.whole < ends[own]).all()
    assert (points.fraction >= 0).all()
    assert (points.fraction < 1).all()
