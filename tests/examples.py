"""Mixtures made by hand, each with something that goes wrong easily, and weighted sums of them."""

import jax
import jax.numpy as jnp
import numpy as np

import mpfjax
from mpfjax import ParticleMixture
from mpfjax.mixture import single_component

NUM_PARTICLES = 40
NUM_COMPONENTS = 6
AT_START = mpfjax.Step(None, None, is_initial=True)  # where every move runs, whatever the model


def make_mixture(states, log_weights, labels, num_components, memory=None) -> ParticleMixture:
    """A normalised mixture from arrays of numpy, each slot its own ancestor."""
    log_weights = np.asarray(log_weights, float)
    log_weights = log_weights - np.logaddexp.reduce(log_weights)
    return single_component(jnp.asarray(states, float), num_components).replace(
        log_weights=jnp.asarray(log_weights, float),
        component_indicators=jnp.asarray(labels, jnp.int32),
        memory={} if memory is None else memory,
    )


def example_mixtures(m: int = NUM_COMPONENTS) -> dict[str, ParticleMixture]:
    """Forty particles in the plane with up to m components."""
    rng = np.random.default_rng(0)
    n = NUM_PARTICLES
    labels = rng.integers(0, m, n)
    centres = 4 * rng.normal(size=(m, 2))
    states = centres[labels] + rng.normal(size=(n, 2))
    ordinary = rng.normal(size=n)
    empty = rng.random(n) < 0.3
    two_dead = np.where(np.isin(labels, [2, 5]), -np.inf, ordinary)
    lonely = np.full(n, -np.inf)
    lonely[17] = 0.0
    stale = np.where(empty[:, None], np.nan, states)
    return {
        "ordinary": make_mixture(states, ordinary, labels, m),
        "equal weights": make_mixture(states, np.zeros(n), labels, m),
        "one component": make_mixture(states, ordinary, np.full(n, min(3, m - 1)), m),
        "dead components": make_mixture(states, two_dead, labels, m),
        "empty slots with stale states": make_mixture(
            stale, np.where(empty, -np.inf, ordinary), labels, m
        ),
        "all mass in one particle": make_mixture(states, lonely, labels, m),
        "masses 200 nats apart": make_mixture(states, ordinary - 200.0 * labels, labels, m),
        "weights 100 nats apart": make_mixture(states, 30 * ordinary, labels, m),
        "identical particles": make_mixture(np.ones((n, 2)), ordinary, labels, m),
    }


def log_masses(mixture: ParticleMixture) -> np.ndarray:
    """log π_m by numpy in double precision, -inf for a dead component."""
    log_weights = np.asarray(mixture.log_weights, float)
    labels = np.asarray(mixture.component_indicators)
    return np.array(
        [
            np.logaddexp.reduce(log_weights[labels == m], initial=-np.inf)
            for m in range(mixture.num_components)
        ]
    )


def walker(mean=0.0, noise=0.5):
    """One linear-Gaussian object on a line."""
    one = jnp.eye(1)
    return mpfjax.LinearGaussianModel(
        0.9 * one, 0.4 * one, one, noise * one, jnp.array([mean]), one
    )


def stack(models):
    """One model with an axis of objects in front, from a model for each."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *models)


def two_walkers(num_frames: int) -> np.ndarray:
    """Rows (frame, id, x, y, w, h) of two boxes that walk towards each other, one above."""
    t = np.arange(num_frames)
    one = np.column_stack([t + 1, 0 * t + 1, 4 + 3 * t, 0 * t + 5, 0 * t + 8, 0 * t + 14])
    two = np.column_stack([t + 1, 0 * t + 2, 50 - 3 * t, 0 * t + 28, 0 * t + 8, 0 * t + 14])
    return np.concatenate([one, two]).astype(float)
