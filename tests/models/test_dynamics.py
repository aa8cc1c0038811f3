"""Dynamics against SciPy's densities, and draws against the moments of their equations."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal

from mpfjax import Autoregression, RandomWalk, RandomWalkWithJumps, WalkWithVelocity
from tests.marking import quick_of

NUM = 20_000
A1 = np.array([[1.2, 0.1], [0.0, 0.9]])
A2 = np.array([[-0.4, 0.0], [0.2, -0.3]])
B = np.array([[0.5, 0.0], [0.3, 0.8]])
MEAN = np.array([2.0, -1.0])
CURRENT, PREVIOUS = np.array([3.0, 0.5]), np.array([2.5, 1.0])
SHORT, LONG, P = np.array([0.5, 2.0]), np.array([3.0, 2.5]), 0.1
SMALL = [(1.0, np.diag(SHORT**2))]
BOTH = [(1 - P, np.diag(SHORT**2)), (P, np.diag(LONG**2))]
JUMPS = RandomWalkWithJumps(SHORT, LONG, P)

# By name: the dynamics, the mean of x_t, and shares and covariances of the normals it is made of.
CASES = {
    "random walk": (RandomWalk(SHORT), CURRENT, SMALL),
    "jumps": (JUMPS, CURRENT, BOTH),
    "autoregression": (
        Autoregression(A1, A2, B, MEAN),
        MEAN + A1 @ (CURRENT - MEAN) + A2 @ (PREVIOUS - MEAN),
        [(1.0, B @ B.T)],
    ),
    "momentum": (
        Autoregression.with_momentum(0.5, jnp.asarray(SHORT)),
        CURRENT + 0.5 * (CURRENT - PREVIOUS),
        SMALL,
    ),
    "velocity": (WalkWithVelocity(JUMPS, (0.2, 0.0), [0.0, 0.0]), 2 * CURRENT - PREVIOUS, BOTH),
}  # fmt: skip


def repeated(vector, num):
    return jnp.tile(jnp.asarray(vector, jnp.result_type(float))[None], (num, 1))


@pytest.mark.parametrize("name", CASES)
def test_draws_have_the_moments_of_the_equation(name):
    """Those of fresh noise, and those made of noise that is given."""
    dynamics, mean, normals = CASES[name]
    covariance = sum(share * own for share, own in normals)
    places = repeated(CURRENT, NUM), repeated(PREVIOUS, NUM)
    noise = jax.random.normal(jax.random.key(1), (NUM, dynamics.noise_dimension))
    for draws in (dynamics.sample(jax.random.key(0), *places), dynamics.from_noise(noise, *places)):
        away = np.asarray(draws, float) - mean
        error = np.sqrt(np.diag(covariance) / NUM)
        assert (np.abs(away.mean(axis=0)) < 4 * error).all()
        products = away[:, :, None] * away[:, None]
        bound = 4.5 * products.std(axis=0) / NUM**0.5
        np.testing.assert_array_less(np.abs(products.mean(axis=0) - covariance), bound)


@pytest.mark.parametrize("name", CASES)
def test_the_density_is_scipys(name):
    dynamics, mean, normals = CASES[name]
    points = np.random.default_rng(0).normal(mean, 1.5, (30, 2))
    places = repeated(CURRENT, 30), repeated(PREVIOUS, 30)
    found = dynamics.log_density(jnp.asarray(points, jnp.float32), *places)
    expected = sum(share * multivariate_normal(mean, own).pdf(points) for share, own in normals)
    np.testing.assert_allclose(found, np.log(expected), rtol=2e-4, atol=2e-4)


@pytest.mark.parametrize("name", quick_of(CASES, ["autoregression", "velocity"]))
def test_a_set_of_parameters_for_each_particle(name):
    """Two particles of different dynamics, as each would be on its own."""
    dynamics, _, _ = CASES[name]
    rows = jax.tree.map(lambda leaf: jnp.stack([leaf, 2 * leaf]), dynamics)
    assert dynamics.is_shared
    assert not rows.is_shared
    places = repeated(CURRENT, 2) + 0.3, repeated(CURRENT, 2), repeated(PREVIOUS, 2)
    both, drawn = rows.log_density(*places), rows.sample(jax.random.key(1), *places[1:])
    for i in range(2):
        alone = jax.tree.map(lambda leaf, i=i: leaf[i], rows)
        np.testing.assert_allclose(both[i], alone.log_density(*places)[i], rtol=1e-5)
        own = alone.sample(jax.random.key(1), *places[1:])[i]
        np.testing.assert_allclose(drawn[i], own, rtol=1e-5)


@pytest.mark.parametrize("gain", [0.0, 0.1, 1.0])
def test_a_path_has_the_density_of_a_random_walk_velocity_seen_in_noise(gain):
    """Displacements y_t = u_t + e_t of a velocity u_t = u_{t-1} + w_t, in the steady state.

    There the variance of u given the past is K S, of e (1 - K) S and of w K² S, for the gain K and
    the variance S of a step. With a gain of one it is constant velocity.
    """
    places = np.cumsum(np.random.default_rng(0).normal(0.4, 0.6, 13))
    velocity, S, t = 0.7, 0.5**2, np.arange(12)
    dynamics = WalkWithVelocity(RandomWalk([0.5]), gain, [0.0])
    found, past = 0.0, jnp.full((1, 1), places[0] - velocity)
    for before, now in itertools.pairwise(places):
        before, now = jnp.full((1, 1), before), jnp.full((1, 1), now)
        found += float(dynamics.log_density(now, before, past)[0])
        past = dynamics.remembered(now, before, past)
    covariance = gain * S + gain**2 * S * np.minimum(t[:, None], t) + (1 - gain) * S * np.eye(12)
    displacements = np.diff(places)
    expected = multivariate_normal(np.full(12, velocity), covariance).logpdf(displacements)
    np.testing.assert_allclose(found, expected, rtol=1e-4)
    # What is remembered is one step back at the velocity expected next, the normal's conditional.
    across = gain * S + gain**2 * S * t  # of the velocity expected next and each y_s
    next_velocity = velocity + across @ np.linalg.solve(covariance, displacements - velocity)
    np.testing.assert_allclose(places[-1] - float(past[0, 0]), next_velocity, atol=2e-4)


def test_each_coordinate_has_its_gain_and_its_velocity_at_the_start():
    current, past, point = jnp.array([[[3.0, 1.0]], [[2.0, 2.0]], [[4.5, 0.5]]])
    dynamics, _, _ = CASES["velocity"]
    # The first coordinate learns a fifth of its surprise, the second nothing.
    np.testing.assert_allclose(point - dynamics.remembered(point, current, past), [[1.1, -1.0]])
    rows = jnp.ones((4000, 2))
    moving = WalkWithVelocity(RandomWalk([1.0, 1.0]), 0.1, [2.0, 0.0])
    velocity = np.asarray(rows - moving.initial_past(jax.random.key(0), rows))
    assert abs(velocity[:, 0].std() - 2.0) < 4 * 2.0 / np.sqrt(2 * 4000)
    assert abs(velocity[:, 0].mean()) < 4 * 2.0 / np.sqrt(4000)
    np.testing.assert_array_equal(velocity[:, 1], 0.0)
