"""What particle Gibbs does without a density of the dynamics."""

import jax
import numpy as np
import pytest

import mpfjax
from mpfjax.tuning import particle_gibbs
from tests.tuning.exact_posteriors import SERIES, A, Pushed, draw_a


def sample(model, num_steps=3, **options):
    filter = mpfjax.particle_filter(model, 10)
    options = {"draw": draw_a, "parameters": A, "progress": False, "num_chains": 2} | options
    return particle_gibbs(jax.random.key(0), filter, SERIES, num_steps, **options)


class NoTransition(Pushed):
    log_transition = None


@pytest.mark.exactness
def test_without_log_transition_the_trajectory_follows_its_ancestors():
    run = sample(NoTransition())
    assert np.isfinite(run.parameters["a"]).all()
    assert run.renewal_rates[-1] > 0
