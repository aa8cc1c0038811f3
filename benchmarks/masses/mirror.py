"""A target whose distances to two posts are measured; nothing says on which side of them it is."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

import mpfjax

POSTS = np.array([[0.0, 0.0], [10.0, 0.0]], np.float32)
_START = np.array([5.0, 0.0, 0.0, 0.0], np.float32)
_SPREAD = np.array([3.0, 3.0, 0.15, 0.15], np.float32)
_TRUTH = np.array([3.0, 5.0, 0.15, -0.05])


class MirrorModel(mpfjax.AbstractStateSpaceModel):
    """Nearly constant velocity in the plane; prior and dynamics are symmetric about the x axis.

    The posts stand on that axis. So the filtering distribution has two modes in four dimensions,
    each the mirror image of the other, with a mass of one half for ever.

    - `push`: standard deviation of the acceleration. `sensor_error`: of each distance.

    States are position and velocity, (n, 4); observations are two distances.
    """

    push: float = eqx.field(static=True, default=0.1)
    sensor_error: float = eqx.field(static=True, default=0.5)

    @property
    def noise_dimension(self) -> int:
        """Two accelerations."""
        return 2

    @property
    def initial_noise_dimension(self) -> int:
        """Position and velocity."""
        return 4

    def sample_initial(self, key: Key[Array, ""], num_particles: int) -> Float[Array, "n 4"]:
        """Around the point between the posts."""
        return self.initial_from_noise(jax.random.normal(key, (num_particles, 4)))

    def initial_from_noise(self, noise: Float[Array, "n 4"]) -> Float[Array, "n 4"]:
        """The same from standard normal numbers."""
        return jnp.asarray(_START)[None] + jnp.asarray(_SPREAD)[None] * noise

    def transition_from_noise(
        self, noise: Float[Array, "n 2"], states: Float[Array, "n 4"]
    ) -> Float[Array, "n 4"]:
        """A step with the accelerations held."""
        pushed = self.push * noise
        places = states[:, :2] + states[:, 2:] + 0.5 * pushed
        return jnp.concatenate([places, states[:, 2:] + pushed], axis=1)

    def transition_mean(self, states: Float[Array, "n 4"]) -> Float[Array, "n 4"]:
        """A step without a push."""
        return self.transition_from_noise(jnp.zeros_like(states[:, :2]), states)

    def log_likelihood(
        self, observation: Float[Array, "2"], states: Float[Array, "n 4"]
    ) -> Float[Array, " n"]:
        """Independent Gaussian errors of the two distances, without their constant."""
        errors = (observation[None] - distances(states)) / self.sensor_error
        return -0.5 * jnp.sum(errors**2, axis=1)


def distances(states: Float[Array, "n 4"]) -> Float[Array, "n 2"]:
    """From each particle to each post."""
    offsets = states[:, None, :2] - POSTS[None]
    return jnp.sqrt(jnp.sum(offsets**2, axis=2))


def simulate(model: MirrorModel, num_steps: int, seed: int) -> np.ndarray:
    """The distances (t, 2) that are measured of a target on the upper side."""
    rng = np.random.default_rng(seed)
    states, seen = jnp.asarray(_TRUTH[None], jnp.float32), []
    for _ in range(num_steps):
        noise = jnp.asarray(rng.normal(size=(1, 2)), jnp.float32)
        states = model.transition_from_noise(noise, states)
        seen.append(np.asarray(distances(states))[0] + model.sensor_error * rng.normal(size=2))
    return np.array(seen, np.float32)
