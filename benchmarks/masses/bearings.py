"""A manoeuvring target, seen by two lines of hydrophones that cannot tell left from right.

Each array hears at which angle to its own axis the target is, and not on which side. The two axes
are not quite in line, so that the target's mirror image is no exact one: prior and dynamics tell a
little of which is which, and the masses of the two sides are not equal.
"""

from statistics import NormalDist

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key, PyTree

import mpfjax

SENSORS = np.array([[0.0, 0.0], [10.0, 0.0]], np.float32)
AXES = np.array([0.0, 0.1], np.float32)
TURNS = np.array([0.0, 0.12, -0.12], np.float32)
_STAYS = 0.9
# A normal number below the first keeps the mode; those above it, in equal parts, are for each mode.
_DRAWS_OF_MODE = [NormalDist().inv_cdf(_STAYS + (1 - _STAYS) * i / 3) for i in range(3)]
ACCELERATION = 0.1
NOISE = 0.1
START = np.array([5.0, 0.0, 0.0, 0.0], np.float32)
SPREAD = np.array([3.0, 3.0, 0.15, 0.15], np.float32)
_TRUTH = np.array([3.0, 4.0, 0.12, -0.03])


class BearingsModel(mpfjax.AbstractStateSpaceModel):
    """Position, velocity and the mode of the turn; two angles without a sign are observed.

    States are a dict of `motion`, (n, 4), and `mode`, (n,), in {straight on, left, right}. The
    mode stays with probability 0.9 and is otherwise drawn anew. The velocity turns by the mode's
    angle, and two accelerations are added.
    """

    @property
    def noise_dimension(self) -> int:
        """Two accelerations and the draw of the mode."""
        return 3

    @property
    def initial_noise_dimension(self) -> int:
        """Position and velocity."""
        return 4

    def sample_initial(self, key: Key[Array, ""], num_particles: int) -> PyTree:
        """Around the point between the two arrays, straight on."""
        return self.initial_from_noise(jax.random.normal(key, (num_particles, 4)))

    def initial_from_noise(self, noise: Float[Array, "n 4"]) -> PyTree:
        """The same from standard normal numbers."""
        return {
            "motion": START[None] + SPREAD[None] * noise,
            "mode": jnp.zeros(len(noise), jnp.int32),
        }

    def transition_from_noise(self, noise: Float[Array, "n 3"], states: PyTree) -> PyTree:
        """Two accelerations and a mode from three standard normal numbers."""
        mode = drawn_mode(noise[:, 2], states["mode"])
        return {
            "motion": _moved(states["motion"], mode, ACCELERATION * noise[:, :2]),
            "mode": mode,
        }

    def transition_mean(self, states: PyTree) -> PyTree:
        """The same mode, and no push."""
        motion = states["motion"]
        return states | {"motion": _moved(motion, states["mode"], jnp.zeros_like(motion[:, :2]))}

    def log_likelihood(self, observation: Float[Array, "2"], states: PyTree) -> Float[Array, " n"]:
        """Independent Gaussian errors of the two angles."""
        errors = (observation[:, None] - heard(states["motion"])) / NOISE
        return -0.5 * jnp.sum(errors**2, axis=0) - 2 * jnp.log(NOISE * jnp.sqrt(2 * jnp.pi))


def drawn_mode(noise: Float[Array, " n"], mode: Array) -> Array:
    """The next mode, made of a standard normal number."""
    drawn = sum((noise > bound).astype(jnp.int32) for bound in _DRAWS_OF_MODE[1:])
    return jnp.where(noise < _DRAWS_OF_MODE[0], mode, drawn)


def heard(motion: Float[Array, "n 4"]) -> Float[Array, "2 n"]:
    """The angles between each axis and the direction to the target, from 0 to pi."""
    # A row for each array: in short rows nothing would run on vectors.
    x, y = motion[None, :, 0] - SENSORS[:, :1], motion[None, :, 1] - SENSORS[:, 1:]
    cos, sin = np.cos(AXES)[:, None], np.sin(AXES)[:, None]
    return jnp.arctan2(jnp.abs(cos * y - sin * x), cos * x + sin * y)


def is_above(states: PyTree) -> Array:
    """On which side of the line between the arrays."""
    return (states["motion"][:, 1] > 0).astype(jnp.int32)


def position(states: PyTree) -> Float[Array, "n 2"]:
    """Where the target is, in which components are grouped."""
    return states["motion"][:, :2]


def motion_and_turn(states: PyTree) -> Float[Array, "n 5"]:
    """The motion, and the angle by which the mode turns it: the mode's number says nothing."""
    turn = jnp.asarray(TURNS)[states["mode"]]
    return jnp.concatenate([states["motion"], turn[:, None]], axis=1)


def observations(num_steps: int, seed: int) -> np.ndarray:
    """What is heard of a target that goes straight on, turns, and goes on."""
    rng = np.random.default_rng(seed)
    motion, found = jnp.asarray(_TRUTH[None], jnp.float32), []
    for step in range(num_steps):
        turning = num_steps // 3 <= step < num_steps // 2
        pushed = jnp.asarray(ACCELERATION * rng.normal(size=(1, 2)), jnp.float32)
        motion = _moved(motion, jnp.asarray([2 if turning else 0]), pushed)
        found.append(np.asarray(heard(motion))[:, 0] + NOISE * rng.normal(size=2))
    return np.array(found, np.float32)


def _moved(
    motion: Float[Array, "n 4"], mode: Array, pushed: Float[Array, "n 2"]
) -> Float[Array, "n 4"]:
    """A step on: the velocity turned by the mode's angle and pushed, the position half-way."""
    # Chosen by comparing: nothing that is fused with a gather runs on vectors.
    is_turn = [mode == turn for turn in range(len(TURNS))]
    sin, cos = (jnp.select(is_turn, [*values]) for values in (np.sin(TURNS), np.cos(TURNS)))
    x, y, across, along = motion.T
    new_across = cos * across - sin * along + pushed[:, 0]
    new_along = sin * across + cos * along + pushed[:, 1]
    x, y = x + 0.5 * (across + new_across), y + 0.5 * (along + new_along)
    return jnp.stack([x, y, new_across, new_along], axis=1)
