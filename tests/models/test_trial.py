"""`check_model` accepts models that are right, and names what is wrong with others."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.scipy.stats import cauchy, norm

import mpfjax
from tests import switching
from tests.marking import quick_of
from tests.user_models import DRIFT_AS_LINEAR_GAUSSIAN, Drift, DriftOfOne, ScalarLinear

NUMBER = jnp.asarray(0.3)
ONE = mpfjax.LinearGaussianModel(A=[[0.9]], Q=[[0.3]], H=[[1.0]], R=[[0.4]], m0=[0.5], P0=[[1.0]])


class Known(Drift):
    """x_0 is known."""

    def sample_initial(self, key, num_particles):
        return jnp.zeros((num_particles, 2))


class Regimes(mpfjax.AbstractStateSpaceModel):
    """A regime that seldom changes, and steps without a variance."""

    def sample_initial(self, key, num_particles):
        zeros = jnp.zeros(num_particles, jnp.int32)
        return {"z": zeros, "x": jax.random.normal(key, (num_particles,))}

    def changes(self, key, num_particles):
        return jax.random.bernoulli(key, 0.1, (num_particles,))

    def sample_transition(self, key, states):
        key_z, key_x = jax.random.split(key)
        n = len(states["x"])
        z = jnp.where(self.changes(key_z, n), 1 - states["z"], states["z"])
        scale = jnp.where(z == 1, 1.0, 0.1)
        return {"z": z, "x": states["x"] + scale * jax.random.cauchy(key_x, (n,))}

    def log_transition(self, states, previous_states):
        z = states["z"]
        stays = jnp.where(z == previous_states["z"], jnp.log(0.9), jnp.log(0.1))
        scale = jnp.where(z == 1, 1.0, 0.1)
        return stays + cauchy.logpdf(states["x"], previous_states["x"], scale)

    def log_likelihood(self, observation, states):
        return norm.logpdf(observation, states["x"])


class Volatile(ScalarLinear):
    """The size of a step depends on the place."""

    def sample_transition(self, key, states):
        return 0.9 * states + jnp.exp(0.5 * states) * jax.random.normal(key, states.shape)

    def log_transition(self, states, previous_states):
        return norm.logpdf(states, 0.9 * previous_states, jnp.exp(0.5 * previous_states))


RIGHT = {
    "batched": (Drift(), NUMBER),
    "x_0 known": (Known(), NUMBER),
    "regimes": (Regimes(), NUMBER),
    "marginalised": (switching.MODEL, switching.OBSERVATIONS[0]),
    "of one particle": (mpfjax.per_particle(DriftOfOne()), NUMBER),
    "volatile": (Volatile(), NUMBER),
    "quadratic": (mpfjax.QuadraticModel(0.3, 0.5, -2.0, 2.0), NUMBER),
    "matrices": (DRIFT_AS_LINEAR_GAUSSIAN, jnp.array([0.3])),
    "two objects": (mpfjax.MultiObjectModel(ONE, 2), jnp.array([[0.3], [-1.0]])),
}


@pytest.mark.parametrize("name", quick_of(RIGHT, ["x_0 known", "regimes", "volatile", "quadratic"]))
def test_what_is_right_is_accepted(name):
    mpfjax.check_model(jax.random.key(0), *RIGHT[name])


def normal(x, mean, scale):
    return norm.logpdf(x, mean, scale).sum(axis=1)


# By name: the class that is right, the method in place of its own, and what is said of it.
WRONG = {
    "one noise for all x_0": (
        Drift, {"sample_initial": lambda self, key, n: jnp.full((n, 2), jax.random.normal(key))},
        "sample_initial draws noise that particles share",
    ),

    "one change of regime for all": (
        Regimes, {"changes": lambda self, key, n: jax.random.bernoulli(key, 0.1)},
        "sample_transition draws noise that particles share",
    ),
    "a key of its own": (
        Drift,
        {"sample_transition": lambda self, _, x: x + jax.random.normal(jax.random.key(3), x.shape)},
        "the same draws for every key",
    ),
    "NaN": (Drift, {"sample_transition": lambda self, key, x: jnp.log(x)}, "draws NaN"),
    "another type": (
        Drift, {"sample_transition": lambda self, key, x: x.astype(jnp.float16)},
        "returned float16",
    ),
    "another deviation": (
        Drift, {"log_transition": lambda self, x, old: normal(x, self.transition_mean(old), 0.8)},
        "is not the density of sample_transition",
    ),
    "another mean": (
        Drift, {"log_transition": lambda self, x, old: normal(x, old, 0.5)},
        "is not the density of sample_transition",
    ),
    "a factor of the past": (
        Volatile,
        {"log_transition": lambda self, x, old: -0.5 * ((x - 0.9 * old) / jnp.exp(old / 2)) ** 2},
        "a factor that depends on x_",
    ),
    "zero at draws": (
        Drift, {"log_transition": lambda self, x, old: jnp.full(len(x), -jnp.inf)},
        "infinite at a draw of sample_transition",
    ),
    "normalised over particles": (
        Drift,
        {"log_likelihood": lambda self, y, x: jax.nn.log_softmax(norm.logpdf(y, x[:, 0]))},
        "depends on the other particles",
    ),
    "no particle": (
        Drift,
        {"log_likelihood": lambda self, y, x: jnp.where(x[:, 0] > 1e9, 0.0, -jnp.inf)},
        "no particle explains it",
    ),
    "a likelihood of NaN": (
        Drift, {"log_likelihood": lambda self, y, x: jnp.full(len(x), jnp.nan)},
        "NaN or .inf at a draw of x_1",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_what_is_wrong_is_named(name):
    base, methods, named = WRONG[name]
    with pytest.raises(ValueError, match=f"model: Changed.*{named}"):
        mpfjax.check_model(jax.random.key(0), type("Changed", (base,), methods)(), NUMBER)


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
        mpfjax.monte_carlo(keys, filter, far, missing="skip")
    assert [each.filename for each in found] == [__file__]  # the line that ran it
