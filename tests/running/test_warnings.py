"""What a run warns of: no likelihood, all weight on one particle, a state that is lost."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from tests.user_models import Drift, ScalarLinear


class Near(Drift):
    """No particle further than this has any likelihood."""

    def log_likelihood(self, observation, states):
        return jnp.where(jnp.abs(observation - states[:, 0]) < 5.0, 0.1, -jnp.inf)


@pytest.mark.exactness
def test_a_run_without_any_likelihood_says_so_once(recwarn):
    filter = mpfjax.particle_filter(Near(), 20)
    keys, far = jax.random.split(jax.random.key(0), 3), np.array([90.0, np.nan, 80.0])
    mpfjax.run_filter(keys[0], filter, np.array([90.0, 0.0, 80.0]))  # one step is enough
    assert not recwarn.list
    with pytest.warns(RuntimeWarning, match="every step with an observation was degenerate:"):
        mpfjax.run_filter(keys[0], filter, far, missing="skip")
    with pytest.warns(RuntimeWarning, match="degenerate in 3 of 3 runs") as found:
        mpfjax.monte_carlo(keys, filter, mpfjax.Series.skipping(far))
    assert [each.filename for each in found] == [__file__]  # the line that ran it


@pytest.mark.exactness
def test_a_run_in_which_one_particle_has_all_weight_says_so_once(recwarn):
    """As where the observations are in other units than the model."""
    keys, seen = jax.random.split(jax.random.key(0), 3), np.array([0.4, np.nan, 0.9, 0.1])
    filter = mpfjax.particle_filter(Drift(), 20)
    run = mpfjax.run_filter(keys[0], filter, seen, missing="skip")
    sizes = jax.vmap(lambda mixture: mixture.effective_sample_size)(run.collected)
    np.testing.assert_allclose(run.effective_sample_size, sizes, rtol=1e-5)
    few = mpfjax.particle_filter(Drift(), 4)
    mpfjax.run_filter(keys[0], few, 1000 * seen, missing="skip")
    assert not recwarn.list
    said = "one particle had nearly all weight in nearly all steps with an observation"
    with pytest.warns(RuntimeWarning, match=f"{said}: .*units"):
        mpfjax.run_filter(keys[0], filter, 1000 * seen, missing="skip")
    with pytest.warns(RuntimeWarning, match=f"{said} in 3 of 3 runs"):
        mpfjax.monte_carlo(keys, filter, mpfjax.Series.skipping(1000 * seen))


# A walk whose steps are much shorter than a jump.
SLOW = ScalarLinear(a=1.0, q=0.01, r=0.05, m=0.0, p=0.1)
JUMP = np.where(np.arange(40) < 20, 0.0, 2.0) + 0.05 * np.sin(np.arange(40.0))


def test_runs_that_lost_the_state_are_counted_from_the_step_on(recwarn):
    filter, keys = mpfjax.particle_filter(SLOW, 50), jax.random.split(jax.random.key(0), 3)
    mpfjax.monte_carlo(keys, filter, JUMP[:20])
    mpfjax.run_filter(keys[0], filter, JUMP[:24])  # too early to say
    assert not recwarn.list
    with pytest.warns(RuntimeWarning, match="3 of 3 runs lost the state, from step 2[1-4] on"):
        mpfjax.monte_carlo(keys, filter, JUMP)
    with pytest.warns(RuntimeWarning, match=r"the run lost the state.*with_alarm"):
        mpfjax.run_filter(keys[0], filter, mpfjax.Series.skipping(np.insert(JUMP, 30, np.nan)))


@pytest.mark.exactness
def test_a_state_that_is_found_again_is_not_lost(recwarn):
    """As after a short excursion; and a sharp likelihood alone is no loss."""
    back = np.where((np.arange(40) >= 10) & (np.arange(40) < 22), 0.5, 0.0)
    key, filter = jax.random.key(0), mpfjax.particle_filter(SLOW, 50)
    mpfjax.run_filter(key, filter, back)
    sharp = mpfjax.LinearGaussianModel([[0.9]], [[1.0]], [[1.0]], [[1e-3]], [0.0], [[1.0]])
    _, observations = mpfjax.simulate(jax.random.key(1), sharp, 60)
    mpfjax.run_filter(key, mpfjax.particle_filter(sharp, 200), observations)
    assert not recwarn.list
