"""Families of draws; that all chains are unbiased is in `tests/together/test_chains.py`."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax import Propagate, PropagateNested
from tests.examples import make_mixture
from tests.unbiased import assert_unbiased


class Marked(mpfjax.AbstractStateSpaceModel):
    """A state that is one of few numbers beside its parent's place, and the likelihood of each."""

    likelihoods: jax.Array

    noise_dimension = 1

    def sample_initial(self, key, num_particles):
        return jnp.zeros((num_particles, 2), jnp.int32)

    def transition_from_noise(self, noise, states):
        share = jax.scipy.special.ndtr(noise[:, 0])
        drawn = jnp.clip((share * len(self.likelihoods)).astype(jnp.int32), 0, 3)
        return jnp.stack([drawn, states[:, 1]], axis=1)

    def log_likelihood(self, observation, states):
        return jnp.log(self.likelihoods[states[:, 0]]) + 0 * observation


LIKELIHOODS = jnp.array([0.0, 1.0, 2.0, 5.0])
LABELS = np.array([0, 0, 1, 1, 1, 2])


@pytest.mark.exactness
@pytest.mark.parametrize("noise", ["rqmc", "independent"])
def test_weights_are_means_and_draws_are_kept_by_theirs(noise):
    """E[weight of those that keep a value] is its likelihood, for every value, one of them zero."""
    move = PropagateNested(Propagate(noise=noise), 5)
    now = mpfjax.Step(Marked(LIKELIHOODS), jnp.float32(0))
    mixture = make_mixture(np.zeros((6, 2)), np.arange(6.0) / 5, LABELS, 3)
    places = jnp.stack([jnp.zeros(6, jnp.int32), jnp.arange(6, dtype=jnp.int32)], axis=1)
    mixture = mixture.replace(particles=places)

    @jax.jit
    @jax.vmap
    def masses(key):
        moved = move(key, mixture, now)
        weights = jnp.exp(moved.log_weights + moved.log_scale)
        kept = jax.nn.one_hot(moved.particles[:, 0], 4)
        return weights[:, None] * kept, moved.particles[:, 1]

    found, parents = map(np.asarray, masses(jax.random.split(jax.random.key(0), 4000)))
    assert (parents == np.arange(6)).all()
    expected = np.asarray(mixture.weights)[:, None] * np.asarray(LIKELIHOODS)[None] / 4
    assert_unbiased(found, expected)
    assert found[..., 0].max() == 0


def test_an_empty_slot_and_a_hopeless_family_stay_without_weight():
    mixture = make_mixture(np.zeros((4, 2)), [0.0, -np.inf, 0.0, 0.0], [0, 0, 1, 1], 2)
    mixture = mixture.replace(particles=jnp.zeros((4, 2), jnp.int32))

    @eqx.filter_jit
    def moved(likelihoods):
        now = mpfjax.Step(Marked(likelihoods), jnp.float32(0))
        return PropagateNested(Propagate(), 3)(jax.random.key(0), mixture, now).log_weights

    assert (np.asarray(moved(0 * LIKELIHOODS)) == -np.inf).all()
    assert (np.asarray(moved(1 + LIKELIHOODS)) > -np.inf).tolist() == [True, False, True, True]
