"""Objects on their own; the exactness of their filters is tested with that of all chains."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax import MultiObjectModel

KEY = jax.random.key(0)


class Lamp(mpfjax.QuadraticModel):
    """Seen right of zero, and not at all where the observation is negative."""

    def log_likelihood(self, observation, states):
        return jnp.where((states > 0) & (observation > 0), -states, -jnp.inf)


@pytest.mark.exactness
def test_each_object_is_resampled_by_its_own_likelihood_alone():
    """A lost object does not take the others along, and log Ẑ is the sum over the objects."""
    filter = mpfjax.independent_particle_filters(MultiObjectModel(Lamp(0.1, 0.1, -1.0, 1.0), 3), 20)
    before = filter.init(KEY)
    same = jnp.broadcast_to(jnp.linspace(-1.0, 1.0, 20)[:, None], (20, 3))
    after, info = filter.step(KEY, before.replace(particles=same), jnp.ones(3))
    assert (np.asarray(after.particles) > 0).all()
    # Of each object about half of the particles is seen, with a mean likelihood of 1 - 1 / e.
    np.testing.assert_allclose(info.log_likelihood_increment, 3 * np.log(0.316), atol=0.45)
    after, info = filter.step(KEY, before, jnp.array([1.0, -1.0, 1.0]))
    assert bool(info.degenerate)
    assert (np.asarray(after.particles)[:, [0, 2]] > 0).all()
    np.testing.assert_allclose(after.particles[:, 1], before.particles[:, 1], atol=0.6)
    np.testing.assert_allclose(after.weights, np.full(20, 0.05), rtol=1e-5)


def test_an_interaction_is_ignored_and_that_is_said():
    for interaction in (None, mpfjax.PairwiseRepulsion(1.0, 1.0)):
        joint = MultiObjectModel(Lamp(), 2, interaction)
        filter = mpfjax.independent_particle_filters(joint, 8)
        assert filter.approximate == (interaction is not None)
