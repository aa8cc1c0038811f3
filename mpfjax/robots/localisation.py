"""The model of a robot at an unknown pose on its map."""

from typing import Annotated, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Key, PyTree

from mpfjax.arrays import POSITIVE, Fitting, check_spacing, to_array
from mpfjax.checks import NotNegative, Rule, check, warn
from mpfjax.models.base import AbstractStateSpaceModel
from mpfjax.models.gaussians import log_normal
from mpfjax.operations.random import normal, split, uniform
from mpfjax.operations.stored import select_rows
from mpfjax.robots.maps import OccupancyGrid, Poses
from mpfjax.robots.motion import wrap
from mpfjax.robots.sensors import POSE

_MOTION = Rule(lambda motion: hasattr(motion, "from_noise"), "a motion, as OdometryMotion()")
_SENSOR = Rule(lambda sensor: hasattr(sensor, "log_likelihood"), "a sensor, as LikelihoodField()")


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
        follows = np.sum(far * along) > 0.9 * np.sum(far) > 0
        if follows and np.mean(np.abs(headings)) > 0.5:
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
