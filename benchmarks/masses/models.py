"""The models of the scenes: what moves, and what is seen of it. Each has several modes."""

from statistics import NormalDist
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key, PyTree

import mpfjax


class _FromNoise(mpfjax.AbstractStateSpaceModel):
    """A model whose x_0 is made of standard normal numbers."""

    def sample_initial(self, key: Key[Array, ""], num_particles: int) -> PyTree:
        """x_0."""
        model: Any = self
        noise = jax.random.normal(key, (num_particles, model.initial_noise_dimension))
        return model.initial_from_noise(noise)


def _log_normal(errors: Array, deviation: float) -> Array:
    return -0.5 * (errors / deviation) ** 2 - jnp.log(deviation * jnp.sqrt(2 * jnp.pi))


# --- a robot in a corridor with four identical doors ----------------------------------------------


class Corridor(mpfjax.AbstractStateSpaceModel):
    """A corridor that runs round a building, with a door every `spacing` metres.

    The robot moves by `speed` metres a step, with a deviation `slip`, and measures how far the wall
    is: further in front of a door, by the Gaussian profile of a niche. It starts anywhere. All
    doors look alike, so the filtering distribution has four modes of exactly the same mass and
    shape.

    States are positions in metres along the way, not taken modulo the corridor's length, (n,);
    observations are distances in metres, scalars.
    """

    num_doors, spacing = 4, 10.0
    speed, slip = 0.5, 0.5
    niche_depth, niche_width, sensor_error = 1.0, 1.0, 0.05
    noise_dimension = initial_noise_dimension = 1

    def sample_initial(self, key: Key[Array, ""], num_particles: int) -> Float[Array, " n"]:
        """x_0, anywhere in the corridor."""
        return self.num_doors * self.spacing * jax.random.uniform(key, (num_particles,))

    def initial_from_noise(self, noise: Float[Array, "n 1"]) -> Float[Array, " n"]:
        """The same from standard normal numbers."""
        return self.num_doors * self.spacing * jax.scipy.special.ndtr(noise[:, 0])

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

    def simulate(self, num_steps: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
        """A path (t,) and what is seen along it (t,)."""
        rng = np.random.default_rng(seed)
        steps = self.speed + self.slip * rng.normal(size=num_steps)
        path = self.num_doors * self.spacing * rng.random() + np.cumsum(steps)
        readings = np.asarray(self.distance(jnp.asarray(path)))
        observations = readings + self.sensor_error * rng.normal(size=num_steps)
        return path.astype(np.float32), observations.astype(np.float32)

    def section(self, states: Float[Array, " n"], place: Float[Array, ""]) -> Int[Array, " n"]:
        """Which of the four modes each particle is in, given where the robot is."""
        return jnp.round((states - place) / self.spacing).astype(jnp.int32) % self.num_doors


# --- a target on a line that jumps now and then ---------------------------------------------------


class Jumps(_FromNoise):
    """A random walk whose steps are long with a small probability, seen through its absolute value.

    Both sides are possible, and the prior tells a little of which is which. A jump may lead to the
    other side, so that what the first steps said is forgotten by and by. States and observations
    are scalars, (n,) and ().
    """

    centre, spread = 1.0, 4.0  # of x_0
    step, jump, jump_probability = 0.2, 4.0, 0.05
    sensor_error = 0.2
    noise_dimension, initial_noise_dimension = 2, 1

    def initial_from_noise(self, noise: Float[Array, "n 1"]) -> Float[Array, " n"]:
        """x_0 ~ N(centre, spread²)."""
        return self.centre + self.spread * noise[:, 0]

    def transition_from_noise(
        self, noise: Float[Array, "n 2"], states: Float[Array, " n"]
    ) -> Float[Array, " n"]:
        """A step, long where the second number is among its largest."""
        is_long = noise[:, 1] > NormalDist().inv_cdf(1 - self.jump_probability)
        return states + jnp.where(is_long, self.jump, self.step) * noise[:, 0]

    def log_transition(
        self, states: Float[Array, " n"], previous_states: Float[Array, " n"]
    ) -> Float[Array, " n"]:
        """The mixture of both normal densities."""
        steps = states - previous_states
        return jnp.logaddexp(
            jnp.log(1 - self.jump_probability) + _log_normal(steps, self.step),
            jnp.log(self.jump_probability) + _log_normal(steps, self.jump),
        )

    def log_initial(self, states: Float[Array, " n"]) -> Float[Array, " n"]:
        """log N(x_0; centre, spread²)."""
        return _log_normal(states - self.centre, self.spread)

    def log_likelihood(
        self, observation: Float[Array, ""], states: Float[Array, " n"]
    ) -> Float[Array, " n"]:
        """log N(y_t; |x_t|, sensor_error²)."""
        return _log_normal(observation - jnp.abs(states), self.sensor_error)

    def simulate(self, num_steps: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
        """A path (t,) and the distances that are seen along it (t,)."""
        rng = np.random.default_rng(seed)
        is_long = rng.random(num_steps) < self.jump_probability
        steps = np.where(is_long, self.jump, self.step) * rng.normal(size=num_steps)
        path = self.centre + self.spread * rng.normal() + np.cumsum(steps)
        readings = np.abs(path) + self.sensor_error * rng.normal(size=num_steps)
        return path.astype(np.float32), readings.astype(np.float32)


# --- a target whose distances to two posts are measured -------------------------------------------

_START = np.array([5.0, 0.0, 0.0, 0.0], np.float32)
_SPREAD = np.array([3.0, 3.0, 0.15, 0.15], np.float32)


class Mirror(_FromNoise):
    """Nearly constant velocity in the plane; nothing says on which side of two posts a target is.

    Prior and dynamics are symmetric about the x axis, on which the posts stand. So the filtering
    distribution has two modes in four dimensions, each the mirror image of the other, with a mass
    of one half for ever. States are position and velocity, (n, 4); observations two distances.
    """

    posts = np.array([[0.0, 0.0], [10.0, 0.0]], np.float32)
    push, sensor_error = 0.1, 0.5  # deviations of the acceleration, and of each distance
    noise_dimension, initial_noise_dimension = 2, 4

    def initial_from_noise(self, noise: Float[Array, "n 4"]) -> Float[Array, "n 4"]:
        """Around the point between the posts."""
        return jnp.asarray(_START)[None] + jnp.asarray(_SPREAD)[None] * noise

    def transition_from_noise(
        self, noise: Float[Array, "n 2"], states: Float[Array, "n 4"]
    ) -> Float[Array, "n 4"]:
        """A step with the accelerations held."""
        pushed = self.push * noise
        places = states[:, :2] + states[:, 2:] + 0.5 * pushed
        return jnp.concatenate([places, states[:, 2:] + pushed], axis=1)

    def log_likelihood(
        self, observation: Float[Array, "2"], states: Float[Array, "n 4"]
    ) -> Float[Array, " n"]:
        """Independent Gaussian errors of the two distances, without their constant."""
        errors = (observation[None] - self.distances(states)) / self.sensor_error
        return -0.5 * jnp.sum(errors**2, axis=1)

    def distances(self, states: Float[Array, "n 4"]) -> Float[Array, "n 2"]:
        """From each particle to each post."""
        offsets = states[:, None, :2] - self.posts[None]
        return jnp.sqrt(jnp.sum(offsets**2, axis=2))

    def simulate(self, num_steps: int, seed: int) -> np.ndarray:
        """The distances (t, 2) that are measured of a target on the upper side."""
        rng = np.random.default_rng(seed)
        states, readings = jnp.array([[3.0, 5.0, 0.15, -0.05]], jnp.float32), []
        for _ in range(num_steps):
            noise = jnp.asarray(rng.normal(size=(1, 2)), jnp.float32)
            states = self.transition_from_noise(noise, states)
            readings.append(
                np.asarray(self.distances(states))[0] + self.sensor_error * rng.normal(size=2)
            )
        return np.array(readings, np.float32)
