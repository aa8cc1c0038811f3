"""Backward sampling says where it degenerates: a state of two times, whose density is a delta."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.scipy.stats import norm

import mpfjax
from mpfjax.smoothing import sample_trajectories

STEPS = np.random.default_rng(0).normal(0, 0.5, 30).astype(np.float32)


class Odometer(mpfjax.AbstractStateSpaceModel):
    """The state of two times; x_t - x_{t-1} is seen."""

    def sample_initial(self, key, num_particles):
        now = jax.random.normal(key, (num_particles,))
        return {"now": now, "before": now}

    def sample_transition(self, key, states):
        noise = 0.5 * jax.random.normal(key, states["now"].shape)
        return {"now": 0.9 * states["now"] + noise, "before": states["now"]}

    def log_transition(self, states, previous_states):
        density = norm.logpdf(states["now"], 0.9 * previous_states["now"], 0.5)
        return jnp.where(states["before"] == previous_states["now"], density, -jnp.inf)

    def log_likelihood(self, observation, states):
        return norm.logpdf(observation, states["now"] - states["before"], 0.3)


def test_a_delta_is_warned_of_with_the_share_of_distinct_trajectories():
    filter = mpfjax.particle_filter(Odometer(), 200)
    run = mpfjax.run_filter(jax.random.key(0), filter, STEPS)
    with pytest.warns(RuntimeWarning, match="backward weights degenerate") as caught:
        paths = sample_trajectories(jax.random.key(1), filter, run, 200)
    num_distinct = len(np.unique(paths["now"][:, 0]))
    assert caught[0].filename == __file__
    assert num_distinct < 20
    share = f"a share of {num_distinct / 200:.2g}"
    assert f"{num_distinct} of the 200 trajectories are distinct, {share}" in str(caught[0].message)


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


@pytest.mark.exactness
def test_few_states_that_have_many_pasts_are_no_reason():
    observations = np.cumsum(np.random.default_rng(1).normal(size=20)).astype(np.float32)
    filter = mpfjax.particle_filter(Known(), 300)
    run = mpfjax.run_filter(jax.random.key(0), filter, observations)
    with warnings.catch_warnings(action="error", category=RuntimeWarning):
        paths = sample_trajectories(jax.random.key(1), filter, run, 1000)
    assert min(len(np.unique(column)) for column in np.asarray(paths).T[1:]) < 20
