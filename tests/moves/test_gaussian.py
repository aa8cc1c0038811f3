"""Gaussian regeneration redraws each component with its own moments; see `test_contracts.py`."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mpfjax import GaussianRegeneration
from tests.examples import AT_START, make_mixture
from tests.unbiased import assert_unbiased

NUM_DRAWS = 2000
RNG = np.random.default_rng(0)
LABELS = np.where(np.arange(30) % 3 == 0, 2, 0)
LABELS[5] = 1
# Two ordinary components, one of a single particle, and a dead one; an empty slot.
STATES = 3.0 * LABELS[:, None] + RNG.normal(size=(30, 2)) @ np.array([[1.0, 0.4], [0.0, 0.5]])
MIXTURE = make_mixture(
    STATES, np.where(np.arange(30) == 7, -np.inf, RNG.normal(size=30)), LABELS, 4
)


@eqx.filter_jit
def draw_many(move, mixture, num_draws=NUM_DRAWS):
    keys = jax.random.split(jax.random.key(1), num_draws)
    return jax.vmap(lambda key: move(key, mixture, AT_START))(keys)


@pytest.mark.exactness
@pytest.mark.parametrize("noise", ["independent", "stratified", "rqmc"])
def test_draws_have_the_moments_of_their_component(noise):
    after = draw_many(GaussianRegeneration(noise=noise), MIXTURE)
    labels = np.asarray(after.component_indicators[0])
    np.testing.assert_array_equal(np.bincount(labels, minlength=4), [10, 10, 10, 0])
    draws = np.asarray(after.particles)
    assert (draws[:, labels == 1] == np.float32(STATES[5])).all()
    means = np.asarray(MIXTURE.component_means())
    covariances = np.asarray(MIXTURE.component_covariances())
    # Independent over keys, whatever the noise within a draw; sorted draws have none alone.
    chosen = RNG.integers(0, 10, NUM_DRAWS)
    for m in (0, 2):
        one_each = draws[:, labels == m][np.arange(NUM_DRAWS), chosen]
        centred = one_each - means[m]
        products = centred[:, :, None] * centred[:, None, :]
        assert_unbiased(one_each, means[m])
        assert_unbiased(products, covariances[m])


@pytest.mark.exactness
def test_a_singular_covariance_draws_within_its_plane_and_where_leaves_the_rest_to_resampling():
    flat = {"box": MIXTURE.particles[:, :1] * jnp.array([[1.0, 2.0]]), "kind": 10 * LABELS}
    mixture = MIXTURE.replace(particles=jax.tree.map(jnp.asarray, flat))
    move = GaussianRegeneration(where=lambda states: states["box"])
    after = draw_many(move, mixture, 50)
    box = np.asarray(after.particles["box"])
    np.testing.assert_allclose(box[..., 1], 2 * box[..., 0], atol=1e-4)
    np.testing.assert_array_equal(after.particles["kind"], 10 * after.component_indicators)
    with pytest.raises(ValueError, match=r"where: the state\['kind'\] is int32"):
        GaussianRegeneration()(jax.random.key(0), mixture, AT_START)
