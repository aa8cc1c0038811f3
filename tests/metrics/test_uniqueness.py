"""Distinct hypotheses, by hand and as numpy counts them."""

import jax.numpy as jnp
import numpy as np

from mpfjax.metrics.particle_scores import uniqueness
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
