"""Known inputs: controls and times that the model finds in its field `inputs` at each step.

That filters and smoothers are exact with them, the matrix asks, of which this is the law.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.scipy.stats import norm

import mpfjax
from mpfjax.exact import grid_filter, kalman_filter, kalman_smoother
from tests.matrix.data import case

KEY = jax.random.key(3)
TRACED = []  # how often JAX has traced the likelihood


def nothing(mixture):
    return None


@pytest.mark.exactness
def test_the_references_take_controls_and_matrices_by_time():
    linear, driven = case("matrices by step", "complete"), case("inputs", "complete")
    answer, states = linear.answer, jnp.linspace(-6.0, 6.0, 900)
    for run, atol in (
        (kalman_filter(linear.model, linear.series), 1e-5),
        (grid_filter(driven.model, driven.series, states), 1e-3),
    ):
        np.testing.assert_allclose(run.log_marginal_likelihood, answer.log_z, atol=atol)
        np.testing.assert_allclose(np.ravel(run.means), answer.means[1:], atol=atol)
    run = kalman_smoother(linear.model, linear.series)
    np.testing.assert_allclose(run.means[:, 0], answer.smoothed, atol=1e-5)


class Drawn(mpfjax.AbstractStateSpaceModel):
    """x_t = u_t + noise, seen exactly enough; any object may have its own shift."""

    shift: jax.Array
    inputs: Any = None

    def sample_initial(self, key, num_particles):
        return self.shift + jax.random.normal(key, (num_particles,))

    def sample_transition(self, key, states):
        return self.shift + self.inputs + 0.01 * jax.random.normal(key, states.shape)

    def log_likelihood(self, observation, states):
        TRACED.append(None)
        return norm.logpdf(observation, states - self.inputs, 1.0)


@pytest.mark.parametrize("shift", [jnp.array(1.0), jnp.array([1.0, 2.0, 3.0])])
def test_all_objects_have_the_input(shift):
    model = mpfjax.MultiObjectModel(Drawn(shift), 3, shared_observation=True)
    states = model.sample_initial(KEY, 16)
    moved = model.with_inputs(jnp.array(10.0)).sample_transition(KEY, states)
    expected = jnp.broadcast_to(shift + 10.0, (3,))
    np.testing.assert_allclose(moved.mean(axis=0), expected, atol=0.02)


FILTER = mpfjax.particle_filter(Drawn(jnp.array(0.0)), 32)
INPUTS = jnp.array([1.0, 1.0, -1.0, 0.5])
OBSERVATIONS = jnp.array([0.6, 1.1, 0.1, -0.2])


@pytest.mark.exactness
def test_an_input_of_a_step_that_is_nan_or_not_there_is_an_error():
    with pytest.raises(ValueError, match="inputs: NaN or infinite"):
        FILTER.step(KEY, FILTER.init(KEY), OBSERVATIONS[0], inputs=jnp.array(np.nan))
    with pytest.raises(TypeError) as caught:
        FILTER.step(KEY, FILTER.init(KEY), OBSERVATIONS[0])
    assert "whose `inputs` is None: pass inputs= to the call" in "".join(caught.value.__notes__)


@pytest.mark.exactness
def test_a_study_hands_them_on(tmp_path):
    series = mpfjax.Series(OBSERVATIONS, INPUTS)
    study = mpfjax.Study({"pf": lambda num_particles: FILTER}, [32], KEY[None], series)
    (cell,) = mpfjax.run_study(study, tmp_path)
    run = mpfjax.run_filter(KEY, FILTER, series, nothing)
    np.testing.assert_allclose(cell["log_marginal_likelihood"][0], run.log_marginal_likelihood)


def test_nothing_compiles_again():
    mpfjax.run_filter(KEY, FILTER, OBSERVATIONS, nothing, inputs=INPUTS)
    before = len(TRACED)
    mpfjax.run_filter(KEY, FILTER, OBSERVATIONS, nothing, inputs=0.5 * INPUTS)
    assert len(TRACED) == before > 0
