"""What particle Gibbs does with broken densities, and without a density of the dynamics."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax.tuning import particle_gibbs
from tests.tuning.exact_posteriors import SERIES, A, Pushed, draw_a


def sample(model, num_steps=3, **options):
    filter = mpfjax.particle_filter(model, 10)
    options = {"draw": draw_a, "parameters": A, "progress": False, "num_chains": 2} | options
    return particle_gibbs(jax.random.key(0), filter, SERIES, num_steps, **options)


class Fragile(Pushed):
    """A likelihood that breaks where a is above 0.6."""

    def log_likelihood(self, observation, states):
        honest = super().log_likelihood(observation, states)
        return jnp.where(self.a > 0.6, jnp.nan, honest)


def test_a_nan_is_rejected_and_counted():
    with pytest.warns(UserWarning, match=r"zero density: conditional_filter \d+ times$"):
        run = sample(Fragile(a=0.5), 100)
    assert run.stopped is None
    assert run.parameters["a"].shape == (2, 100)
    assert (run.parameters["a"] <= 0.6).all()
    assert (run.num_invalid["conditional_filter"] > 0).all()
    with pytest.raises(RuntimeError, match="was NaN or inf"):
        sample(Fragile(a=0.95))


class NoTransition(Pushed):
    log_transition = None


def test_without_log_transition_the_trajectory_follows_its_ancestors():
    run = sample(NoTransition())
    assert np.isfinite(run.parameters["a"]).all()
    assert run.renewal_rates[-1] > 0
