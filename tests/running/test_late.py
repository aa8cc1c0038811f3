"""A measurement that arrives late, against one in time and against the Kalman filter."""

import jax
import numpy as np
import pytest

import mpfjax
from mpfjax.exact import kalman_filter

MODEL = mpfjax.LinearGaussianModel(A=[[0.9]], Q=[[0.5]], H=[[1.0]], R=[[0.3]], m0=[0.0], P0=[[1.0]])
SEEN = np.float32([[0.5], [1.2], [-2.0], [0.4], [0.9], [1.1]])
FILTER = mpfjax.mixture_particle_filter(MODEL, 4000, 2, regroup_every=2)
KEYS = jax.random.split(jax.random.key(0), 1 + len(SEEN))
LATE = 2  # index of the step whose measurement comes after all others


def histories(lag):
    """One that lacks a measurement, and one that has it in time."""
    replay = mpfjax.Replay(FILTER, lag)
    lacking = in_time = replay.init(FILTER.init(KEYS[0]))
    increments = []
    for t, (key, seen) in enumerate(zip(KEYS[1:], SEEN, strict=True)):
        lacking, _ = replay.step(key, lacking, None if t == LATE else seen)
        in_time, info = replay.step(key, in_time, seen)
        increments.append(info.log_likelihood_increment)
    return replay, lacking, in_time, increments


def test_steps_taken_again_are_those_of_a_filter_that_had_it_in_time_to_the_bit():
    replay, lacking, in_time, increments = histories(lag=4)
    found, infos = replay.late(lacking, SEEN[LATE], steps_ago=3)
    for own, other in zip(*map(jax.tree.leaves, (found, in_time)), strict=True):
        if jax.dtypes.issubdtype(own.dtype, jax.dtypes.prng_key):
            own, other = map(jax.random.key_data, (own, other))
        np.testing.assert_array_equal(own, other)
    again = [info.log_likelihood_increment for info in infos]
    np.testing.assert_array_equal(again, increments[LATE:])
    exact = kalman_filter(MODEL, SEEN)
    mean, error = float(exact.means[-1, 0]), float(exact.covariances[-1, 0, 0]) ** 0.5
    assert float(found.mixture.mean()[0]) == pytest.approx(mean, abs=6 * error / 4000**0.5)
    assert (lacking.mixture.log_weights != found.mixture.log_weights).any()
    with pytest.raises(ValueError, match="steps_ago: 4, and 4 steps are stored"):
        replay.late(found, SEEN[1], 4)
