"""Families of draws; that they are unbiased is asked in `tests/matrix`."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import mpfjax
from mpfjax import Propagate, PropagateNested
from tests.examples import make_mixture
from tests.user_models import BLINDED, TrickyQuadraticModel


def test_an_empty_slot_and_a_hopeless_family_stay_without_weight():
    mixture = make_mixture(np.zeros(4), [0.0, -np.inf, 0.0, 0.0], [0, 0, 1, 1], 2)

    @eqx.filter_jit
    def moved(observation):
        now = mpfjax.Step(TrickyQuadraticModel(), observation)
        return PropagateNested(Propagate(), 3)(jax.random.key(0), mixture, now).log_weights

    assert (np.asarray(moved(jnp.array(BLINDED))) == -np.inf).all()
    assert (np.asarray(moved(jnp.array(1.0))) > -np.inf).tolist() == [True, False, True, True]
