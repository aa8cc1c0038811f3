"""A robot that knows its map, and not its place: occupancy grids, laser scanners and odometry.

After Thrun, Burgard and Fox (2005), *Probabilistic Robotics*, with the names that AMCL and nav2
give to parameters. Places are (x, y) in metres, poses (x, y, heading) with radians.
"""

import abc
from pathlib import Path
from typing import Annotated, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtr
from jaxtyping import Array, Bool, Float, Key, Shaped
from scipy.ndimage import distance_transform_edt

from mpfjax.checks import (
    FINITE,
    NOT_NEGATIVE,
    POSITIVE,
    Count,
    Exponent,
    Fitting,
    NotNegative,
    Positive,
    check_shape,
    checked,
    optional,
    to_array,
    to_numbers,
)
from mpfjax.models.base import AbstractStateSpaceModel, replaced
from mpfjax.models.gaussians import log_normal
from mpfjax.operations.random import normal, split, uniform

Poses = Float[Array, "n 3"]
Angles = Float[Array, " b"]
Beams = Float[Array, "n b"]
Cells = Shaped[Array, "rows columns"]
Weight = Annotated[Float[Array, ""], NOT_NEGATIVE]
Scale = Annotated[Float[Array, ""], POSITIVE]

_AT_REST = 1e-4  # metres and radians: the least deviation of a step, so that each has a density
_IN_PLACE = 0.01  # metres: a shorter step has no direction, and is a turn, as in AMCL


class OccupancyGrid(Fitting):
    """A map of cells, each of which is occupied, free or unknown.

    - `occupied`: (rows, columns), from the lowest y up. At least one cell is.
    - `free`: of the same shape; a cell that is neither is unknown, and one that is both occupied.
      None takes all others.
    - `resolution`: the side of a cell in metres.
    - `origin`: (x, y) of the lower left corner of the cell [0, 0].

    `distances` are metres from each cell's centre to that of the nearest occupied one. Raises
    `ValueError` for arrays that do not fit, and a map without walls. Use `read_map` for one in a
    file.
    """

    occupied: Bool[Array, "rows columns"]
    free: Bool[Array, "rows columns"]
    distances: Float[Array, "rows columns"]
    table: Float[Array, "rows columns angles"] | None
    resolution: Positive = eqx.field(static=True)
    origin: Annotated[tuple[float, ...], FINITE] = eqx.field(static=True)

    def __init__(
        self, occupied: Any, free: Any = None, *, resolution: float, origin: Any = (0.0, 0.0)
    ) -> None:
        walls = np.asarray(occupied, bool)
        if not walls.any():
            raise ValueError("occupied: no cell is, so that nothing is at a distance")
        self.occupied = jnp.asarray(walls)
        self.free = ~self.occupied if free is None else jnp.asarray(free, bool) & ~self.occupied
        self.resolution, self.table = resolution, None
        self.origin = to_numbers("origin")(origin)[:2]
        self.distances = jnp.asarray(resolution * np.asarray(distance_transform_edt(~walls)), float)

    def cells(self, places: Float[Array, "*n 2"]) -> tuple[Array, Array, Array]:
        """Row and column of each place, or of the nearest cell, and whether it is on the map."""
        columns, rows = (
            jnp.floor((places[..., k] - self.origin[k]) / self.resolution).astype(jnp.int32)
            for k in (0, 1)
        )
        height, width = self.occupied.shape
        inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
        return jnp.clip(rows, 0, height - 1), jnp.clip(columns, 0, width - 1), inside

    def at(self, places: Float[Array, "*n 2"], values: Cells, outside: Any) -> Shaped[Array, "*n"]:
        """The value of the cell of each place, such as of `grid.free`, and another off the map."""
        rows, columns, inside = self.cells(places)
        return jnp.where(inside, values[rows, columns], outside)

    def ranges(self, poses: Poses, angles: Angles, max_range: float) -> Beams:
        """Metres from each pose to the first occupied cell along each angle, or `max_range`.

        The angles are counted from the heading. Each ray advances by the field of distances, which
        no wall is nearer than (sphere tracing: Hart 1996), and ends at most half a cell inside a
        wall. Unknown cells do not stop it, and beyond the map there is none. With a table, see
        `tabulated`, a range is looked up.
        """
        if self.table is not None:
            rows, columns, _ = self.cells(poses[:, None, :2])
            number = self.table.shape[2]
            turns = (poses[:, 2:] + angles[None]) * (number / (2 * np.pi))
            found = self.table[rows, columns, jnp.round(turns).astype(jnp.int32) % number]
            return jnp.minimum(found, max_range)
        # The loop has no derivative in reverse, and a range none that is of use.
        poses = jax.lax.stop_gradient(poses)
        # From anywhere in a cell to anywhere in another is a diagonal less than between centres.
        diagonal, least = self.resolution * np.sqrt(2), self.resolution / 2

        def advance(carry: tuple[Array, Array]) -> tuple[Array, Array]:
            reach, _ = carry
            gaps = self.at(_ends(poses, angles, reach), self.distances, jnp.inf)
            steps = jnp.where(gaps > 0, jnp.maximum(gaps - diagonal, least), 0.0)
            farther = jnp.minimum(reach + steps, max_range)
            return farther, jnp.any(farther > reach)

        start = jnp.zeros((len(poses), len(angles)), poses.dtype), jnp.array(True)
        return jax.lax.while_loop(lambda carry: carry[1], advance, start)[0]

    def tabulated(self, num_angles: int = 120) -> "OccupancyGrid":
        """The map with all ranges from each cell's centre at so many angles, looked up by `ranges`.

        It has rows · columns · num_angles numbers. Use it with a `BeamModel`, whose step then takes
        a small part of the time.
        """
        angles = jnp.arange(num_angles, dtype=float) * (2 * np.pi / num_angles)
        rows, columns = self.resolution * (np.indices(self.occupied.shape) + 0.5)
        x, y = self.origin[0] + columns, self.origin[1] + rows
        poses = jnp.asarray(np.stack([x, y, 0 * x], axis=-1), float)
        farthest = self.resolution * sum(self.occupied.shape)
        found = jax.lax.map(lambda row: self.ranges(row, angles, farthest), poses)
        return replaced(self, table=found)


def _ends(poses: Poses, angles: Angles, ranges: Float[Array, "#n b"]) -> Float[Array, "n b 2"]:
    """Where beams of these ranges end."""
    cos, sin = jnp.cos(poses[:, 2:]), jnp.sin(poses[:, 2:])
    ahead, across = ranges * jnp.cos(angles)[None], ranges * jnp.sin(angles)[None]
    x, y = cos * ahead - sin * across, sin * ahead + cos * across
    return poses[:, None, :2] + jnp.stack([x, y], axis=-1)


@checked
def read_map(
    path: str | Path, *, resolution: Positive | None = None, origin: tuple[float, ...] = (0.0, 0.0)
) -> OccupancyGrid:
    """The map in ROS's `map.yaml`, with the image that it names, or in an image alone.

    A pixel of value v in 0..255 is occupied with p = (255 - v) / 255, or v / 255 if the file says
    `negate`. Its cell is occupied where p > `occupied_thresh`, free where p < `free_thresh`, by
    default .65 and .196, and unknown between and where the pixel is transparent. What the file says
    comes before the arguments; an image alone needs `resolution`, metres a pixel. `origin` is the
    place of its lower left corner.

    Raises `ImportError` without Pillow and PyYAML, which the extra `robots` brings, and
    `ValueError` for a mode other than trinary and scale, an origin that is turned, and where the
    resolution lacks. Use it with maps of `slam_toolbox` or `map_saver`, and with a drawn plan.
    """
    said: dict[str, Any] = {
        "image": path, "mode": "trinary", "resolution": resolution, "origin": origin,
        "negate": False, "occupied_thresh": 0.65, "free_thresh": 0.196,
    }  # fmt: skip
    if Path(path).suffix in (".yaml", ".yml"):
        said |= optional("yaml", "pyyaml").safe_load(Path(path).read_text("utf-8"))
    if said["mode"] not in ("trinary", "scale"):
        raise ValueError(f"mode: {said['mode']!r} of {path} is neither trinary nor scale")
    if any(said["origin"][2:]):
        raise ValueError(f"origin: {said['origin']} of {path} is turned; turn the image instead")
    if said["resolution"] is None:
        raise ValueError(f"resolution: {path} does not say the side of a pixel in metres")
    image = optional("PIL.Image", "pillow").open(Path(path).parent / said["image"])
    # From the lowest row up: an image begins at the top.
    grey, opaque = np.moveaxis(np.asarray(image.convert("LA"), float)[::-1] / 255, -1, 0)
    occupied = np.where(opaque == 1, grey if said["negate"] else 1 - grey, np.nan)
    walls, free = occupied > said["occupied_thresh"], occupied < said["free_thresh"]
    return OccupancyGrid(walls, free, resolution=said["resolution"], origin=said["origin"])


class AbstractLaser(Fitting):
    """A planar scanner: p(scan | pose, map) is the product over its beams, to a power.

    - `angles`: of the beams of a scan, (k,), counted from the scanner's own heading: `angle_min +
      angle_increment * arange(k)` of ROS's `LaserScan`.
    - `laser_max_range`: metres; a beam of this range or more met nothing, also an infinite one.
    - `laser_min_range`: metres; a beam up to it counts as one that met nothing, as in AMCL.
    - `max_beams`: how many are used, evenly spaced.
    - `exponent`: the power. Below 1 it allows for beams that share the map's errors.
    - `mount`: pose of the scanner in the robot's frame.
    - `z_hit`, `z_rand`: weights of a beam that ends where the map says, and of any range at all;
      all weights are divided by their sum.
    - `sigma_hit`: the deviation of the first in metres.

    A scan is (k,), in metres; beams that are NaN are left out.
    """

    angles: Annotated[Float[Array, " k"], FINITE] = eqx.field(converter=to_array("angles"))
    laser_max_range: Positive = eqx.field(static=True, kw_only=True)
    laser_min_range: NotNegative = eqx.field(static=True, kw_only=True, default=0.0)
    max_beams: Count = eqx.field(static=True, kw_only=True, default=60)
    exponent: Exponent = eqx.field(static=True, kw_only=True, default=1.0)
    mount: Annotated[tuple[float, ...], FINITE] = eqx.field(
        static=True, kw_only=True, converter=to_numbers("mount"), default=(0.0, 0.0, 0.0)
    )
    z_hit: Weight = eqx.field(kw_only=True, converter=to_array("z_hit"), default=0.5)
    z_rand: Weight = eqx.field(kw_only=True, converter=to_array("z_rand"), default=0.5)
    sigma_hit: Scale = eqx.field(kw_only=True, converter=to_array("sigma_hit"), default=0.2)

    def log_likelihood(
        self, scan: Float[Array, " k"], poses: Poses, grid: OccupancyGrid
    ) -> Float[Array, " n"]:
        """log p of a scan at each pose of the robot."""
        check_shape(str(len(self.angles)), observation=scan)
        number = min(self.max_beams, len(self.angles))
        used = np.linspace(0, len(self.angles) - 1, number).round().astype(int)
        angles, scan = self.angles[used], scan[used]
        forward, left, turn = self.mount
        cos, sin = jnp.cos(poses[:, 2]), jnp.sin(poses[:, 2])
        steps = [cos * forward - sin * left, sin * forward + cos * left, jnp.full_like(cos, turn)]
        met = (scan > self.laser_min_range) & (scan < self.laser_max_range)
        ranges = jnp.where(met, scan, self.laser_max_range)
        logs = self.log_beams(ranges, poses + jnp.stack(steps, axis=1), angles, grid)
        return self.exponent * jnp.sum(jnp.where(jnp.isnan(scan)[None], 0.0, logs), axis=1)

    @abc.abstractmethod
    def log_beams(self, ranges: Angles, poses: Poses, angles: Angles, grid: OccupancyGrid) -> Beams:
        """log p of each beam from each pose of the scanner; one that met nothing has the most."""


class LikelihoodField(AbstractLaser):
    """Beams end near a wall: Thrun, Burgard and Fox (2005), table 6.3.

        p = z_hit N(d; 0, sigma_hit²) + z_rand / laser_max_range

    with d from the end of the beam to the nearest occupied cell, and
    `laser_likelihood_max_dist` where that is less, or the end is off the map. Beams that met
    nothing say nothing. AMCL has the same numbers under the same names, but leaves the factor 1 /
    (sigma_hit √(2π)) out, and adds the cubes of p in place of their logarithms.

    It is smooth, and takes a look-up a beam: use it first, and `AbstractLaser` says what its other
    parameters are. It does not know that a beam cannot pass a wall.
    """

    laser_likelihood_max_dist: Positive = eqx.field(static=True, kw_only=True, default=2.0)

    def log_beams(self, ranges: Angles, poses: Poses, angles: Angles, grid: OccupancyGrid) -> Beams:
        """By the distance of each beam's end to the nearest occupied cell."""
        gaps = grid.at(_ends(poses, angles, ranges[None]), grid.distances, jnp.inf)
        hit = jnp.exp(log_normal(jnp.minimum(gaps, self.laser_likelihood_max_dist), self.sigma_hit))
        density = self.z_hit * hit + self.z_rand / self.laser_max_range
        logs = jnp.log(density / (self.z_hit + self.z_rand))
        return jnp.where(ranges[None] < self.laser_max_range, logs, 0.0)


class BeamModel(AbstractLaser):
    """Beams end at the first wall: Thrun, Burgard and Fox (2005), table 6.1.

        p = z_hit N(z; z*, sigma_hit²) + z_short lambda_short exp(-lambda_short z) 1(z <= z*)
            + z_max 1(z = laser_max_range) + z_rand / laser_max_range 1(z < laser_max_range)

    with z* the range that the map says, and the first two normalised on [0, laser_max_range] and
    [0, z*]. `z_short` is the weight of what stands before the wall, people say, and `z_max` that of
    beams that met nothing. `AbstractLaser` says what its other parameters are.

    Use it where several places have walls at the same distances, but in other directions, or behind
    other walls, with a map that is `tabulated`: it takes no longer than `LikelihoodField` then.
    """

    z_short: Weight = eqx.field(kw_only=True, converter=to_array("z_short"), default=0.005)
    z_max: Weight = eqx.field(kw_only=True, converter=to_array("z_max"), default=0.05)
    lambda_short: Scale = eqx.field(kw_only=True, converter=to_array("lambda_short"), default=0.1)

    def log_beams(self, ranges: Angles, poses: Poses, angles: Angles, grid: OccupancyGrid) -> Beams:
        """By the range to the first occupied cell."""
        most, expected = self.laser_max_range, grid.ranges(poses, angles, self.laser_max_range)
        inside = ndtr((most - expected) / self.sigma_hit) - ndtr(-expected / self.sigma_hit)
        hit = jnp.exp(log_normal(ranges[None] - expected, self.sigma_hit)) / inside
        rate, wall = self.lambda_short, jnp.maximum(expected, grid.resolution / 2)
        short = rate * jnp.exp(-rate * ranges)[None] / -jnp.expm1(-rate * wall)
        of_map = self.z_hit * hit + self.z_short * jnp.where(ranges[None] <= expected, short, 0.0)
        density = of_map + jnp.where(ranges < most, self.z_rand / most, self.z_max)[None]
        return jnp.log(density / (self.z_hit + self.z_short + self.z_max + self.z_rand))


class OdometryMotion(Fitting):
    """Odometry as a turn, a drive and a turn: Thrun, Burgard and Fox (2005), table 5.6.

    A step (forward, left, turn) is rot1, trans and rot2, to which normal noise is added with

        var rot1  = alpha1 rot1² + alpha2 trans²
        var trans = alpha3 trans² + alpha4 (rot1² + rot2²)
        var rot2  = alpha1 rot2² + alpha2 trans²

    As in AMCL, a drive backwards has a negative trans and no turn of π, and a step below 1 cm has
    no direction: its noise is that of a turn alone. Each deviation is at least 10⁻⁴ (m, rad).
    """

    alpha1: Weight = eqx.field(kw_only=True, converter=to_array("alpha1"), default=0.2)
    alpha2: Weight = eqx.field(kw_only=True, converter=to_array("alpha2"), default=0.2)
    alpha3: Weight = eqx.field(kw_only=True, converter=to_array("alpha3"), default=0.2)
    alpha4: Weight = eqx.field(kw_only=True, converter=to_array("alpha4"), default=0.2)

    noise_dimension = 3

    def from_noise(
        self, noise: Float[Array, "n 3"], poses: Poses, odometry: Float[Array, "3"]
    ) -> Poses:
        """Poses after the step, made of standard normal noise."""
        forward, left, turn = odometry
        way = jnp.where(forward < 0, -1, 1).astype(forward.dtype)
        trans, rot1 = way * jnp.hypot(forward, left), jnp.arctan2(way * left, way * forward)
        rot2 = _wrapped(turn - rot1)
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
        return jnp.stack([x, y, _wrapped(heading + first + second)], axis=1)


class RobotModel(AbstractStateSpaceModel, Fitting):
    """A robot that is lost in a map: states are poses (x, y, heading), in metres and radians.

    - `grid`: the map, see `read_map`.
    - `motion`: `OdometryMotion`, or another with `noise_dimension` and `from_noise(noise, poses,
      odometry)`.
    - `sensor`: `LikelihoodField`, `BeamModel`, or another with `log_likelihood(scan, poses, grid)`.
    - `clearance`: x_0 is farther than this from all occupied cells, metres; the robot's radius.
    - `initial_pose`, `initial_deviations`: x_0 is normal about this pose, with these deviations of
      x, y and heading. None: it is uniform on the free cells and on all headings.

    Inputs are odometry, one step (forward, left, turn) in the robot's frame at a time, see
    `odometry_steps`, and observations are scans (k,), of which some beams may be missing. A pose in
    an unknown cell has a log-likelihood of -1000. `starts` are the corners of the cells of x_0.
    Raises `ValueError` where no cell is free.
    """

    grid: OccupancyGrid
    motion: Any
    sensor: Any
    starts: Float[Array, "cells 2"]
    clearance: NotNegative = eqx.field(static=True)
    initial_pose: Annotated[Float[Array, "3"], FINITE] | None
    initial_deviations: Annotated[Float[Array, "3"], POSITIVE]
    inputs: Any

    handles_missing = True
    periods = np.array([0.0, 0.0, 2 * np.pi])

    def __init__(
        self, grid: OccupancyGrid, motion: Any, sensor: Any, *, clearance: float = 0.0,
        initial_pose: Any = None, initial_deviations: Any = (0.5, 0.5, np.pi / 12),
        inputs: Any = None,
    ) -> None:  # fmt: skip
        self.grid, self.motion, self.sensor, self.clearance = grid, motion, sensor, clearance
        self.initial_pose = to_array("initial_pose")(initial_pose)
        self.initial_deviations = to_array("initial_deviations")(initial_deviations)
        is_start = np.asarray(grid.free & (grid.distances > clearance))
        corners = np.argwhere(is_start)[:, ::-1] * grid.resolution + grid.origin
        self.starts = jnp.asarray(corners, float)
        if not len(self.starts):
            raise ValueError(f"clearance: no free cell is {clearance} m from all occupied ones")
        self.inputs = inputs

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
        """log p(x_0), by square metre and radian."""
        if self.initial_pose is not None:
            x, y, turn = (states - self.initial_pose[None]).T
            steps = jnp.stack([x, y, _wrapped(turn)], axis=1)
            return jnp.sum(log_normal(steps, self.initial_deviations[None]), axis=1)
        is_start = self.grid.free & (self.grid.distances > self.clearance)
        density = 1 / (2 * np.pi * len(self.starts) * self.grid.resolution**2)
        return jnp.where(self.grid.at(states[:, :2], is_start, False), np.log(density), -jnp.inf)

    @property
    def noise_dimension(self) -> int:
        """That of the motion."""
        return self.motion.noise_dimension

    def transition_from_noise(self, noise: Float[Array, "n k"], states: Poses) -> Poses:
        """x_t, after the step that odometry says."""
        if self.inputs is None:
            raise ValueError("inputs: None, but a RobotModel needs odometry, a row for each step")
        return self.motion.from_noise(noise, states, self.inputs)

    def log_likelihood(self, observation: Float[Array, " k"], states: Poses) -> Float[Array, " n"]:
        """log p of a scan at each pose."""
        logs = self.sensor.log_likelihood(observation, states, self.grid)
        known = self.grid.at(states[:, :2], self.grid.free | self.grid.occupied, False)
        # Finite, so that a filter goes on whose robot drives beyond the map.
        return jnp.where(known, logs, -1000.0)


def odometry_steps(poses: Any) -> Float[np.ndarray, "t 3"]:
    """The inputs of a `RobotModel`: (forward, left, turn) from each pose (t + 1, 3) to the next.

    The poses are those of odometry, whose frame may drift. Each step is in the frame of the robot
    before it.
    """
    poses = np.asarray(poses, float)
    x, y, turn = np.diff(poses, axis=0).T
    cos, sin = np.cos(poses[:-1, 2]), np.sin(poses[:-1, 2])
    return np.stack([cos * x + sin * y, cos * y - sin * x, _wrapped(turn)], axis=1)


def _wrapped(angles: Any) -> Any:
    """In [-π, π)."""
    return (angles + np.pi) % (2 * np.pi) - np.pi
