"""The random walk with jumps against SciPy's normal densities, and its draws against them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm

from mpfjax import RandomWalkWithJumps

NUM = 40_000
SHORT, LONG, P = np.array([0.5, 2.0]), np.array([3.0, 2.5]), 0.1
WALK = RandomWalkWithJumps(jnp.asarray(SHORT), jnp.asarray(LONG), P)
CURRENT = np.array([3.0, 0.5])


def repeated(vector, num):
    return jnp.tile(jnp.asarray(vector, jnp.result_type(float))[None], (num, 1))


def test_the_density_is_the_mixture_of_scipys():
    points = np.random.default_rng(0).normal(CURRENT, 3.0, (30, 2))
    stays, jumps = (norm(CURRENT, s).pdf(points).prod(axis=1) for s in (SHORT, LONG))
    found = WALK.log_density(jnp.asarray(points, jnp.float32), repeated(CURRENT, 30))
    np.testing.assert_allclose(found, np.log((1 - P) * stays + P * jumps), rtol=2e-4, atol=2e-4)


def test_draws_follow_the_mixture():
    """The share within each distance, in both coordinates at once, as they jump together."""
    steps = np.abs(WALK.sample(jax.random.key(0), repeated(CURRENT, NUM)) - CURRENT[None])
    for reach in ([0.5, 1.0], [1.5, 4.0], [4.0, 3.0]):
        stays, jumps = (np.prod(2 * norm(0, s).cdf(reach) - 1) for s in (SHORT, LONG))
        expected = (1 - P) * stays + P * jumps
        found = np.mean((steps < np.array(reach)).all(axis=1))
        assert abs(found - expected) < 4 * np.sqrt(expected * (1 - expected) / NUM)


def test_a_set_of_deviations_for_each_particle():
    rows = jax.tree.map(lambda leaf: jnp.stack([leaf, 2 * leaf]), WALK)
    assert WALK.is_shared
    assert not rows.is_shared
    places = repeated(CURRENT, 2)
    both = rows.log_density(places + 0.3, places)
    drawn = rows.sample(jax.random.key(1), places)
    for i in range(2):
        alone = jax.tree.map(lambda leaf, i=i: leaf[i], rows)
        np.testing.assert_allclose(both[i], alone.log_density(places + 0.3, places)[i], rtol=1e-5)
        np.testing.assert_allclose(drawn[i], alone.sample(jax.random.key(1), places)[i], rtol=1e-5)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: RandomWalkWithJumps(jnp.array([1.0, 0.0]), jnp.ones(2)), "deviations"),
        (lambda: RandomWalkWithJumps(jnp.ones(2), -jnp.ones(2)), "jump_deviations"),
        (lambda: RandomWalkWithJumps(jnp.ones(2), jnp.ones(3)), "jump_deviations: shape"),
        (lambda: RandomWalkWithJumps(jnp.ones(2), jnp.ones(2), 1.0), "jump_probability"),
    ],
)
def test_misuse_is_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()
