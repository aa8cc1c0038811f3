"""A robot at an unknown pose on its map: its odometry, and the model of both."""

from typing import Annotated, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Key, PyTree

from mpfjax.arrays import POSITIVE, Fitting, check_spacing, to_array, to_rows
from mpfjax.checks import NotNegative, Rule, check, checked, warn
from mpfjax.models.base import AbstractStateSpaceModel
from mpfjax.models.gaussians import log_normal
from mpfjax.operations.random import normal, split, uniform
from mpfjax.operations.stored import select_rows
from mpfjax.robots.maps import OccupancyGrid, Poses
from mpfjax.robots.sensors import POSE, Weight

_AT_REST = 1e-4  # metres and radians: the least deviation of a step, so that each has a density
_IN_PLACE = 0.01  # metres: a shorter step has no direction, and is a turn, as in AMCL
_MOTION = Rule(lambda motion: hasattr(motion, "from_noise"), "a motion, as OdometryMotion()")
_SENSOR = Rule(lambda sensor: hasattr(sensor, "log_likelihood"), "a sensor, as LikelihoodField()")


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

    Raises `ValueError` for one of the two alone, and for headings in degrees: turns of more than 2π
    from one pose to the next, or headings along the way only if they are in degrees.
    """
    rows = _poses_of(poses)
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


def _poses_of(poses: Any) -> Float[np.ndarray, "t 3"]:
    """Poses as float64, whose headings are in radians."""
    rows = to_rows(3, "poses", poses)
    turns = np.abs(np.diff(rows[:, 2]))
    if turns.size and np.nanmax(turns) > 2 * np.pi + 0.01:
        degrees = "is more than a full turn; headings are in radians, np.deg2rad(...)"
        raise ValueError(f"poses: a turn of {np.nanmax(turns):.4g} from one to the next {degrees}")
    # A robot drives along its heading, forwards or backwards.
    headings, way = rows[:-1, 2], np.diff(rows[:, :2], axis=0) @ [1, 1j]
    if np.nansum(np.abs(way)) > 0 and np.nanmax(np.abs(headings)) > 2 * np.pi:
        along, along_degrees = (
            np.nansum(np.real((way * np.exp(-1j * each)) ** 2)) / np.nansum(np.abs(way) ** 2)
            for each in (headings, np.deg2rad(headings))
        )
        if along < 0.8 and along_degrees > 0.9:
            raise ValueError("poses: headings that fit the way in degrees; use np.deg2rad(...)")
    return rows


@checked
def interpolated_poses(times: Any, pose_times: Any, poses: Any) -> Float[np.ndarray, "s 3"]:
    """Poses at the time stamps of scans, (s,), from poses of odometry, (t,) and (t, 3).

    Positions are interpolated linearly, headings along the shorter turn. Raises `ValueError` for
    times of poses that do not increase, for scans before the first pose or after the last one, and
    for headings in degrees, as `odometry_steps`. Use it before `odometry_steps` if scans and
    odometry have separate time stamps.
    """
    rows, at = _poses_of(poses), np.asarray(times, float)
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


class RobotModel(AbstractStateSpaceModel, Fitting):
    """A robot on a map: states are poses (x, y, heading), in metres and radians.

    - `grid`: the map, see `read_map`.
    - `motion`: `OdometryMotion`, or another with `noise_dimension` and `from_noise(noise, poses,
      odometry)`.
    - `sensor`: `LikelihoodField`, `BeamModel`, or another with `log_likelihood(scan, poses, grid)`.
    - `clearance`: x_0 is farther than this from all occupied cells, metres; the robot's radius.
    - `initial_pose`, `initial_deviations`: x_0 is normal about this pose, with these standard
      deviations of x, y and heading. None: it is uniform over the free cells and over all headings.

    Inputs are odometry, one step (forward, left, turn) in the robot's frame at a time, see
    `odometry_steps`, and observations are scans (k,), in which some beams may be missing. The robot
    may be where the map is free or unknown, and nowhere else: a step that ends in an occupied cell
    or off the map only turns it, so that a filter that lost the robot has no particles in walls,
    and the likelihood of a draw of x_0 in a wall is zero. `starts` are the corners of the cells of
    x_0.

    Raises `ValueError` if no cell is free, and for an `initial_pose` off the map, in an occupied
    cell, or with coordinates that float32 cannot resolve. Warns of inputs that look like poses.
    """

    grid: OccupancyGrid
    motion: Annotated[Any, _MOTION]
    sensor: Annotated[Any, _SENSOR]
    starts: Float[Array, "cells 2"]
    clearance: NotNegative = eqx.field(static=True)
    initial_pose: Annotated[Float[Array, "3"], POSE] | None
    initial_deviations: Annotated[Float[Array, "3"], POSITIVE]
    inputs: Any

    handles_missing = True
    periods = np.array([0.0, 0.0, 2 * np.pi])

    def __init__(
        self, grid: Any, motion: Any, sensor: Any, *, clearance: float = 0.0,
        initial_pose: Any = None, initial_deviations: Any = (0.5, 0.5, np.pi / 12),
        inputs: PyTree = None,
    ) -> None:  # fmt: skip
        check(OccupancyGrid, grid=grid)
        self.grid, self.motion, self.sensor, self.clearance = grid, motion, sensor, clearance
        self.initial_pose = to_array("initial_pose")(initial_pose)
        self.initial_deviations = to_array("initial_deviations")(initial_deviations)
        is_start = np.asarray(grid.free & (grid.distances > clearance))
        corners = np.argwhere(is_start)[:, ::-1] * grid.resolution + grid.origin
        self.starts = jnp.asarray(corners, float)
        if not len(self.starts):
            raise ValueError(f"clearance: no free cell is {clearance} m from all occupied ones")
        self.inputs = inputs

    def __check_init__(self) -> None:
        super().__check_init__()
        pose, deviations = self.initial_pose, self.initial_deviations
        if pose is None or isinstance(pose, Tracer):
            return
        check_spacing("initial_pose", pose[:2], deviations[:2], "their standard deviation is")
        if not bool(self._may_be_at(pose[None])[0]):
            x, y = map(float, pose[:2])
            inside = bool(self.grid.at(pose[:2], self.grid.occupied, False))
            where = "in an occupied cell" if inside else "off the map"
            raise ValueError(f"initial_pose: ({x:g}, {y:g}) is {where}")

    def check_inputs(self, inputs: Any) -> None:
        """Warn of odometry that looks like poses, whose headings point along their path."""
        if getattr(inputs, "shape", ())[1:] != (3,) or len(inputs) < 8:
            return
        poses = np.asarray(inputs, float)
        x, y = np.diff(poses[:, :2], axis=0).T
        far, headings = np.hypot(x, y), poses[:-1, 2]
        along = np.abs(np.cos(np.arctan2(y, x) - headings))
        if np.sum(far * along) > 0.9 * np.sum(far) > 0 and np.mean(np.abs(headings)) > 0.5:
            warn("inputs: they look like poses; a RobotModel takes odometry_steps(poses)")

    def _may_be_at(self, poses: Poses) -> Array:
        """Whether each pose is on the map, and in no occupied cell."""
        return self.grid.at(poses[:, :2], ~self.grid.occupied, False)

    def sample_initial(self, key: Key[Array, ""], num_particles: int) -> Poses:
        """x_0."""
        if self.initial_pose is not None:
            noise = normal(key, (num_particles, 3), self.initial_pose.dtype)
            return self.initial_pose[None] + self.initial_deviations[None] * noise
        key_cell, key_rest = split(key, 2)
        cells = self.starts[jax.random.randint(key_cell, (num_particles,), 0, len(self.starts))]
        shares = uniform(key_rest, (num_particles, 3))
        places = cells + self.grid.resolution * shares[:, :2]
        return jnp.concatenate([places, np.pi * (2 * shares[:, 2:] - 1)], axis=1)

    def log_initial(self, states: Poses) -> Float[Array, " n"]:
        """log p(x_0), per square metre and radian."""
        if self.initial_pose is not None:
            x, y, turn = (states - self.initial_pose[None]).T
            steps = jnp.stack([x, y, wrap(turn)], axis=1)
            return jnp.sum(log_normal(steps, self.initial_deviations[None]), axis=1)
        is_start = self.grid.free & (self.grid.distances > self.clearance)
        density = 1 / (2 * np.pi * len(self.starts) * self.grid.resolution**2)
        return jnp.where(self.grid.at(states[:, :2], is_start, False), np.log(density), -jnp.inf)

    @property
    def noise_dimension(self) -> int:
        """The number of coordinates of the motion's noise."""
        return self.motion.noise_dimension

    def transition_from_noise(self, noise: Float[Array, "n k"], states: Poses) -> Poses:
        """x_t, after the step of the odometry, or its turn alone where a wall is in the way."""
        if self.inputs is None:
            raise ValueError("inputs: None, but a RobotModel needs odometry, a row for each step")
        moved = self.motion.from_noise(noise, states, self.inputs)
        places = select_rows(self._may_be_at(moved), moved[:, :2], states[:, :2])
        return jnp.concatenate([places, moved[:, 2:]], axis=1)

    def log_likelihood(self, observation: Float[Array, " k"], states: Poses) -> Float[Array, " n"]:
        """log p of a scan at each pose."""
        logs = self.sensor.log_likelihood(observation, states, self.grid)
        return jnp.where(self._may_be_at(states), logs, -jnp.inf)
