"""The contracts of every move in the registry, on every mixture of the examples."""

from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mpfjax import Resample
from tests.examples import example_mixtures, log_masses, make_mixture
from tests.marking import quick_of, thorough
from tests.registry import REGROUPINGS, WITHIN_COMPONENTS

# On either side of the number of components up to which they are worked on as rows.
FEW = ("ordinary", "dead components", "masses 200 nats apart")
MIXTURES = example_mixtures() | {f"{name}, M = 3": example_mixtures(3)[name] for name in FEW}
# One of each way in which a mixture can be out of the ordinary.
QUICK_MIXTURES = (
    "ordinary",
    "dead components",
    "empty slots with stale states",
    "masses 200 nats apart",
)
# One of each way to place the offspring, to share the slots, and to choose who is due.
QUICK_REJUVENATIONS = (
    "systematic",
    "multinomial",
    "ssp, adaptive",
    "systematic, along a Hilbert curve",
    "residual, fixed number, adaptive",
    "residual, adaptive",
    "gaussian",
    "gaussian, point sets",
)
NUM_DRAWS = 4000

over_mixtures = pytest.mark.parametrize("mixture", MIXTURES.values(), ids=MIXTURES)
over_regroupings = pytest.mark.parametrize("name", REGROUPINGS)
over_moves_within_components = pytest.mark.parametrize(
    "name", quick_of(WITHIN_COMPONENTS, QUICK_REJUVENATIONS)
)
RESAMPLINGS = [name for name, move in WITHIN_COMPONENTS.items() if isinstance(move, Resample)]
over_resamplings = pytest.mark.parametrize("name", quick_of(RESAMPLINGS, QUICK_REJUVENATIONS))


@cache
def compiled(name):
    return eqx.filter_jit(REGROUPINGS[name])


@cache
def redraw(name):
    """The move, compiled for many keys at once and one mixture."""
    move = WITHIN_COMPONENTS[name]
    return eqx.filter_jit(jax.vmap(lambda key, mixture: move(key, mixture), in_axes=(0, None)))


@cache
def draws(name, example):
    """What `NUM_DRAWS` keys make of an example, as numpy."""
    keys = jax.random.split(jax.random.key(1), NUM_DRAWS)
    return jax.tree.map(np.asarray, redraw(name)(keys, MIXTURES[example]))


def with_memory(move, mixture):
    return mixture.replace(memory=move.initial_memory(mixture.num_components))


@over_mixtures
@over_regroupings
def test_regrouping_changes_nothing_but_indicators_and_memory(name, mixture):
    mixture = with_memory(REGROUPINGS[name], mixture)
    moved = compiled(name)(jax.random.key(0), mixture)
    kept = ("particles", "log_weights", "ancestor_indices")
    for field in kept:
        np.testing.assert_array_equal(getattr(moved, field), getattr(mixture, field))
    assert float(moved.log_mass) == float(mixture.log_mass)
    labels = np.asarray(moved.component_indicators)
    assert labels.min() >= 0
    assert labels.max() < mixture.num_components
    assert jax.tree.structure(moved) == jax.tree.structure(mixture)


@jax.jit
def summaries(mixture):
    moments = mixture.component_means(), mixture.component_covariances(), mixture.mean()
    return *moments, mixture.component_effective_sample_sizes


@over_mixtures
@over_regroupings
def test_regrouping_leaves_a_mixture_whose_summaries_are_finite(name, mixture):
    moved = compiled(name)(jax.random.key(0), with_memory(REGROUPINGS[name], mixture))
    for summary in summaries(moved.replace(memory={})):
        assert np.isfinite(summary).all()
    np.testing.assert_allclose(float(moved.mixture_weights.sum()), 1.0, rtol=1e-5)


@pytest.mark.parametrize("example", quick_of(MIXTURES, QUICK_MIXTURES))
@over_moves_within_components
class TestWithinComponents:
    def test_leaves_each_components_mass_unchanged(self, name, example):
        before, after = log_masses(MIXTURES[example]), draws(name, example)
        for draw in range(0, NUM_DRAWS, 400):
            one = jax.tree.map(lambda leaf, draw=draw: leaf[draw], after)
            np.testing.assert_allclose(log_masses(one), before, rtol=1e-6, atol=2e-5)

    def test_lets_no_offspring_change_component(self, name, example):
        after, before = draws(name, example), MIXTURES[example]
        filled = after.log_weights > -np.inf
        if not WITHIN_COMPONENTS[name].keeps_parents:
            assert (after.ancestor_indices == -1).all()
            return
        parents = np.asarray(before.component_indicators)[after.ancestor_indices]
        assert (after.component_indicators == parents)[filled].all()

    def test_feeds_no_slot_from_a_particle_without_weight(self, name, example):
        after, before = draws(name, example), MIXTURES[example]
        # Below e^-87 a weight is nothing in float32, though its logarithm is not -inf.
        weightless = np.asarray(before.log_component_weights) < -88
        filled = after.log_weights > -np.inf
        if not WITHIN_COMPONENTS[name].keeps_parents:
            assert np.isfinite(after.particles[filled]).all()
            return
        parents = after.ancestor_indices[filled]
        assert np.asarray(before.occupied)[parents].all()
        if all_due(name, before):
            assert not weightless[parents].any()

    def test_fills_the_slots_that_it_should(self, name, example):
        after, before = draws(name, example), MIXTURES[example]
        number = WITHIN_COMPONENTS[name].particles_per_component
        counts = np.asarray(before.component_counts)
        filled = (after.log_weights > -np.inf).sum(axis=1)
        if number is not None:
            assert (filled == number * (counts > 0).sum()).all()
        elif move_due(name, before).any():
            assert (filled == before.num_particles).all()
        else:
            assert (filled == counts.sum()).all()


@pytest.mark.parametrize("example", quick_of(MIXTURES, QUICK_MIXTURES))
@over_resamplings
class TestResampling:
    def test_ancestors_point_at_the_particles_that_were_copied(self, name, example):
        after, before = draws(name, example), MIXTURES[example]
        copied = np.asarray(before.particles)[after.ancestor_indices]
        filled = after.log_weights > -np.inf
        np.testing.assert_array_equal(after.particles[filled], copied[filled])

    def test_offspring_are_unbiased_where_resampled_and_kept_elsewhere(self, name, example):
        """E[weight of i's offspring] is i's weight, the definition of unbiased resampling."""
        after, before = draws(name, example), MIXTURES[example]
        slots = np.arange(NUM_DRAWS)[:, None] * before.num_particles + after.ancestor_indices
        offspring = np.bincount(
            slots.ravel(),
            weights=(after.log_weights > -np.inf).ravel(),
            minlength=NUM_DRAWS * before.num_particles,
        ).reshape(NUM_DRAWS, -1)
        due = move_due(name, before)
        labels = np.asarray(before.component_indicators)
        targets = new_counts(after, before.num_components)
        expected = targets[labels] * np.exp(np.asarray(before.log_component_weights, float))
        standard_error = offspring.std(axis=0) / np.sqrt(NUM_DRAWS)
        error = np.abs(offspring.mean(axis=0) - expected)
        # Particles that should have offspring once in thousands of draws: their counts are few.
        rare = 4 / NUM_DRAWS
        checked = due[labels] & np.asarray(before.occupied)
        assert (error <= 4.5 * standard_error + rare)[checked].all()
        kept = ~due[labels] & np.asarray(before.occupied)
        assert (offspring == 1)[:, kept].all()
        from_kept = kept[after.ancestor_indices] & (after.log_weights > -np.inf)
        own = np.asarray(before.log_weights)[after.ancestor_indices]
        np.testing.assert_array_equal(after.log_weights[from_kept], own[from_kept])


def move_due(name, mixture):
    """Which components the move redraws."""
    move = WITHIN_COMPONENTS[name]
    return np.asarray(
        move.would_resample(mixture) if isinstance(move, Resample) else mixture.active
    )


def all_due(name, mixture):
    return (move_due(name, mixture) == np.asarray(mixture.active)).all()


def new_counts(after, num_components):
    """How many particles each component has after the move: the same at every draw."""
    filled = after.log_weights > -np.inf
    counts = np.stack(
        [((after.component_indicators == m) & filled).sum(axis=1) for m in range(num_components)]
    )
    assert (counts == counts[:, :1]).all()
    return counts[:, 0]


@over_resamplings
def test_resampling_works_with_any_pytree_of_particles(name):
    mixture = MIXTURES["ordinary"]
    leaves = {"box": mixture.particles, "age": (jnp.arange(40), jnp.zeros((40, 2, 3)))}
    move = WITHIN_COMPONENTS[name]
    if move.sort_by is not None:
        move = Resample(move.scheme, sort_by=lambda states: states["box"][:, 0])
    after = eqx.filter_jit(move)(jax.random.key(2), mixture.replace(particles=leaves))
    filled = np.asarray(after.occupied)
    copied = np.asarray(after.ancestor_indices)[filled]
    np.testing.assert_array_equal(np.asarray(after.particles["age"][0])[filled], copied)
    assert after.particles["age"][1].shape == (40, 2, 3)


@pytest.mark.parametrize("num_components", [3, 6])
@pytest.mark.parametrize("n", [31, 33, 129, *thorough([32, 127, 128, 1023, 1025, 8193])])
def test_resampling_on_either_side_of_every_block_size(n, num_components):
    rng = np.random.default_rng(n)
    labels = rng.integers(0, num_components, n)
    log_weights = np.where(rng.random(n) < 0.2, -np.inf, 3 * rng.normal(size=n))
    mixture = make_mixture(rng.normal(size=(n, 1)), log_weights, labels, num_components)
    moved = eqx.filter_jit(Resample())(jax.random.key(n), mixture)
    filled = np.asarray(moved.occupied)
    assert filled.all()
    np.testing.assert_allclose(log_masses(moved), log_masses(mixture), rtol=1e-6, atol=2e-5)
    parents = np.asarray(moved.ancestor_indices)
    assert (labels[parents] == np.asarray(moved.component_indicators)).all()
    # A systematic draw has as many offspring as expected, to within one.
    weights = np.exp(np.asarray(mixture.log_component_weights, float))
    shares = np.bincount(np.asarray(moved.component_indicators), minlength=num_components)
    offspring = np.bincount(parents, minlength=n)
    assert (np.abs(offspring - shares[labels] * weights) <= 1 + 1e-3).all()


@pytest.mark.parametrize("name", ["kmeans", "merge by deviations", "split", "eager split"])
def test_regrouping_treats_every_copy_of_a_particle_alike(name):
    """A mixture in which each particle stands twice is that of the particles with N doubled."""
    one = MIXTURES["ordinary"]
    twice = jax.tree.map(lambda leaf: jnp.concatenate([leaf, leaf]) if leaf.ndim else leaf, one)
    twice = twice.replace(log_weights=twice.log_weights - np.log(2).astype(np.float32))
    labels = np.asarray(compiled(name)(jax.random.key(0), one).component_indicators)
    found = np.asarray(compiled(name)(jax.random.key(0), twice).component_indicators)
    np.testing.assert_array_equal(found, np.concatenate([labels, labels]))
