"""The bearings with a Kalman filter in every particle, of velocity and push given the rest."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key, PyTree

import mpfjax
from benchmarks.masses.bearings import (
    ACCELERATION,
    NOISE,
    SPREAD,
    START,
    TURNS,
    drawn_mode,
    heard,
)


class MarginalisedBearings(mpfjax.AbstractConditionallyLinearModel):
    """`BearingsModel` in the mixed form: the position moves by the velocity, which has no draws.

    The latent is the position, the mode, and the number that draws the next mode. The rest is the
    velocity and the next push: it moves position and velocity alike, so that no noise is shared.
    """

    def sample_initial(self, key: Key[Array, ""], num_particles: int) -> Float[Array, "n 4"]:
        """Straight on, around the point between the two arrays."""
        noise = mpfjax.normal(key, (num_particles, 3))
        position = START[None, :2] + SPREAD[None, :2] * noise[:, :2]
        return jnp.concatenate([position, jnp.zeros_like(noise[:, :1]), noise[:, 2:]], axis=1)

    def initial_moments(self, latent: Float[Array, "n 4"]) -> tuple[Array, Array]:
        """Of velocity and push."""
        del latent
        deviations = jnp.array([*SPREAD[2:], ACCELERATION, ACCELERATION], jnp.float32)
        return jnp.zeros(4), jnp.diag(deviations**2)

    def latent_dynamics(self, previous_latent: Float[Array, "n 4"]) -> tuple[Array, Array, Array]:
        """The mean of both velocities is added to the position; the next mode is known."""
        mode = drawn_mode(previous_latent[:, 3], previous_latent[:, 2].astype(jnp.int32))
        moved = [previous_latent[:, :2], mode[:, None].astype(jnp.float32)]
        offset = jnp.concatenate([*moved, jnp.zeros((len(mode), 1))], axis=1)
        half = 0.5 * jnp.eye(2)[None]
        of_velocity = half + 0.5 * _turned(mode)
        matrix = jnp.concatenate([of_velocity, jnp.broadcast_to(half, of_velocity.shape)], axis=2)
        return (
            offset,
            jnp.pad(matrix, ((0, 0), (0, 2), (0, 0))),
            jnp.diag(jnp.array([0.0, 0.0, 0.0, 1.0])),
        )

    def dynamics(
        self, latent: Float[Array, "n 4"], previous_latent: Float[Array, "n 4"]
    ) -> tuple[Array, Array, Array]:
        """The velocity turns and is pushed; the next push is new."""
        del previous_latent
        turned = _turned(latent[:, 2].astype(jnp.int32))
        identity = jnp.broadcast_to(jnp.eye(2), turned.shape)
        matrix = jnp.pad(jnp.concatenate([turned, identity], axis=2), ((0, 0), (0, 2), (0, 0)))
        variance = ACCELERATION**2
        return matrix, jnp.zeros(4), jnp.diag(jnp.array([0.0, 0.0, variance, variance]))

    def emission(self, latent: Float[Array, "n 4"]) -> None:
        """The bearings say nothing of the velocity, given the position."""
        del latent

    def log_likelihood(self, observation: Float[Array, "2"], states: PyTree) -> Float[Array, " n"]:
        """Independent Gaussian errors of the two angles."""
        errors = (observation[:, None] - heard(states)) / NOISE
        return -0.5 * jnp.sum(errors**2, axis=0) - 2 * jnp.log(NOISE * jnp.sqrt(2 * jnp.pi))


def _turned(mode: Array) -> Float[Array, "n 2 2"]:
    cos, sin = (jnp.asarray(f(TURNS), jnp.float32)[mode] for f in (np.cos, np.sin))
    return jnp.stack([jnp.stack([cos, -sin], 1), jnp.stack([sin, cos], 1)], 1)


def is_above(states: mpfjax.MarginalisedState) -> Array:
    """On which side of the line between the arrays."""
    return (states.latent[:, 1] > 0).astype(jnp.int32)


def position(states: mpfjax.MarginalisedState) -> Float[Array, "n 2"]:
    """Where the target is, in which components are grouped."""
    return states.latent[:, :2]
