"""The scalar model with two symmetric modes, Vermaak et al. (2003), section 5.1."""

from typing import Annotated, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from mpfjax.arrays import POSITIVE, Fitting, to_array
from mpfjax.checks import Finite
from mpfjax.models.base import AbstractStateSpaceModel
from mpfjax.models.gaussians import log_normal
from mpfjax.models.noise import stratified_uniform
from mpfjax.operations.random import normal, uniform

States = Float[Array, " n"]
Deviation = Annotated[Float[Array, ""], POSITIVE]


class QuadraticModel(AbstractStateSpaceModel, Fitting):
    """A random walk whose square is observed: D = N(x_{t-1}, σ_x²), L = N(y_t; x_t², σ_y²).

    Vermaak et al. (2003), section 5.1. The observation does not depend on the sign of x_t. With a
    symmetric prior, the posterior therefore has two modes of exactly equal probability, at about ±
    sqrt(y_t).

    - `sigma_x`, `sigma_y`: standard deviations, positive.
    - `low`, `high`: x_0 is uniform on [low, high].
    - `initial_draw`: "stratified" draws one x_0 in each of n equal cells. "independent" draws have
      gaps, and with small n they may miss a mode before the first observation.

    States have shape (n,), observations are scalars. Raises `ValueError` for a deviation that is
    not positive, an empty range or an unknown draw. Use it to test which filters retain both modes.
    """

    sigma_x: Deviation = eqx.field(converter=to_array("sigma_x"), default=0.1)
    sigma_y: Deviation = eqx.field(converter=to_array("sigma_y"), default=0.1)
    low: Finite = eqx.field(static=True, default=-2.5)
    high: Finite = eqx.field(static=True, default=2.5)
    initial_draw: Literal["stratified", "independent"] = eqx.field(
        static=True, default="stratified", kw_only=True
    )

    def __check_init__(self) -> None:
        super().__check_init__()
        if not self.low < self.high:
            raise ValueError(f"high: {self.high} is not above low, {self.low}")

    def sample_initial(self, key: Key[Array, ""], num_particles: int) -> States:
        """x_0, uniform on [low, high]."""
        if self.initial_draw == "stratified":
            shares = stratified_uniform(key, num_particles)
        else:
            shares = uniform(key, (num_particles,))
        return self.low + (self.high - self.low) * shares

    noise_dimension = initial_noise_dimension = 1

    def initial_from_noise(self, noise: Float[Array, "n 1"]) -> States:
        """x_0, uniform on [low, high]."""
        return self.low + (self.high - self.low) * jax.scipy.special.ndtr(noise[:, 0])

    def transition_from_noise(self, noise: Float[Array, "n 1"], states: States) -> States:
        """x_t ~ N(x_{t-1}, σ_x²)."""
        return states + self.sigma_x * noise[:, 0]

    def log_likelihood(self, observation: Float[Array, ""], states: States) -> Float[Array, " n"]:
        """log N(y_t; x_t², σ_y²); raises `ValueError` for an observation that is no scalar."""
        if jnp.ndim(observation) != 0:
            raise ValueError(f"observation: shape {jnp.shape(observation)} is not that of a scalar")
        return log_normal(observation - states**2, self.sigma_y)

    def sample_observation(self, key: Key[Array, ""], states: States) -> Float[Array, " n"]:
        """y_t ~ N(x_t², σ_y²) of every state."""
        return states**2 + self.sigma_y * normal(key, states.shape, states.dtype)

    def log_transition(self, states: States, previous_states: States) -> Float[Array, " n"]:
        """log N(x_t; x_{t-1}, σ_x²)."""
        return log_normal(states - previous_states, self.sigma_x)

    def log_initial(self, states: States) -> Float[Array, " n"]:
        """log p(x_0), uniform on [low, high]."""
        inside = (states >= self.low) & (states <= self.high)
        return jnp.where(inside, -jnp.log(self.high - self.low), -jnp.inf)

    def transition_mean(self, states: States) -> Float[Array, " n"]:
        """x_{t-1}."""
        return states

    def observation_mean(self, states: States) -> Float[Array, " n"]:
        """x_t²."""
        return states**2

    @property
    def transition_covariance(self) -> Float[Array, "1 1"]:
        """σ_x²."""
        return (self.sigma_x**2).reshape(1, 1)

    @property
    def observation_covariance(self) -> Float[Array, "1 1"]:
        """σ_y²."""
        return (self.sigma_y**2).reshape(1, 1)
