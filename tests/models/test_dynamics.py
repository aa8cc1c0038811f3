"""Dynamics against SciPy's densities, and draws against their own density."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
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
