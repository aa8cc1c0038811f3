"""A small switching model, a short series of it, and the exact answer, shared by several tests."""

from functools import cache
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

import mpfjax
from mpfjax.exact import switching_filter

NUM_REGIMES = 3
TRANSITIONS = np.array([[0.85, 0.1, 0.05], [0.1, 0.8, 0.1], [0.05, 0.15, 0.8]])
PARTS = {
    "F": [[[1, 0.5], [0, 0.9]], [[0.7, -0.4], [0.4, 0.7]], [[0.5, 0.0], [0.2, 1.0]]],
    "Q": [[[0.1, 0], [0, 0.1]], [[0.5, 0], [0, 0.5]], [[0.3, 0.1], [0.1, 0.2]]],
    "H": [[1.0, 0.0]],
    "R": [[[0.2]], [[0.4]], [[0.1]]],
    "m0": [0.2, -0.1],
    "P0": [[1.0, 0.2], [0.2, 0.8]],
    "b": [[0.0, 0.0], [0.5, 0.0], [-0.5, 0.3]],
}
INITIAL = np.array([0.5, 0.2, 0.3])
MODEL = mpfjax.SwitchingLinearGaussianModel(
    TRANSITIONS, initial_probabilities=INITIAL, **{k: np.array(v) for k, v in PARTS.items()}
)
OBSERVATIONS = jnp.array([[0.3], [1.2], [-0.8], [-1.5], [0.2], [1.4], [0.9]])


class Truth(NamedTuple):
    """At every step: log p(y_1..y_s), P(z_s), E[x_s] and E[x_s x_sᵀ] given y_1..y_s."""

    log_evidence: np.ndarray
    regimes: np.ndarray
    first: np.ndarray
    second: np.ndarray


@cache
def truth() -> Truth:
    run = switching_filter(MODEL, OBSERVATIONS)
    first = np.asarray(run.means)
    second = np.asarray(run.covariances) + first[:, :, None] * first[:, None, :]
    log_evidence = np.cumsum(np.asarray(run.log_likelihood_increments))
    return Truth(log_evidence, np.asarray(run.regime_probabilities), first, second)


def regimes(mixture):
    """The probability of each regime."""
    latent = mixture.particles.latent
    return jnp.stack([mixture.expectation(latent == k) for k in range(NUM_REGIMES)])


def moments(mixture):
    """What `truth` has of a mixture."""
    state = mixture.mean()
    second = state.covariance + state.mean[:, None] * state.mean[None]
    return regimes(mixture), state.mean, second
