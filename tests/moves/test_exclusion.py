"""Exclusion does what its formula says."""

import equinox as eqx
import jax
import numpy as np

from mpfjax import QuadraticModel, Step
from mpfjax.moves.objects.exclusion import Exclusion
from tests.examples import make_mixture

NOW = Step(QuadraticModel(), np.float32(0.0))


def test_each_particle_is_weighed_down_by_the_other_components_means():
    states = np.array([[0.0], [1.0], [1.5], [9.0], [7.0]])
    log_weights = np.array([0.0, 1.0, 0.5, 0.0, -np.inf])
    mixture = make_mixture(states, log_weights, [0, 0, 1, 2, 2], 4)
    move = eqx.filter_jit(Exclusion(strength=3.0, radius=0.5, scale=2.0))
    moved = move(jax.random.key(0), mixture, NOW)
    means = np.array([0.5, 1.5, 9.0]) / 2
    bumps = np.exp(-((states / 2 - means[None]) ** 2) / (2 * 0.5**2))
    own = np.array([0, 0, 1, 2])
    expected = [bumps[i].sum() - bumps[i, own[i]] for i in range(4)]
    lowered = np.asarray(mixture.log_weights - moved.log_weights)[:4]
    np.testing.assert_allclose(lowered, 3.0 * np.array(expected), rtol=1e-5, atol=1e-6)
    assert moved.log_weights[4] == -np.inf
    np.testing.assert_array_equal(moved.particles, mixture.particles)
