"""Dynamics against SciPy's densities, and draws against their own density."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import solve_discrete_lyapunov
from scipy.stats import multivariate_normal

from mpfjax import Autoregression, RandomWalk

NUM = 20_000
A1 = np.array([[1.2, 0.1], [0.0, 0.9]])
A2 = np.array([[-0.4, 0.0], [0.2, -0.3]])
B = np.array([[0.5, 0.0], [0.3, 0.8]])
MEAN = np.array([2.0, -1.0])
CURRENT, PREVIOUS = np.array([3.0, 0.5]), np.array([2.5, 1.0])

WALK = RandomWalk(jnp.array([0.5, 2.0]))
CASES = {
    "random walk": (WALK, CURRENT, np.diag([0.25, 4.0])),
    "autoregression": (
        Autoregression(*map(jnp.asarray, (A1, A2, B, MEAN))),
        MEAN + A1 @ (CURRENT - MEAN) + A2 @ (PREVIOUS - MEAN),
        B @ B.T,
    ),
    "momentum": (
        Autoregression.with_momentum(0.5, jnp.array([0.5, 2.0])),
        CURRENT + 0.5 * (CURRENT - PREVIOUS),
        np.diag([0.25, 4.0]),
    ),
}


def repeated(vector, num):
    return jnp.tile(jnp.asarray(vector, jnp.result_type(float))[None], (num, 1))


@pytest.mark.parametrize("name", CASES)
def test_draws_have_the_moments_of_the_equation(name):
    dynamics, mean, covariance = CASES[name]
    draws = dynamics.sample(jax.random.key(0), repeated(CURRENT, NUM), repeated(PREVIOUS, NUM))
    error = np.sqrt(np.diag(covariance) / NUM)
    assert (np.abs(np.asarray(draws).mean(axis=0) - mean) < 4 * error).all()
    found = np.cov(np.asarray(draws).T)
    scale = np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)) * 2 / NUM)
    assert (np.abs(found - covariance) < 5 * scale).all()


@pytest.mark.parametrize("name", CASES)
def test_the_density_is_scipys(name):
    dynamics, mean, covariance = CASES[name]
    points = np.random.default_rng(0).normal(mean, 1.5, (30, 2))
    found = dynamics.log_density(
        jnp.asarray(points, jnp.float32), repeated(CURRENT, 30), repeated(PREVIOUS, 30)
    )
    expected = multivariate_normal(mean, covariance).logpdf(points)
    np.testing.assert_allclose(np.asarray(found), expected, rtol=2e-4, atol=2e-4)


@pytest.mark.parametrize("name", CASES)
def test_a_set_of_parameters_for_each_particle(name):
    """Two particles of different dynamics, as each would be on its own."""
    dynamics, _, _ = CASES[name]
    rows = jax.tree.map(lambda leaf: jnp.stack([leaf, 2 * leaf]), dynamics)
    assert dynamics.is_shared
    assert not rows.is_shared
    args = (repeated(CURRENT, 2) + 0.3, repeated(CURRENT, 2), repeated(PREVIOUS, 2))
    both = rows.log_density(*args)
    for i in range(2):
        alone = jax.tree.map(lambda leaf, i=i: leaf[i], rows)
        np.testing.assert_allclose(both[i], alone.log_density(*args)[i], rtol=1e-5)
        drawn = [d.sample(jax.random.key(1), *args[1:])[i] for d in (rows, alone)]
        np.testing.assert_allclose(drawn[0], drawn[1], rtol=1e-5)


@pytest.mark.parametrize("name", CASES)
def test_moments_are_those_of_the_equation(name):
    dynamics, mean, covariance = CASES[name]
    found = dynamics.moments(repeated(CURRENT, 3), repeated(PREVIOUS, 3))
    for values, expected in zip(found, (mean, np.sqrt(np.diag(covariance))), strict=True):
        np.testing.assert_allclose(values, np.tile(expected, (3, 1)), rtol=1e-5)


def test_an_autoregression_settles_at_the_stationary_distribution():
    """Eq. 4: the mean is x̄, and the covariance that of SciPy's Lyapunov equation.

    The pair (x_t, x_{t-1}) is one vector that moves by the companion matrix.
    """
    companion = np.block([[A1, A2], [np.eye(2), np.zeros((2, 2))]])
    assert np.abs(np.linalg.eigvals(companion)).max() < 0.95
    noise = np.zeros((4, 4))
    noise[:2, :2] = B @ B.T
    expected = solve_discrete_lyapunov(companion, noise)
    dynamics, _, _ = CASES["autoregression"]

    @jax.jit
    def settled(key, current, previous):
        def step(pair, key):
            return (dynamics.sample(key, *pair), pair[0]), None

        return jax.lax.scan(step, (current, previous), jax.random.split(key, 120))[0]

    start = repeated([10.0, 10.0], NUM)
    pair = np.concatenate(settled(jax.random.key(3), start, start), axis=1)
    centred = pair - np.tile(MEAN, 2)
    error = np.sqrt(np.diag(expected) / NUM)
    assert (np.abs(centred.mean(axis=0)) < 4 * error).all()
    products = centred[:, :, None] * centred[:, None, :]
    bound = 4.5 * products.std(axis=0) / NUM**0.5
    np.testing.assert_array_less(np.abs(products.mean(axis=0) - expected), bound)


def test_dynamics_in_units_far_apart_keep_their_density():
    """Pixels beside shares of a box, a parameter set for each of many particles."""
    scales = np.array([30.0, 20.0, 0.01, 0.02])
    noise = scales[:, None] * (np.eye(4) + 0.3 * np.tri(4, k=-1)).astype(np.float32)
    one = Autoregression(
        jnp.eye(4), jnp.zeros((4, 4)), jnp.asarray(noise, jnp.float32), jnp.zeros(4)
    )
    rows = jax.tree.map(lambda leaf: jnp.tile(leaf[None], (50,) + (1,) * leaf.ndim), one)
    points = np.random.default_rng(0).normal(0, scales, (50, 4))
    found = rows.log_density(
        jnp.asarray(points, jnp.float32), jnp.zeros((50, 4)), jnp.zeros((50, 4))
    )
    expected = multivariate_normal(np.zeros(4), noise @ noise.T).logpdf(points)
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=2e-3)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: RandomWalk(jnp.array([1.0, 0.0])), "deviations"),
        (lambda: Autoregression.with_momentum(0.5, jnp.array([-1.0])), "deviations"),
        (lambda: Autoregression(A1, A2[:1], B, MEAN), "A2: shape"),
        (lambda: Autoregression(A1, A2, B, MEAN[:1]), "A1: shape"),
        (lambda: CASES["momentum"][0].sample(jax.random.key(0), repeated(CURRENT, 2)), "previous"),
    ],
)
def test_misuse_is_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()
