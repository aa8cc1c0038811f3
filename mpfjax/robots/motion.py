"""Odometry: steps between poses, their noise, and poses at other times."""

from typing import Annotated, Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mpfjax.arrays import NOT_NEGATIVE, Fitting, to_array, to_rows
from mpfjax.checks import NotNegative, checked
from mpfjax.robots.maps import Poses

Weight = Annotated[Float[Array, ""], NOT_NEGATIVE]

_AT_REST = 1e-4  # metres and radians: the least deviation of a step, so that each has a density
_IN_PLACE = 0.01  # metres: a shorter step has no direction, and is a turn, as in AMCL


class OdometryMotion(Fitting):
    """Odometry as a rotation, a translation and a rotation: Thrun et al. (2005), table 5.6.

    A step (forward, left, turn) is rot1, trans and rot2, to which normal noise is added with

        var rot1  = alpha1 rot1² + alpha2 trans²
        var trans = alpha3 trans² + alpha4 (rot1² + rot2²)
        var rot2  = alpha1 rot2² + alpha2 trans²

    As in AMCL, a backward drive has a negative trans and no rotation of π, and a step below 1 cm
    has no direction: its noise is that of a rotation alone. Each standard deviation is at least
    10⁻⁴ (m, rad).
    """

    alpha1: Weight = eqx.field(kw_only=True, converter=to_array("alpha1"), default=0.2)
    alpha2: Weight = eqx.field(kw_only=True, converter=to_array("alpha2"), default=0.2)
    alpha3: Weight = eqx.field(kw_only=True, converter=to_array("alpha3"), default=0.2)
    alpha4: Weight = eqx.field(kw_only=True, converter=to_array("alpha4"), default=0.2)

    noise_dimension = 3

    def from_noise(
        self, noise: Float[Array, "n 3"], poses: Poses, odometry: Float[Array, "3"]
    ) -> Poses:
        """Poses after the step, as a function of standard normal noise."""
        forward, left, turn = odometry
        way = jnp.where(forward < 0, -1, 1).astype(forward.dtype)
        trans, rot1 = way * jnp.hypot(forward, left), jnp.arctan2(way * left, way * forward)
        rot2 = wrap(turn - rot1)
        one = jnp.where(jnp.abs(trans) < _IN_PLACE, 0.0, rot1) ** 2
        other, drive = jnp.where(jnp.abs(trans) < _IN_PLACE, turn, rot2) ** 2, trans**2
        variances = [
            self.alpha1 * one + self.alpha2 * drive,
            self.alpha3 * drive + self.alpha4 * (one + other),
            self.alpha1 * other + self.alpha2 * drive,
        ]
        deviations = jnp.sqrt(jnp.stack(variances) + _AT_REST**2)
        first, far, second = (jnp.stack([rot1, trans, rot2])[None] + deviations[None] * noise).T
        x, y, heading = poses.T
        x, y = x + far * jnp.cos(heading + first), y + far * jnp.sin(heading + first)
        return jnp.stack([x, y, wrap(heading + first + second)], axis=1)


@checked
def odometry_steps(
    poses: Any, min_distance: NotNegative | None = None, min_turn: NotNegative | None = None
) -> Any:
    """The inputs of a `RobotModel`: (forward, left, turn) from each pose (t + 1, 3) to the next.

    The poses are those of odometry, whose frame may drift. Each step is in the frame of the robot
    before it.

    With `min_distance` in metres and `min_turn` in radians, poses are left out until the robot has
    moved or turned by so much since the last one that stays, as `update_min_d` and `update_min_a`
    do in AMCL (.25, .2). The result is then the steps, (s, 3), and which of the scans 1..t of these
    poses stay, (s,): `steps, stay = odometry_steps(poses, .25, .2)`, `run_filter(..., scans[stay],
    inputs=steps)`. The noise of `OdometryMotion` is made for such steps: the alphas multiply
    squares, so that the same way in more steps has less noise, and an odometry that trembles at
    rest has a lot.

    Raises `ValueError` for one of the two alone, and for turns of more than 2π from one pose to the
    next, as headings in degrees make.
    """
    rows = to_rows(3, "poses", poses)
    turns = np.abs(np.diff(rows[:, 2]))
    if turns.size and np.nanmax(turns) > 2 * np.pi + 0.01:
        degrees = "is more than a full turn; headings are in radians, np.deg2rad(...)"
        raise ValueError(f"poses: a turn of {np.nanmax(turns):.4g} from one to the next {degrees}")
    if (min_distance is None) != (min_turn is None):
        raise ValueError(f"min_distance, min_turn: {min_distance}, {min_turn}; give both or none")
    if min_distance is None or min_turn is None:
        return _steps(rows)
    stay = [0]
    for number, pose in enumerate(rows):
        forward, left, turn = _steps(np.stack([rows[stay[-1]], pose]))[0]
        if number and (np.hypot(forward, left) >= min_distance or abs(turn) >= min_turn):
            stay.append(number)
    return _steps(rows[stay]), np.array(stay[1:], int) - 1


def _steps(poses: np.ndarray) -> np.ndarray:
    x, y, turn = np.diff(poses, axis=0).T
    cos, sin = np.cos(poses[:-1, 2]), np.sin(poses[:-1, 2])
    return np.stack([cos * x + sin * y, cos * y - sin * x, wrap(turn)], axis=1)


@checked
def interpolated_poses(times: Any, pose_times: Any, poses: Any) -> Float[np.ndarray, "s 3"]:
    """Poses at the time stamps of scans, (s,), from poses of odometry, (t,) and (t, 3).

    Positions are interpolated linearly, headings along the shorter turn. Raises `ValueError` for
    times of poses that do not increase, and for scans before the first pose or after the last one.
    Use it before `odometry_steps` if scans and odometry have separate time stamps.
    """
    rows, at = to_rows(3, "poses", poses), np.asarray(times, float)
    knots = np.asarray(pose_times, float)
    if knots.shape != (len(rows),) or not (np.diff(knots) > 0).all():
        raise ValueError(f"pose_times: {knots.shape}, not rising times, one for each pose")
    if at.size and not (knots[0] <= at.min() and at.max() <= knots[-1]):
        raise ValueError(f"times: not all within {knots[0]:.15g}..{knots[-1]:.15g} of pose_times")
    columns = (*rows[:, :2].T, np.unwrap(rows[:, 2]))
    x, y, turn = (np.interp(at, knots, column) for column in columns)
    return np.stack([x, y, wrap(turn)], axis=1)


def wrap(angles: Any) -> Any:
    """In [-π, π)."""
    return (angles + np.pi) % (2 * np.pi) - np.pi
