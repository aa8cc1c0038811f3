"""In float64 filters and smoothers of every kind run, and nothing falls back to float32.

Types are settled as a program is traced, so most are traced and no more.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax import smoothing
from mpfjax.models.series import Series
from mpfjax.running.scan import scan
from tests.marking import quick_of
from tests.precision import float64
from tests.registry import CHAINS, QUICK_CHAINS

KEY = jax.random.key(0)
SQUARES = np.array([1.5, 1.0, np.nan, 0.9])


@pytest.fixture(autouse=True)
def double():
    with float64():
        yield


def quadratic():
    return mpfjax.QuadraticModel(0.3, 0.5, -2.0, 2.0)


def assert_double(tree):
    floats = [leaf for leaf in jax.tree.leaves(tree) if jnp.issubdtype(leaf.dtype, np.floating)]
    assert floats
    assert {leaf.dtype for leaf in floats} == {np.dtype("float64")}


@pytest.mark.exactness
@pytest.mark.parametrize("chain", quick_of([*QUICK_CHAINS, "guided mpf", "dps"], ["guided mpf"]))
def test_chains_of_each_kind_are_traced(chain):
    filter, seen = CHAINS[chain](quadratic()), jnp.asarray(SQUARES)
    series = Series(seen, present=jnp.isfinite(seen))
    assert_double(eqx.filter_eval_shape(lambda key: scan(key, filter, series, None), KEY))


def product(before, now):
    return before * now


SMOOTHERS = {
    "genealogy": lambda filter, run: smoothing.trace_ancestors(run),
    "backward sampling": lambda filter, run: smoothing.sample_trajectories(KEY, filter, run, 4),
    "backward sampling, MCMC": lambda filter, run: smoothing.sample_trajectories(
        KEY, filter, run, 4, method="mcmc"
    ),
    "PaRIS": lambda filter, run: smoothing.smoothed_sums(
        KEY, filter, Series.skipping(SQUARES), product
    ),
    "conditional filter": lambda filter, run: smoothing.conditional_filter(
        KEY, filter, Series.skipping(SQUARES), jnp.zeros(len(SQUARES) + 1)
    ),
}
QUICK = ("backward sampling", "PaRIS", "conditional filter")


@pytest.mark.parametrize("name", quick_of(SMOOTHERS, QUICK, one_in=2))
def test_smoothers_are_traced(name):
    filter = CHAINS["pf"](quadratic())

    def smooth(key):
        run = mpfjax.run_filter(key, filter, SQUARES, missing="skip")
        return SMOOTHERS[name](filter, run)

    assert_double(eqx.filter_eval_shape(smooth, KEY))


class OfSingle(mpfjax.AbstractStateSpaceModel):
    """States in float32, and a parameter that is a Python float."""

    deviation: float = 0.5

    def sample_initial(self, key, num_particles):
        return jax.random.normal(key, (num_particles,), jnp.float32)

    def sample_transition(self, key, states):
        noise = jax.random.normal(key, states.shape, jnp.float32)
        return 0.9 * states + self.deviation * noise

    def log_likelihood(self, observation, states):
        z = (observation.astype(jnp.float32) - states) / self.deviation
        return -0.5 * z**2 - jnp.log(self.deviation * jnp.sqrt(2 * jnp.pi))


@pytest.mark.exactness
def test_states_in_float32_stay_so_beside_a_python_float():
    """As they do in JAX."""
    run = mpfjax.run_filter(KEY, mpfjax.particle_filter(OfSingle(), 100), jnp.array([0.4, -0.2]))
    assert run.final.particles.dtype == jnp.float32
