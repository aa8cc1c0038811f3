"""The walk with a velocity against the joint normal density of a path, with no recursion at all."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal, norm

from mpfjax import Autoregression, RandomWalk, RandomWalkWithJumps, WalkWithVelocity

STEP, NUM_STEPS = 0.5, 12


def path(seed=0):
    return np.cumsum(np.random.default_rng(seed).normal(0.4, 0.6, NUM_STEPS + 1))


def log_density_of(dynamics, places, past):
    """The sum of the log densities of the steps, carrying the past along."""
    total, past = 0.0, jnp.full((1, 1), past)
    for before, now in itertools.pairwise(places):
        before, now = jnp.full((1, 1), before), jnp.full((1, 1), now)
        total += float(dynamics.log_density(now, before, past)[0])
        past = dynamics.remembered(now, before, past)
    return total, float(past[0, 0])


@pytest.mark.parametrize("gain", [0.0, 0.1, 0.6, 1.0])
def test_a_path_has_the_density_of_a_random_walk_velocity_seen_in_noise(gain):
    """Displacements y_t = u_t + e_t of a velocity u_t = u_{t-1} + w_t, in the steady state.

    There the variance of u given the past is K S, of e (1 - K) S and of w K² S, for the gain K and
    the variance S of a step.
    """
    places, velocity = path(), 0.7
    dynamics = WalkWithVelocity(RandomWalk([STEP]), gain)
    found, past = log_density_of(dynamics, places, places[0] - velocity)
    t = np.arange(NUM_STEPS)
    S = STEP**2
    covariance = (
        gain * S + gain**2 * S * np.minimum(t[:, None], t) + (1 - gain) * S * np.eye(len(t))
    )
    displacements = np.diff(places)
    expected = multivariate_normal(np.full(NUM_STEPS, velocity), covariance).logpdf(displacements)
    np.testing.assert_allclose(found, expected, rtol=1e-4)
    # What is remembered is one step back at the velocity expected next, the normal's conditional.
    across = gain * S + gain**2 * S * t  # of the velocity expected next and each y_s
    next_velocity = velocity + across @ np.linalg.solve(covariance, displacements - velocity)
    np.testing.assert_allclose(places[-1] - past, next_velocity, atol=2e-4)


def test_a_gain_of_one_is_constant_velocity_with_momentum_one():
    momentum = Autoregression.with_momentum(1.0, jnp.array([STEP]))
    velocity = WalkWithVelocity(RandomWalk([STEP]), 1.0)
    places = path(1)
    found = [log_density_of(dynamics, places, 0.0)[0] for dynamics in (momentum, velocity)]
    np.testing.assert_allclose(*found, rtol=1e-5)


def test_long_steps_are_those_of_the_walk():
    walk = RandomWalkWithJumps([0.5, 2.0], [3.0, 2.5], 0.1)
    dynamics = WalkWithVelocity(walk, (0.2, 0.0))
    current, past, point = jnp.array([[[3.0, 1.0]], [[2.0, 2.0]], [[4.5, 0.5]]])
    centre = np.array([4.0, 0.0])
    expected = [norm(centre, s).pdf(np.asarray(point[0])).prod() for s in ([0.5, 2], [3, 2.5])]
    np.testing.assert_allclose(
        dynamics.log_density(point, current, past)[0],
        np.log(0.9 * expected[0] + 0.1 * expected[1]), rtol=1e-5,
    )  # fmt: skip
    mean, deviations = dynamics.moments(current, past)
    np.testing.assert_allclose(mean[0], [4.0, 0.0])
    np.testing.assert_allclose(deviations, walk.moments(current)[1])
    # The first coordinate learns a fifth of its surprise, the second nothing.
    np.testing.assert_allclose(point - dynamics.remembered(point, current, past), [[1.1, -1.0]])


def test_velocities_at_the_start():
    rows = jnp.ones((4000, 2))
    resting = WalkWithVelocity(RandomWalk([1.0, 1.0]))
    np.testing.assert_array_equal(resting.initial_past(jax.random.key(0), rows), rows)
    moving = WalkWithVelocity(RandomWalk([1.0, 1.0]), 0.1, jnp.array([2.0, 0.0]))
    velocity = np.asarray(rows - moving.initial_past(jax.random.key(0), rows))
    assert abs(velocity[:, 0].std() - 2.0) < 4 * 2.0 / np.sqrt(2 * 4000)
    assert abs(velocity[:, 0].mean()) < 4 * 2.0 / np.sqrt(4000)
    np.testing.assert_array_equal(velocity[:, 1], 0.0)


@pytest.mark.parametrize(
    ("error", "message", "make"),
    [
        (TypeError, "walk: ", lambda walk: WalkWithVelocity(None)),
        (ValueError, r"gain: \(1.5,\)", lambda walk: WalkWithVelocity(walk, 1.5)),
        (ValueError, "gain: .* is not one or 2", lambda walk: WalkWithVelocity(walk, (0.1,) * 3)),
        (
            ValueError,
            "initial_velocity: ",
            lambda walk: WalkWithVelocity(walk, 0.1, jnp.array([-1.0, 1])),
        ),
        (
            ValueError,
            "initial_velocity: shape",
            lambda walk: WalkWithVelocity(walk, 0.1, jnp.ones(1)),
        ),
        (
            ValueError,
            "previous: ",
            lambda walk: WalkWithVelocity(walk).moments(jnp.ones((1, 2))),
        ),
    ],
)
def test_misuse_is_named(error, message, make):
    with pytest.raises(error, match=message):
        make(RandomWalk([1.0, 2.0]))
