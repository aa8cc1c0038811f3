"""A target on a line that jumps now and then, and of which only the distance is seen."""

from statistics import NormalDist

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

import mpfjax


class JumpModel(mpfjax.AbstractStateSpaceModel):
    """A random walk whose steps are long with a small probability, seen through its absolute value.

    Both sides are possible, and the prior tells a little of which is which. A jump may lead to the
    other side, so that what the first steps said is forgotten by and by.

    - `centre`, `spread`: mean and deviation of x_0. `step`, `jump`: deviations of a short step and
      of a long one. `jump_probability`. `sensor_error`: a deviation.

    States and observations are scalars, (n,) and ().
    """

    centre: float = eqx.field(static=True, default=1.0)
    spread: float = eqx.field(static=True, default=4.0)
    step: float = eqx.field(static=True, default=0.2)
    jump: float = eqx.field(static=True, default=4.0)
    jump_probability: float = eqx.field(static=True, default=0.05)
    sensor_error: float = eqx.field(static=True, default=0.2)

    @property
    def noise_dimension(self) -> int:
        """The step, and whether it is long."""
        return 2

    @property
    def initial_noise_dimension(self) -> int:
        """1."""
        return 1

    def sample_initial(self, key: Key[Array, ""], num_particles: int) -> Float[Array, " n"]:
        """x_0 ~ N(centre, spread²)."""
        return self.initial_from_noise(jax.random.normal(key, (num_particles, 1)))

    def initial_from_noise(self, noise: Float[Array, "n 1"]) -> Float[Array, " n"]:
        """The same from standard normal numbers."""
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


def simulate(model: JumpModel, num_steps: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A path (t,) and the distances that are seen along it (t,)."""
    rng = np.random.default_rng(seed)
    is_long = rng.random(num_steps) < model.jump_probability
    steps = np.where(is_long, model.jump, model.step) * rng.normal(size=num_steps)
    path = model.centre + model.spread * rng.normal() + np.cumsum(steps)
    seen = np.abs(path) + model.sensor_error * rng.normal(size=num_steps)
    return path.astype(np.float32), seen.astype(np.float32)


def _log_normal(errors: Float[Array, " n"], deviation: float) -> Float[Array, " n"]:
    return -0.5 * (errors / deviation) ** 2 - jnp.log(deviation * jnp.sqrt(2 * jnp.pi))
