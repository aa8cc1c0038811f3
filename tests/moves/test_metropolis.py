"""Whom Metropolis moves take for a particle's parent.

That they leave the target as it is stands in `tests/together/test_exact_answers.py`, and that the
score passes through them in `tests/together/test_gradients.py`.
"""

import jax
import jax.numpy as jnp
import numpy as np

import mpfjax
from mpfjax import Every, Filter, KMeans, Propagate, Resample
from mpfjax.moves.base import AbstractMarkovMove
from tests.user_models import Drift


class Watch(AbstractMarkovMove):
    """Puts the parents where the test finds them; moves nothing."""

    needs_parents = True

    def __call__(self, key, mixture, now):
        return mixture.replace(memory=mixture.memory | {"parents": mixture.parents})

    def initial_memory(self, now, num_components):
        return {"parents": jnp.zeros((64, 2))}


def test_parents_follow_their_particles():
    """Through resampling before and after the propagation, they are the states of the ancestors."""
    model = Drift()
    moves = [Resample(), Propagate(), Every(2, [Resample("multinomial")]), Watch()]
    filter = Filter(model, moves, 64, 3, initial_moves=[KMeans(3, reseed=True)])
    run = mpfjax.run_filter(jax.random.key(0), filter, jnp.array([1.0, 2.0]))
    before, after = run.collected.particles[0], run.final
    assert after.parents is None
    np.testing.assert_array_equal(after.memory["parents"], before[after.ancestor_indices])
    assert len(np.unique(after.ancestor_indices)) >= 3
