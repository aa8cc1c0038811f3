"""The sampler of a window: unbiased, also with hard edges, and modes of equal weight."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax.moves.start.sampler import sample_window
from tests.unbiased import assert_unbiased

KEY = jax.random.key(0)


def window_of(observations):
    present = jnp.ones(len(observations), bool)
    return mpfjax.Series(jnp.asarray(observations, jnp.float32), present=present)


def starts(model, window, num_particles, num_runs, key=KEY):
    """x_L of each run, and its log Ẑ."""

    @jax.jit
    def start(key):
        states, log_increments = sample_window(key, model, window, num_particles)
        return states, jnp.sum(log_increments)

    return jax.tree.map(np.asarray, jax.lax.map(start, jax.random.split(key, num_runs)))


# A place in the plane, anywhere, observed with a small error. x_0 and x_t are made of noise.
PLANE = mpfjax.LinearGaussianModel(
    np.eye(2), 0.01 * np.eye(2), np.eye(2), 0.09 * np.eye(2), np.zeros(2), 400 * np.eye(2)
)
PLACES = np.array([[3.0, 1.0], [3.3, 1.2], [0.0, 0.0], [3.1, 1.4]], np.float32)


class WithKeys(mpfjax.AbstractStateSpaceModel):
    """The same, with a density of x_0, and nothing of what the noise is."""

    def sample_initial(self, key, num_particles):
        return 20 * jax.random.normal(key, (num_particles, 2))

    def log_initial(self, states):
        return jnp.sum(jax.scipy.stats.norm.logpdf(states, 0.0, 20.0), axis=1)

    def sample_transition(self, key, states):
        return states + 0.1 * jax.random.normal(key, states.shape)

    def log_likelihood(self, observation, states):
        return jnp.sum(jax.scipy.stats.norm.logpdf(observation[None], states, 0.3), axis=1)


class Edged(WithKeys):
    """A number anywhere from -20 to 20, of which it is known at each step where it is within .5."""

    def sample_initial(self, key, num_particles):
        return jax.random.uniform(key, (num_particles,), minval=-20.0, maxval=20.0)

    def log_initial(self, states):
        return jnp.where(jnp.abs(states) < 20, 0.0, -jnp.inf)

    def log_likelihood(self, observation, states):
        return jnp.where(jnp.abs(states - observation) < 0.5, 0.0, -jnp.inf)


@pytest.mark.exactness
def test_hard_edges_leave_the_evidence_unbiased():
    """Beside sums over a grid; 60 draws and a pilot of 12 meet y_1 by one or two."""
    places = np.array([12.0, 12.3, 11.8, 11.7], np.float32)
    _, log_z = starts(Edged(), window_of(places), 60, 1500)
    grid = np.linspace(-21, 21, 8401)
    law = (np.abs(grid) < 20) / 40 * 0.005
    steps = np.exp(-0.5 * (np.arange(-100, 101) * 0.05) ** 2)
    for place in places:
        law = np.convolve(law, steps / steps.sum(), mode="same") * (np.abs(grid - place) < 0.5)
    assert_unbiased(np.exp(log_z) / law.sum(), loosest=0.04, errors=3.0)


@pytest.mark.exactness
def test_a_start_without_any_likelihood_says_so():
    _, log_z = starts(Edged(), window_of([30.0, 30.0]), 40, 2)
    assert (log_z == -np.inf).all()


class Rooms(WithKeys):
    """Nine rooms of one by one; where in its room the state is, is observed to a hundredth."""

    def sample_initial(self, key, num_particles):
        return jax.random.uniform(key, (num_particles, 2), maxval=3.0)

    def log_initial(self, states):
        return jnp.where(jnp.all((states > 0) & (states < 3), axis=1), 0.0, -jnp.inf)

    def sample_transition(self, key, states):
        return states + 0.003 * jax.random.normal(key, states.shape)

    def log_likelihood(self, observation, states):
        gaps = states % 1.0 - observation[None]
        return -0.5 * jnp.sum((gaps / 0.01) ** 2, axis=1)


@pytest.mark.exactness
def test_equal_modes_have_equal_masses():
    """A mode is a thousandth of its room, so that none of the paths may hit it at first."""
    places = np.array([[0.3, 0.6]] * 4) + np.array([[0.01, -0.01], [0, 0], [0.005, 0], [0, -0.01]])
    states, _ = starts(Rooms(), window_of(places), 500, 8)
    rooms = np.floor(states).astype(int) @ [1, 3]
    masses = np.mean(rooms[:, :, None] == np.arange(9), axis=1)
    assert np.sqrt(np.mean((masses - 1 / 9) ** 2)) < 0.05
    assert masses.min() > 0.01


class Anywhere(WithKeys):
    """A place on ten kilometres, observed to ten centimetres, with an edge of no likelihood."""

    def sample_initial(self, key, num_particles):
        return jax.random.uniform(key, (num_particles,), minval=-5000.0, maxval=5000.0)

    def log_initial(self, states):
        return jnp.where(jnp.abs(states) < 5000, -jnp.log(10_000.0), -jnp.inf)

    def sample_transition(self, key, states):
        return states + 0.01 * jax.random.normal(key, states.shape)

    def log_likelihood(self, observation, states):
        log_density = jax.scipy.stats.norm.logpdf(observation, states, 0.1)
        return jnp.where(states > 0, log_density, -jnp.inf)


@pytest.mark.exactness
def test_a_prior_a_hundred_thousand_times_as_wide_as_the_likelihood():
    """The evidence is that of the first observation, 1 / 10 000, and of a Kalman filter after."""
    places = np.array([4000.0, 4000.05], np.float32)
    states, log_z = starts(Anywhere(), window_of(places), 100, 60)
    spread = np.sqrt(2 * 0.1**2 + 0.01**2)
    exact = -np.log(10_000) + jax.scipy.stats.norm.logpdf(0.05, 0.0, spread)
    assert_unbiased(np.exp(log_z - exact), loosest=0.2)
    assert np.abs(states - 4000).max() < 1
