"""Backward sampling says where it degenerates: a state of two times, whose density is a delta.

An odometer sees x_t - x_{t-1}. All is linear and Gaussian, so numpy knows x given y.
"""

import warnings
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.scipy.stats import norm

import mpfjax
from mpfjax.smoothing import sample_trajectories
from tests.marking import thorough

LENGTH = 30
KEPT, NOISE, ERROR = 0.9, 0.5, 0.3
STEPS = np.random.default_rng(0).normal(0, 0.5, LENGTH).astype(np.float32)


class Odometer(mpfjax.AbstractStateSpaceModel):
    """The state of two times."""

    def sample_initial(self, key, num_particles):
        now = jax.random.normal(key, (num_particles,))
        return {"now": now, "before": now}

    def sample_transition(self, key, states):
        noise = NOISE * jax.random.normal(key, states["now"].shape)
        return {"now": KEPT * states["now"] + noise, "before": states["now"]}

    def log_transition(self, states, previous_states):
        density = norm.logpdf(states["now"], KEPT * previous_states["now"], NOISE)
        return jnp.where(states["before"] == previous_states["now"], density, -jnp.inf)

    def log_likelihood(self, observation, states):
        return norm.logpdf(observation, states["now"] - states["before"], ERROR)


class Past(Odometer):
    """x_t alone, whose density takes in the likelihood."""

    inputs: Any = None

    def log_transition(self, states, previous_states):
        density = norm.logpdf(states, KEPT * previous_states, NOISE)
        return density + norm.logpdf(self.inputs, states - previous_states, ERROR)


def only_now(mixture):
    return mixture.replace(particles=mixture.particles["now"])


def test_a_delta_is_warned_of_with_the_share_of_distinct_trajectories():
    run = mpfjax.run_filter(jax.random.key(0), mpfjax.particle_filter(Odometer(), 200), STEPS)
    with pytest.warns(RuntimeWarning, match="backward weights degenerate") as caught:
        paths = sample_trajectories(jax.random.key(1), Odometer(), run, 200)
    num_distinct = len(np.unique(paths["now"][:, 0]))
    assert num_distinct < 20
    share = f"a share of {num_distinct / 200:.2g}"
    assert f"{num_distinct} of the 200 trajectories are distinct, {share}" in str(caught[0].message)
    mixtures = jax.vmap(only_now)(run.collected)
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        paths = sample_trajectories(jax.random.key(1), Past(), mixtures, 200, inputs=STEPS)
    assert min(len(np.unique(column)) for column in np.asarray(paths).T) > 20


class Known(mpfjax.AbstractStateSpaceModel):
    """Every particle starts at 0, and few fit what is seen at first."""

    def sample_initial(self, key, num_particles):
        return jnp.zeros(num_particles)

    def sample_transition(self, key, states):
        return states + jax.random.normal(key, states.shape)

    def log_transition(self, states, previous_states):
        return norm.logpdf(states, previous_states)

    def log_likelihood(self, observation, states):
        return norm.logpdf(observation, states, 0.02)


@pytest.mark.parametrize("number", thorough([200, 3000]))
@pytest.mark.parametrize("method", ["exact", "mcmc"])
def test_few_states_that_have_many_pasts_are_no_reason(number, method):
    observations = np.cumsum(np.random.default_rng(1).normal(size=20)).astype(np.float32)
    run = mpfjax.run_filter(jax.random.key(0), mpfjax.particle_filter(Known(), 300), observations)
    options = {} if method == "exact" else {"method": "mcmc", "num_steps": 20}
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        paths = sample_trajectories(jax.random.key(1), Known(), run, number, **options)
    assert min(len(np.unique(column)) for column in np.asarray(paths).T[1:]) < 20


@pytest.mark.parametrize("num_seeds", thorough([60]))
def test_a_density_that_takes_in_the_likelihood_smooths_exactly(num_seeds):
    """Means over seeds within 4 standard errors of E[x_t | y], from the joint normal law."""
    length = 8
    moves = np.eye(length + 1) - KEPT * np.eye(length + 1, k=-1)
    sees = np.eye(length, length + 1, k=1) - np.eye(length, length + 1)
    precision = moves.T @ np.diag([1.0] + [NOISE**-2] * length) @ moves + sees.T @ sees / ERROR**2
    expected = np.linalg.solve(precision, sees.T @ STEPS[:length] / ERROR**2)
    filter = mpfjax.particle_filter(Odometer(), 500)
    seen = jnp.asarray(STEPS[:length])

    def mean(key):
        of_run, of_paths = jax.random.split(key)
        run = mpfjax.run_filter(of_run, filter, seen, only_now)
        paths = sample_trajectories(of_paths, Past(), run.collected, 500, inputs=seen)
        return paths.mean(axis=0)

    means = np.asarray(jax.lax.map(jax.jit(mean), jax.random.split(jax.random.key(2), num_seeds)))
    errors = means.std(axis=0) / np.sqrt(num_seeds)
    assert (errors < 0.03).all()
    assert (np.abs(means.mean(axis=0) - expected[1:]) < 4 * errors).all()
