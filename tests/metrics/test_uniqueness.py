"""Distinct hypotheses and their spread, by hand and as in the paper's figure 4."""

import jax
import jax.numpy as jnp
import numpy as np

import mpfjax
from mpfjax.metrics import uniqueness
from tests.examples import make_mixture


def test_uniqueness_counts_what_differs_in_any_part_of_an_objects_state():
    box = np.zeros((6, 3, 2))
    box[:, 0] = np.arange(12).reshape(6, 2)
    box[:, 1, 1] = [1, 2, 1, 2, 1, 9]
    age = jnp.array([[0, 0, 5]] * 5 + [[0, 0, 6]])
    mixture = make_mixture(box, [0, 1, 2, 3, 4, -np.inf], np.zeros(6), 1)
    boxes = uniqueness(mixture)
    np.testing.assert_allclose(boxes, [5 / 6, 2 / 6, 1 / 6], rtol=1e-6)
    both = uniqueness(mixture.replace(particles=(mixture.particles, age)))
    np.testing.assert_allclose(both, boxes, rtol=1e-6)
    five_slots = mixture.replace(usable_slots=jnp.array(5, jnp.int32))
    np.testing.assert_allclose(uniqueness(five_slots), boxes * 6 / 5, rtol=1e-6)
    full = mixture.replace(particles=(mixture.particles, age), log_weights=jnp.zeros(6))
    np.testing.assert_allclose(uniqueness(full), [1.0, 3 / 6, 2 / 6], rtol=1e-6)


def test_uniqueness_counts_as_numpy_does():
    rng = np.random.default_rng(0)
    states = rng.integers(0, 4, (200, 4, 3)).astype(float)
    mixture = make_mixture(states, np.zeros(200), np.zeros(200), 1)
    expected = [len(np.unique(states[:, j], axis=0)) / 200 for j in range(4)]
    np.testing.assert_allclose(jax.jit(uniqueness)(mixture), expected, rtol=1e-6)


def test_partitioned_sampling_impoverishes_the_first_objects_of_its_order():
    """As in figure 4: seven objects that walk with a deviation of 2 and are seen to half a unit."""
    one, noise = np.eye(2), 0.25 * np.eye(2)
    walk = mpfjax.LinearGaussianModel(one, 4 * one, one, noise, np.zeros(2), 4 * one)
    order = (2, 3, 4, 5, 6, 0, 1)
    filter = mpfjax.partitioned_sampling(mpfjax.MultiObjectModel(walk, 7), 300, order)
    rng = np.random.default_rng(0)
    seen = np.cumsum(rng.normal(0, 2, (10, 7, 2)), axis=0) + rng.normal(0, 0.5, (10, 7, 2))
    keys = jax.random.split(jax.random.key(1), 5)
    runs = mpfjax.monte_carlo(keys, filter, jnp.asarray(seen, jnp.float32), uniqueness)
    by_stage = np.asarray(runs.collected).mean(axis=(0, 1))[list(order)]
    assert (np.diff(by_stage) > 0).all()
    assert by_stage[0] < 0.05
    np.testing.assert_allclose(by_stage[-1], 1.0, rtol=1e-6)
