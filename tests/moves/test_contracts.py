"""The contracts of every move in the registry, on every mixture of the examples."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mpfjax import QuadraticModel, Resample, Step
from tests.examples import AT_START, example_mixtures, log_masses
from tests.marking import quick_of
from tests.registry import REGROUPINGS, WITHIN_COMPONENTS

# One component has a path of its own, and up to four are worked on as rows.
MIXTURES = {m: example_mixtures(m) for m in (1, 3, 6)}
ORDINARY = MIXTURES[6]["ordinary"]
MODEL = QuadraticModel()
NUM_DRAWS = 2000
PLAIN = ("systematic", "stratified", "multinomial")
CASES = [(name, 3 if name.startswith("s") else 6) for name in WITHIN_COMPONENTS]
CASES += [(name, 1) for name in PLAIN]
# Each takes a program of its own; these are one of every kind.
QUICK = [
    ("systematic", 1),
    ("systematic", 3),
    *((name, 6) for name in ("multinomial, adaptive", "gaussian")),
    ("stratified, fixed number, adaptive", 3),
]
QUICK_REGROUPINGS = (
    "kmeans reseeded", "merge by deviations", "patient merge", "split", "pool", "random partition",
    "grouped by a label",
)  # fmt: skip
RESAMPLINGS = [(name, m) for name, m in CASES if isinstance(WITHIN_COMPONENTS[name], Resample)]


@eqx.filter_jit
def moved_by(move, key, mixture):
    return move(key, mixture, AT_START)


@jax.jit
def summaries(mixture):
    means = jnp.where(mixture.active[:, None], mixture.component_means(), 0.0)
    moments = means, mixture.component_covariances(), mixture.mean()
    return *moments, mixture.component_effective_sample_sizes


@pytest.mark.parametrize("name", quick_of(REGROUPINGS, QUICK_REGROUPINGS))
def test_regrouping_changes_nothing_but_indicators_and_memory(name):
    """And leaves a mixture whose summaries are finite."""
    move = REGROUPINGS[name]
    for example, mixture in MIXTURES[6].items():
        mixture = mixture.replace(memory=move.initial_memory(Step(MODEL, None), 6))
        moved = moved_by(move, jax.random.key(0), mixture)
        for field in ("particles", "log_weights", "ancestor_indices"):
            np.testing.assert_array_equal(getattr(moved, field), getattr(mixture, field))
        labels = np.asarray(moved.component_indicators)
        assert ((labels >= 0) & (labels < 6)).all(), example
        assert jax.tree.structure(moved) == jax.tree.structure(mixture)
        moved = moved.replace(memory={})
        assert all(np.isfinite(summary).all() for summary in summaries(moved)), example
        np.testing.assert_allclose(float(moved.mixture_weights.sum()), 1.0, rtol=1e-5)


@pytest.mark.parametrize("name", ["kmeans", "merge by deviations", "split", "eager split"])
def test_regrouping_treats_every_copy_of_a_particle_alike(name):
    """A mixture in which each particle stands twice is that of the particles with N doubled."""
    twice = jax.tree.map(
        lambda leaf: jnp.concatenate([leaf, leaf]) if leaf.ndim else leaf, ORDINARY
    )
    labels, found = (
        np.asarray(moved_by(REGROUPINGS[name], jax.random.key(0), m).component_indicators)
        for m in (ORDINARY, twice.reweight(jnp.full(1, -np.log(2).astype(np.float32))))
    )
    np.testing.assert_array_equal(found, np.concatenate([labels, labels]))


@eqx.filter_jit
def draws_of(move, mixture):
    keys = jax.random.split(jax.random.key(1), NUM_DRAWS)
    return jax.vmap(lambda key: move(key, mixture, AT_START))(keys)


@pytest.mark.exactness
@pytest.mark.parametrize(("name", "m"), quick_of(CASES, QUICK, one_in=2))
def test_components_keep_their_mass_and_their_offspring(name, m):
    """And a slot is fed from a particle of weight, as many of them as the move says."""
    move = WITHIN_COMPONENTS[name]
    for example, before in MIXTURES[m].items():
        after = jax.tree.map(np.asarray, draws_of(move, before))
        for draw in range(0, NUM_DRAWS, 200):
            one = jax.tree.map(lambda leaf, draw=draw: leaf[draw], after)
            np.testing.assert_allclose(log_masses(one), log_masses(before), rtol=1e-6, atol=2e-5)
        filled, counts = after.log_weights > -np.inf, np.asarray(before.component_counts)
        expected = before.num_particles if due_in(move, before).any() else counts.sum()
        if move.particles_per_component is not None:
            expected = move.particles_per_component * (counts > 0).sum()
        assert (filled.sum(axis=1) == expected).all(), example
        if not move.keeps_parents:
            assert (after.ancestor_indices == -1).all()
            assert np.isfinite(after.particles[filled]).all()
        else:
            parents = after.ancestor_indices[filled]
            labels = np.asarray(before.component_indicators)[parents]
            assert (after.component_indicators[filled] == labels).all(), example
            assert np.asarray(before.occupied)[parents].all()
            copied = np.asarray(before.particles)[parents]
            np.testing.assert_array_equal(after.particles[filled], copied)


@pytest.mark.parametrize(("name", "m"), quick_of(RESAMPLINGS, QUICK, one_in=2))
def test_offspring_are_unbiased_where_resampled_and_kept_elsewhere(name, m):
    """E[weight of i's offspring] is i's weight, the definition of unbiased resampling."""
    move = WITHIN_COMPONENTS[name]
    for example, before in MIXTURES[m].items():
        after, n = jax.tree.map(np.asarray, draws_of(move, before)), before.num_particles
        filled = after.log_weights > -np.inf
        slots = (np.arange(NUM_DRAWS)[:, None] * n + after.ancestor_indices)[filled]
        offspring = np.bincount(slots, minlength=NUM_DRAWS * n).reshape(NUM_DRAWS, n)
        labels, occupied = np.asarray(before.component_indicators), np.asarray(before.occupied)
        targets = new_counts(after, m)
        weights = np.asarray(before.component_weights, float)
        error = np.abs(offspring.mean(axis=0) - targets[labels] * weights)
        # Particles that should have offspring once in thousands of draws: their counts are few.
        bound = 4.5 * offspring.std(axis=0) / np.sqrt(NUM_DRAWS) + 4 / NUM_DRAWS
        due = due_in(move, before)[labels]
        assert (error <= bound)[due & occupied].all(), example
        # Below e^-87 a weight is nothing in float32, though its logarithm is not -inf.
        assert (offspring == 0)[:, due & (weights < np.exp(-88.0))].all(), example
        kept = ~due & occupied
        assert (offspring == 1)[:, kept].all(), example
        from_kept = kept[after.ancestor_indices] & filled
        own = np.asarray(before.log_weights)[after.ancestor_indices]
        np.testing.assert_array_equal(after.log_weights[from_kept], own[from_kept])
        if name == "systematic":
            rounded = np.abs(offspring - targets[labels] * weights) < 1 + 1e-4
            assert rounded[:, due & occupied].all(), example


def due_in(move, mixture):
    """Which components the move redraws: those of a small sample size, by the definition."""
    counts, threshold = np.asarray(mixture.component_counts), getattr(move, "ess_threshold", 1.0)
    sizes = np.asarray(mixture.component_effective_sample_sizes)
    number = move.particles_per_component
    is_due = (sizes < threshold * counts) | (threshold == 1.0)
    return (is_due if number is None else is_due | (counts != number)) & (counts > 0)


def new_counts(after, num_components):
    """How many particles each component has after the move: the same at every draw."""
    filled = after.log_weights > -np.inf
    own = after.component_indicators[..., None] == np.arange(num_components)
    counts = (own & filled[..., None]).sum(axis=1)
    assert (counts == counts[:1]).all()
    return counts[0]
