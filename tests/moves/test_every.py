"""Moves at every k-th step: when they run, and what they remember."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax import Every, KMeans, Merge, Propagate, Split
from mpfjax.mixture import single_component
from tests.examples import AT_START, make_mixture
from tests.registry import RandomLabels

MODEL = mpfjax.QuadraticModel(0.3, 0.5, -2.0, 2.0)
OBSERVATIONS = jnp.array([1.5, 1.0, 0.4, 0.9, 0.2, 1.1, 0.7])
KEYS = jax.random.split(jax.random.key(0), 5)


def indicators(mixture):
    return mixture.component_indicators


def runs(*moves, observations=OBSERVATIONS):
    filter = mpfjax.Filter(MODEL, [Propagate(), *moves], 40, 3, [KMeans(2, reseed=True)])
    return mpfjax.monte_carlo(KEYS, filter, mpfjax.Series.skipping(observations), indicators)


def run(*moves, observations=OBSERVATIONS):
    found = runs(*moves, observations=observations)
    initial = np.asarray(found.initial.component_indicators)
    return found, np.concatenate([initial[:, None], np.asarray(found.collected)], axis=1)


@pytest.mark.exactness
def test_they_run_at_the_steps_k_2k_and_so_on_and_a_missing_observation_is_no_step():
    """Without resampling nothing else changes the labels."""
    present = jnp.array([True, True, False, True, True, False, True])
    for observations, steps in (
        (OBSERVATIONS, [2, 5]),
        (jnp.where(present, OBSERVATIONS, jnp.nan), [3]),
    ):
        _, labels = run(Every(3, [RandomLabels()]), observations=observations)
        changed = (np.diff(labels, axis=1) != 0).any(axis=2)
        expected = np.isin(np.arange(7), steps)
        np.testing.assert_array_equal(changed, np.tile(expected, (len(KEYS), 1)))


def test_between_them_nothing_is_computed_for_any_seed():
    """The condition must not become a choice between both results, as under `vmap` it may."""
    assert "cond[" in str(jax.make_jaxpr(lambda: runs(Every(3, [KMeans(5)])).collected)())


@pytest.mark.exactness
def test_a_label_that_dies_within_and_is_used_again_has_no_past():
    """Merge frees a label and Split takes it: what is remembered of the pair begins anew."""
    states = jnp.concatenate([jnp.full(10, 0.0), jnp.full(10, 0.01), jnp.full(10, 9.0)])
    states = (states + 1e-3 * jnp.arange(30.0)).at[20:25].add(-4.0)
    mixture = make_mixture(states, np.zeros(30), np.repeat(np.arange(3), 10), 3)
    every = Every(1, [Merge(None, max_distance=1.0, patience=2), Split(1.0)])
    durations = jnp.array([[5, 5, 0], [5, 5, 0], [0, 0, 5]], jnp.int32)
    memory = every.initial_memory(mpfjax.Step(MODEL, None), 3) | {"overlap_durations": durations}
    after = every(KEYS[0], mixture.replace(memory=memory), AT_START)
    np.testing.assert_array_equal(np.unique(after.component_indicators), [0, 1, 2])
    assert after.memory["overlap_durations"][0, 1] == 0


class Odd(mpfjax.AbstractRegrouping):
    """A regrouping of which all is so that a filter may ask of a move."""

    approximate = needs_parents = biases_score = True
    keeps_parents = keeps_families = False

    def regroup(self, key, mixture):
        return mixture.component_indicators, mixture.memory

    def initial_memory(self, now, num_components):
        return {"odd": jnp.zeros(num_components)}

    def check(self, now, num_particles, num_components):
        raise ValueError(f"odd: {num_components}")


def test_a_move_that_holds_moves_forwards_all_that_they_are():
    move = Every(1, [KMeans(), Odd()])
    for name in ("approximate", "needs_parents", "biases_score", "keeps_mass"):
        assert getattr(move, name), name
    for name in ("keeps_parents", "keeps_families", "weighs"):
        assert not getattr(move, name), name
    assert "odd" in move.initial_memory(mpfjax.Step(MODEL, None), 3)
    now = mpfjax.Step(MODEL, jnp.float32(1.0))
    with pytest.raises(ValueError, match="odd"):
        move.check(now, 4, 3)


@pytest.mark.exactness
def test_a_resampling_from_time_to_time_leaves_the_choice_of_x_0_alone():
    moves = [Every(1, [mpfjax.Resample()]), Propagate()]
    filter = mpfjax.with_initial_selection(mpfjax.Filter(MODEL, moves, 64), 4)
    run = mpfjax.run_filter(KEYS[0], filter, OBSERVATIONS)
    assert not run.resampled[0]
    assert run.resampled[1]
    first = jax.tree.map(lambda leaf: leaf[0], run.collected)
    np.testing.assert_array_equal(first.ancestor_indices, np.arange(64))


def test_particles_in_order_come_through():
    """Both branches have one form, whatever moved the particles before."""
    mixture = single_component(jnp.arange(6.0), 2).at_step().with_order(True)
    filter = mpfjax.Filter(MODEL, [Propagate(), Every(2, [RandomLabels()])], 6, 2)
    memory = filter.moves[1].initial_memory(mpfjax.Step(MODEL, None), 2)
    moved = filter.moves[1](KEYS[0], mixture.replace(memory=memory), AT_START)
    np.testing.assert_array_equal(moved.particles, mixture.particles)
