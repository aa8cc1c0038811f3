"""Moves at every k-th step: when they run, what they cost between, and what they remember."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax import Every, KMeans, Merge, Propagate, Resample, Split
from tests.registry import RandomLabels

MODEL = mpfjax.QuadraticModel(0.3, 0.5, -2.0, 2.0)
OBSERVATIONS = jnp.array([1.5, 1.0, 0.4, 0.9, 0.2, 1.1, 0.7])
KEYS = jax.random.split(jax.random.key(0), 5)


def chain(*moves, m=3):
    return mpfjax.Filter(MODEL, [Propagate(MODEL), *moves], 40, m, [KMeans(2, reseed=True)])


def labels(mixture):
    return mixture.component_indicators


def test_they_run_at_the_steps_k_2k_and_so_on():
    """Without resampling nothing else changes the labels."""
    run = mpfjax.monte_carlo(KEYS, chain(Every(3, [RandomLabels()])), OBSERVATIONS, labels)
    first = np.asarray(run.initial.component_indicators)
    upto = np.concatenate([first[:, None], np.asarray(run.collected)], axis=1)
    changed = (np.diff(upto, axis=1) != 0).any(axis=2)
    np.testing.assert_array_equal(changed, [[False, False, True] * 2 + [False]] * len(KEYS))


def test_at_every_step_they_are_the_moves_themselves():
    moves = [Merge(2.0, patience=2), Split(1.0), KMeans(2)]
    plain = mpfjax.run_filter(KEYS[0], chain(*moves), OBSERVATIONS, labels)
    every = mpfjax.run_filter(KEYS[0], chain(*(Every(1, [m]) for m in moves)), OBSERVATIONS, labels)
    np.testing.assert_array_equal(plain.collected, every.collected)
    assert set(every.final.memory) == {"overlap_durations"} | {
        f"every 1: {name}" for name in ("Merge", "Split", "KMeans")
    }


def test_resampling_is_reported_where_it_happens():
    run = mpfjax.monte_carlo(KEYS, chain(Every(2, [Resample(), KMeans(1)])), OBSERVATIONS)
    happened = np.asarray(run.resampled).any(axis=2)
    np.testing.assert_array_equal(happened, [[False, True] * 3 + [False]] * len(KEYS))


@pytest.mark.thorough
def test_step_by_step_from_a_checkpoint_it_is_the_same_run(tmp_path):
    filter = chain(Every(3, [RandomLabels()]))
    whole = mpfjax.run_filter(KEYS[1], filter, OBSERVATIONS, labels)
    key_initial, key_steps = jax.random.split(KEYS[1])
    mixture = filter.init(key_initial)
    for t, key in enumerate(jax.random.split(key_steps, len(OBSERVATIONS))):
        if t == 4:
            mpfjax.save_checkpoint(tmp_path / "run.npz", mixture)
            mixture = mpfjax.load_checkpoint(tmp_path / "run.npz", filter.init(KEYS[0]))
        mixture, _ = filter.step(key, mixture, OBSERVATIONS[t])
        np.testing.assert_array_equal(mixture.component_indicators, whole.collected[t])


def test_a_missing_observation_is_no_step():
    present = jnp.array([True, True, False, True, True, False, True])
    seen = jnp.where(present, OBSERVATIONS, jnp.nan)
    filter = chain(Every(3, [RandomLabels()]))
    run = mpfjax.run_filter(KEYS[0], filter, seen, labels, missing="skip")
    upto = np.concatenate([run.initial.component_indicators[None], run.collected])
    changed = (np.diff(upto, axis=0) != 0).any(axis=1)
    np.testing.assert_array_equal(np.flatnonzero(changed), [3])


def test_between_them_nothing_is_computed_for_any_seed():
    """The condition must not become a choice between both results, as under `vmap` it may."""
    filter = chain(Every(3, [KMeans(5)]))

    def run(keys):
        return mpfjax.monte_carlo(keys, filter, OBSERVATIONS, labels).collected

    assert "cond[" in str(jax.make_jaxpr(run)(KEYS))
    batched = jax.vmap(lambda key: filter.init(key))(KEYS)
    assert batched.memory["every 3: KMeans"]["steps"].shape == (len(KEYS),)


def test_a_label_that_dies_within_and_is_used_again_has_no_past():
    """Merge frees a label and Split takes it: what is remembered of the pair begins anew."""
    states = jnp.concatenate([jnp.full(10, 0.0), jnp.full(10, 0.01), jnp.full(10, 9.0)])
    states = states + 1e-3 * jnp.arange(30.0)
    states = states.at[20:25].add(-4.0)
    mixture = mpfjax.ParticleMixture(
        states, jnp.full(30, -jnp.log(30.0)), jnp.repeat(jnp.arange(3), 10), jnp.arange(30), 3
    )
    merge = Merge(None, 1.0, patience=2)
    every = Every(1, [merge, Split(1.0)])
    durations = jnp.array([[5, 5, 0], [5, 5, 0], [0, 0, 5]], jnp.int32)
    memory = every.initial_memory(3) | {"overlap_durations": durations}
    after = every(KEYS[0], mixture.replace(memory=memory))
    np.testing.assert_array_equal(np.unique(after.component_indicators), [0, 1, 2])
    assert after.memory["overlap_durations"][0, 1] == 0


@pytest.mark.parametrize(
    ("message", "num_steps", "moves"),
    [
        ("num_steps: 0", 0, [KMeans()]),
        ("num_steps: 1.5", 1.5, [KMeans()]),
        ("moves: there must be at least one", 2, []),
        ("moves: .* is not a list of moves", 2, KMeans()),
        ("moves: (?s:.*) neither regroups, resamples nor", 2, [KMeans(), Propagate(MODEL)]),
    ],
)
def test_what_will_not_do_is_named(as_installed, message, num_steps, moves):
    with pytest.raises(ValueError, match=message):
        Every(num_steps, moves)


def test_a_filter_looks_into_it():
    with pytest.raises(ValueError, match="particles_per_component: 20 for each of 3"):
        chain(Every(2, [Resample(particles_per_component=20)]))
    with pytest.raises(ValueError, match="moves: Every and Every would share one memory"):
        chain(Every(2, [KMeans(1)]), Every(2, [KMeans(2)]))
    with pytest.raises(ValueError, match="regroup_every: 0"):
        mpfjax.mixture_particle_filter(MODEL, 40, 3, regroup_every=0)
