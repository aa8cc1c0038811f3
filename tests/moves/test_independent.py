"""Objects on their own; the exactness of their filters is tested with that of all chains."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax import MultiObjectModel
from mpfjax.moves.objects.independent import PropagateIndependently

KEY = jax.random.key(0)


class Lamp(mpfjax.QuadraticModel):
    """Seen right of zero, and not at all where the observation is negative."""

    def log_likelihood(self, observation, states):
        return jnp.where((states > 0) & (observation > 0), -states, -jnp.inf)


MODEL = MultiObjectModel(Lamp(0.1, 0.1, -1.0, 1.0), 3)
FILTER = mpfjax.independent_particle_filters(MODEL, 20)


def test_an_object_that_is_lost_does_not_take_the_others_along():
    mixture = FILTER.init(KEY)
    after, info = FILTER.step(KEY, mixture, jnp.array([1.0, -1.0, 1.0]))
    assert bool(info.degenerate)
    assert (np.asarray(after.particles)[:, [0, 2]] > 0).all()
    np.testing.assert_allclose(after.particles[:, 1], mixture.particles[:, 1], atol=0.6)
    np.testing.assert_allclose(after.weights, np.full(20, 0.05), rtol=1e-5)


def test_each_object_is_resampled_by_its_own_likelihood_alone():
    """So rows are parted: two objects that move together would stay together in a joint filter."""
    mixture = FILTER.init(KEY)
    same = jnp.linspace(-1.0, 1.0, 20)[:, None]
    mixture = mixture.replace(particles=jnp.broadcast_to(same, (20, 3)))
    after, info = FILTER.step(KEY, mixture, jnp.ones(3))
    assert (np.asarray(after.particles) > 0).all()
    assert np.isfinite(info.log_likelihood_increment)
    single = mpfjax.particle_filter(MultiObjectModel(MODEL.object_model, 1), 20)
    alone = single.init(KEY).replace(particles=same)
    # A third of the log evidence, up to the noise of three draws.
    _, one = single.step(KEY, alone, jnp.ones(1))
    ratio = float(info.log_likelihood_increment) / float(one.log_likelihood_increment)
    assert 2.4 < ratio < 3.6


@pytest.mark.usefixtures("as_installed")
def test_bad_input():
    with pytest.raises(ValueError, match="scheme: 'optimal'"):
        mpfjax.independent_particle_filters(MODEL, 20, scheme="optimal")
    move = PropagateIndependently(MODEL)
    mixture = mpfjax.distributed_partitioned_sampling(MODEL, 20).init(KEY)
    with pytest.raises(ValueError, match="mixture: 3 components, not one"):
        move(KEY, mixture, jnp.ones(3))
