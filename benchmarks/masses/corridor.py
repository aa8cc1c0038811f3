"""A robot in a corridor with four identical doors: four modes whose masses are equal for ever."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

import mpfjax

NUM_DOORS = 4


class Corridor(mpfjax.AbstractStateSpaceModel):
    """A corridor that runs round a building, with a door every `spacing` metres.

    The robot moves by `speed` metres a step, with a Gaussian error, and measures how far the wall
    is: further in front of a door, by the profile of a niche. It starts anywhere. All doors look
    alike, so the filtering distribution has four modes of exactly the same mass and shape.

    - `spacing`: of the doors, in metres. `speed`, `slip`: mean and deviation of a step.
    - `niche_depth`, `niche_width`: of a door's Gaussian profile. `sensor_error`: a deviation.

    States are positions in metres along the way, not taken modulo the corridor's length, (n,);
    observations are distances in metres, scalars.
    """

    spacing: float = eqx.field(static=True, default=10.0)
    speed: float = eqx.field(static=True, default=0.5)
    slip: float = eqx.field(static=True, default=0.5)
    niche_depth: float = eqx.field(static=True, default=1.0)
    niche_width: float = eqx.field(static=True, default=1.0)
    sensor_error: float = eqx.field(static=True, default=0.05)

    @property
    def noise_dimension(self) -> int:
        """1."""
        return 1

    @property
    def initial_noise_dimension(self) -> int:
        """1."""
        return 1

    def sample_initial(self, key: Key[Array, ""], num_particles: int) -> Float[Array, " n"]:
        """x_0, anywhere in the corridor."""
        return NUM_DOORS * self.spacing * jax.random.uniform(key, (num_particles,))

    def initial_from_noise(self, noise: Float[Array, "n 1"]) -> Float[Array, " n"]:
        """The same from standard normal numbers."""
        return NUM_DOORS * self.spacing * jax.scipy.special.ndtr(noise[:, 0])

    def transition_from_noise(
        self, noise: Float[Array, "n 1"], states: Float[Array, " n"]
    ) -> Float[Array, " n"]:
        """x_t ~ N(x_{t-1} + speed, slip²)."""
        return states + self.speed + self.slip * noise[:, 0]

    def log_likelihood(
        self, observation: Float[Array, ""], states: Float[Array, " n"]
    ) -> Float[Array, " n"]:
        """log N(y_t; distance to the wall, sensor_error²), without its constant."""
        return -0.5 * ((observation - self.distance(states)) / self.sensor_error) ** 2

    def distance(self, states: Float[Array, " n"]) -> Float[Array, " n"]:
        """How much further the wall is than where there is no door."""
        offsets = states - self.spacing * jnp.round(states / self.spacing)
        return self.niche_depth * jnp.exp(-0.5 * (offsets / self.niche_width) ** 2)


def simulate(model: Corridor, num_steps: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A path (t,) and what is seen along it (t,)."""
    rng = np.random.default_rng(seed)
    steps = model.speed + model.slip * rng.normal(size=num_steps)
    path = NUM_DOORS * model.spacing * rng.random() + np.cumsum(steps)
    seen = np.asarray(model.distance(jnp.asarray(path)))
    observations = seen + model.sensor_error * rng.normal(size=num_steps)
    return path.astype(np.float32), observations.astype(np.float32)


def section(
    model: Corridor, states: Float[Array, " n"], place: Float[Array, ""]
) -> Int[Array, " n"]:
    """Which of the four modes each particle is in, given where the robot is."""
    return jnp.round((states - place) / model.spacing).astype(jnp.int32) % NUM_DOORS
