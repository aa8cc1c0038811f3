"""A vehicle above a landscape, which knows its speed and its height above ground: many modes."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

import mpfjax

# How far from the vehicle a particle may be and still count as near it, in kilometres.
NEAR = 0.3
_NUM_WAVES = 20


class Terrain(mpfjax.AbstractStateSpaceModel):
    """A flight at known velocity over a landscape of hills, with an altimeter.

    Bergman (1999), Recursive Bayesian Estimation, chapter 7, in small. The height of the ground is
    a sum of waves of random direction. The start may be anywhere in a square. Every contour line of
    the first height is a mode, and the later heights leave fewer of them, of uneven masses.

    - `waves`: wave numbers, in radians per kilometre. `amplitudes`, in hundreds of metres;
      `phases`, in radians.
    - `velocity`: in kilometres a step. `drift`: standard deviation of a step about it.
    - `side`: of the square, in kilometres. `sensor_error`: standard deviation, hundreds of metres.

    States are places in kilometres, (n, 2); observations are heights, scalars.
    """

    waves: Float[Array, "k 2"]
    amplitudes: Float[Array, " k"]
    phases: Float[Array, " k"]
    velocity: Float[Array, "2"]
    drift: float = eqx.field(static=True, default=0.05)
    side: float = eqx.field(static=True, default=10.0)
    sensor_error: float = eqx.field(static=True, default=0.1)

    @property
    def noise_dimension(self) -> int:
        """2."""
        return 2

    @property
    def initial_noise_dimension(self) -> int:
        """2."""
        return 2

    def sample_initial(self, key: Key[Array, ""], num_particles: int) -> Float[Array, "n 2"]:
        """x_0, anywhere in the square."""
        return self.side * jax.random.uniform(key, (num_particles, 2))

    def initial_from_noise(self, noise: Float[Array, "n 2"]) -> Float[Array, "n 2"]:
        """The same from standard normal numbers."""
        return self.side * jax.scipy.special.ndtr(noise)

    def transition_from_noise(
        self, noise: Float[Array, "n 2"], states: Float[Array, "n 2"]
    ) -> Float[Array, "n 2"]:
        """x_t ~ N(x_{t-1} + velocity, drift²)."""
        return states + self.velocity[None] + self.drift * noise

    def log_likelihood(
        self, observation: Float[Array, ""], states: Float[Array, "n 2"]
    ) -> Float[Array, " n"]:
        """log N(y_t; height of the ground, sensor_error²), without its constant."""
        return -0.5 * ((observation - self.height(states)) / self.sensor_error) ** 2

    def height(self, states: Float[Array, "n 2"]) -> Float[Array, " n"]:
        """The height of the ground below each place, in hundreds of metres."""
        angles = states @ self.waves.T + self.phases[None]
        return jnp.sin(angles) @ self.amplitudes


def make_landscape(seed: int) -> Terrain:
    """A landscape of waves between one and a half and six kilometres long."""
    rng = np.random.default_rng(seed)
    lengths = rng.uniform(1.5, 6.0, size=_NUM_WAVES)
    directions = rng.uniform(0, 2 * np.pi, size=_NUM_WAVES)
    waves = (2 * np.pi / lengths * np.array([np.cos(directions), np.sin(directions)])).T
    amplitudes = lengths / np.sqrt(np.sum(lengths**2) / 2)
    phases = rng.uniform(0, 2 * np.pi, size=_NUM_WAVES)
    numbers = lambda values: jnp.asarray(np.asarray(values, np.float32))  # noqa: E731
    return Terrain(
        numbers(waves), numbers(amplitudes), numbers(phases), velocity=numbers([0.12, 0.05])
    )


def simulate(model: Terrain, num_steps: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A path (t, 2) and the heights that are seen along it (t,)."""
    rng = np.random.default_rng(seed)
    steps = np.asarray(model.velocity) + model.drift * rng.normal(size=(num_steps, 2))
    path = model.side * rng.uniform(0.3, 0.7, size=2) + np.cumsum(steps, axis=0)
    path = path.astype(np.float32)
    heights = np.asarray(model.height(jnp.asarray(path)))
    seen = heights + model.sensor_error * rng.normal(size=num_steps)
    return path, seen.astype(np.float32)


def is_near(states: Float[Array, "n 2"], place: Float[Array, "2"]) -> Int[Array, " n"]:
    """1 for particles near the vehicle, 0 for others."""
    return (jnp.sum((states - place[None]) ** 2, axis=1) < NEAR**2).astype(jnp.int32)
