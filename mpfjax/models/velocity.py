"""A random walk about a steady velocity, which is learned from the steps."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Key

from mpfjax.checks import check_not_negative_array, check_type, shown, to_array
from mpfjax.models.dynamics import AbstractDynamics, AbstractRandomWalk
from mpfjax.operations.random import normal


def _as_shares(gain: Any) -> tuple[float, ...]:
    try:
        return tuple(map(float, np.ravel(gain)))
    except (TypeError, ValueError) as error:
        raise ValueError(f"gain: {shown(gain)} is no number, nor one a coordinate") from error


class WalkWithVelocity(AbstractDynamics):
    """x_t = x_{t-1} + v_{t-1} + e_t and v_t = v_{t-1} + gain · e_t, with e_t a step of `walk`.

    The local linear trend in innovations form: Holt's smoothing as a model (Hyndman, Koehler, Ord
    and Snyder 2008, chapter 3, with α = 1). v is the mean that a Kalman filter in its steady state
    has of a velocity that is itself a random walk, so that a particle carries its velocity without
    drawing it. With a gain of 0, v never changes; with 1, it is the last displacement.

    The past that a model keeps is x_t - v_t, the place from which x_t would come at its velocity
    (`remembered`).

    - `walk`: the noise of x_t, a `RandomWalk` or `RandomWalkWithJumps`.
    - `gain`: in [0, 1], a number or one a coordinate. v averages over about 1 / gain steps.
    - `initial_velocity`: deviations of v_0 about 0, of the shape of the walk's deviations, in units
      of the state a frame; None takes 0.

    Raises `TypeError` for another walk, and `ValueError` for a gain outside [0, 1], a negative
    deviation and shapes that do not fit. Use it where objects keep their velocity: look-alikes that
    cross keep their identities, and a hidden object moves on.
    """

    walk: AbstractRandomWalk
    gain: tuple[float, ...] = eqx.field(static=True, converter=_as_shares)
    initial_velocity: Float[Array, "*n d"]

    def __init__(
        self,
        walk: AbstractRandomWalk,
        gain: float | Sequence[float] = 0.1,
        initial_velocity: ArrayLike | Sequence[float] | None = None,
    ) -> None:
        check_type(AbstractRandomWalk, "a walk such as RandomWalk(deviations)", walk=walk)
        still = jnp.zeros_like(walk.deviations)
        self.walk = walk
        self.gain = _as_shares(gain)
        given = still if initial_velocity is None else initial_velocity
        self.initial_velocity = to_array("initial_velocity")(given)

    def __check_init__(self) -> None:
        d = self.walk.deviations.shape[-1]
        if len(self.gain) not in (1, d) or not all(0 <= g <= 1 for g in self.gain):
            raise ValueError(f"gain: {self.gain} is not one or {d} numbers in [0, 1]")
        if self.initial_velocity.shape != self.walk.deviations.shape:
            raise ValueError(
                f"initial_velocity: shape {self.initial_velocity.shape} is not that of the walk's"
                f" deviations, {self.walk.deviations.shape}"
            )
        check_not_negative_array(initial_velocity=self.initial_velocity)

    @property
    def order(self) -> int:
        """2: the velocity is kept beside x_t."""
        return 2

    @property
    def is_shared(self) -> bool:
        """Whether there is one walk for all."""
        return self.walk.is_shared

    @property
    def noise_dimension(self) -> int:
        """That of the walk."""
        return self.walk.noise_dimension

    def from_noise(
        self,
        noise: Float[Array, "n k"],
        current: Float[Array, "n d"],
        previous: Float[Array, "n d"] | None = None,
    ) -> Float[Array, "n d"]:
        """A step of the walk from x_{t-1} + v_{t-1}."""
        return self.walk.from_noise(noise, _expected(current, previous))

    def sample(
        self,
        key: Key[Array, ""],
        current: Float[Array, "n d"],
        previous: Float[Array, "n d"] | None = None,
    ) -> Float[Array, "n d"]:
        """The same, as the walk draws it."""
        return self.walk.sample(key, _expected(current, previous))

    def log_density(
        self,
        following: Float[Array, "n d"],
        current: Float[Array, "n d"],
        previous: Float[Array, "n d"] | None = None,
    ) -> Float[Array, " n"]:
        """That of the walk from x_{t-1} + v_{t-1}."""
        return self.walk.log_density(following, _expected(current, previous))

    def moments(
        self, current: Float[Array, "n d"], previous: Float[Array, "n d"] | None = None
    ) -> tuple[Float[Array, "n d"], Float[Array, "n d"]]:
        """x_{t-1} + v_{t-1}, and the walk's deviations."""
        return self.walk.moments(_expected(current, previous))

    def remembered(
        self,
        following: Float[Array, "n d"],
        current: Float[Array, "n d"],
        previous: Float[Array, "n d"] | None,
    ) -> Float[Array, "n d"]:
        """x_t - v_t, with v_t = v_{t-1} + gain · (x_t - x_{t-1} - v_{t-1})."""
        expected = _expected(current, previous)
        gain = jnp.asarray(self.gain, current.dtype)[None]
        return following - (expected - current) - gain * (following - expected)

    def initial_past(
        self, key: Key[Array, ""], current: Float[Array, "n d"]
    ) -> Float[Array, "n d"]:
        """x_0 - v_0, with v_0 ~ N(0, diag(initial_velocity²))."""
        deviations = jnp.broadcast_to(self.initial_velocity, current.shape)
        return current - deviations * normal(key, current.shape, current.dtype)


def _expected(
    current: Float[Array, "n d"], previous: Float[Array, "n d"] | None
) -> Float[Array, "n d"]:
    """x_{t-1} + v_{t-1}."""
    if previous is None:
        raise ValueError("previous: a WalkWithVelocity needs x_{t-1} - v_{t-1}")
    return 2 * current - previous
