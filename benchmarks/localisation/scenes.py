"""Where a robot is lost: real buildings and a public map, where the data are, an office, a ring.

The data are in the folder that MPFJAX_DATA names, or in ../shared/data: laser logs of buildings in
logs/, TurtleBot3's world in maps/. The likelihoods of the buildings are those of the README there.
"""

import os
import runpy
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

import mpfjax
from mpfjax import robots

DATA = Path(os.environ.get("MPFJAX_DATA", "../shared/data"))
MAP = DATA / "maps" / "turtlebot3_world.pgm"
LOGS = {path.name.removesuffix(".log.gz"): path for path in sorted(DATA.glob("logs/*.log.gz"))}


class Stretch(NamedTuple):
    """A drive: in each of t steps odometry, where the robot then is, and what it sees there."""

    motion: Float[np.ndarray, "t 3"]  # forward, left, turn, in the robot's frame
    deviations: Float[np.ndarray, "t 2"]  # of a place and of a turn
    poses: Float[np.ndarray, "t 3"]
    seen: Float[np.ndarray, "t beams"]


# --- models -----------------------------------------------------------------------------------


class GivenDeviations(eqx.Module):
    """Odometry that comes with its deviations: u_t is (forward, left, turn), (place, turn)."""

    noise_dimension = 3

    def from_noise(
        self, noise: Float[Array, "n 3"], poses: Float[Array, "n 3"], odometry: Any
    ) -> Float[Array, "n 3"]:
        """x_t: the motion with noise, in the robot's frame."""
        motion, (place, turn) = odometry
        steps = motion[None] + jnp.stack([place, place, turn])[None] * noise
        forward, left, turned = steps.T
        cos, sin = jnp.cos(poses[:, 2]), jnp.sin(poses[:, 2])
        moved = jnp.stack([cos * forward - sin * left, sin * forward + cos * left, turned], axis=1)
        return poses + moved


class Ring(mpfjax.AbstractStateSpaceModel):
    """A corridor that runs round a building, 60 m with a door every 2.5, that look alike.

    Either way may be forward, so that there are 48 hypotheses until a door with a niche behind it
    comes by. What is seen is how much farther the wall is than where there is no door, with a
    deviation of .1 m, or, one in ten times, anything. x is along the corridor, y nothing, and the
    heading 0 or pi.
    """

    motion: GivenDeviations = GivenDeviations()
    inputs: Any = None

    noise_dimension, initial_noise_dimension = 3, 2
    periods = np.array([0.0, 0.0, 2 * np.pi])

    def sample_initial(self, key: Key[Array, ""], num_particles: int) -> Float[Array, "n 3"]:
        """x_0."""
        return self.initial_from_noise(jax.random.normal(key, (num_particles, 2)))

    def initial_from_noise(self, noise: Float[Array, "n 2"]) -> Float[Array, "n 3"]:
        """x_0 of normal numbers."""
        place, way = jax.scipy.special.ndtr(noise).T
        return jnp.stack([60 * place, 0 * place, jnp.where(way < 0.5, 0.0, jnp.pi)], axis=1)

    def transition_from_noise(
        self, noise: Float[Array, "n 3"], states: Float[Array, "n 3"]
    ) -> Float[Array, "n 3"]:
        """x_t."""
        return self.motion.from_noise(noise, states, self.inputs)

    def ranges(self, states: Float[Array, "n 3"]) -> Float[Array, "n 1"]:
        """The doors, and a niche of twice their depth 1 m behind the one at 0."""
        place = (states[:, 0] + 30) % 60 - 30
        gaps = place - 2.5 * jnp.round(place / 2.5)
        niche = jnp.exp(-0.5 * ((place - 1.0) / 0.4) ** 2)
        return (0.5 * jnp.exp(-0.5 * (gaps / 0.3) ** 2) + niche)[:, None]

    def log_likelihood(
        self, observation: Float[Array, "1"], states: Float[Array, "n 3"]
    ) -> Float[Array, " n"]:
        """Of the range to the wall."""
        gaps = observation - self.ranges(states)[:, 0]
        return jnp.log(0.9 * jax.scipy.stats.norm.pdf(gaps, 0.0, 0.1) + 0.1)


# --- scenes, with four drives of so many steps, or of as many as the scene has ------------------


class Scene(NamedTuple):
    """A model, how near to the true pose a robot is right, in metres, and drives."""

    model: Any
    near: float
    drives: list[Stretch]

    @property
    def carried(self) -> int:
        """The scans of a drive, after which the robot is carried away."""
        return len(self.drives[0].poses)


class Errors(NamedTuple):
    """Of what is simulated, in metres and radians."""

    place: float = 0.02  # deviations of a step
    turn: float = 0.03
    range: float = 0.2
    most: float = 6.0  # of any range, which one in ten beams has


def simulated(
    model: Any,
    ranges: Callable[[Array], Array],
    errors: Errors,
    seed: int,
    path: Callable[[np.random.Generator], np.ndarray],
) -> Scene:
    """Noisy odometry and scans along four paths, each from the pose of x_0 on."""
    found = []
    for rng in [np.random.default_rng([seed, number]) for number in range(4)]:
        poses = path(rng)
        motion = robots.odometry_steps(poses)
        deviations = np.tile([errors.place, errors.turn], (len(motion), 1))
        motion += deviations[:, [0, 0, 1]] * rng.normal(size=motion.shape)
        true = np.asarray(ranges(jnp.asarray(poses[1:], jnp.float32)))
        seen = true + errors.range * rng.normal(size=true.shape)
        anything = rng.uniform(0, errors.most, true.shape)
        seen = np.where(rng.random(true.shape) < 0.1, anything, seen)
        found.append(Stretch(motion, deviations, poses[1:], seen))
    return Scene(model, 0.6, found)


def building(name: str, seed: int, steps: int | None) -> Scene:
    """A real building, its map from its log, and stretches of 40 real scans."""
    made = runpy.run_path(str(DATA / "logs" / "building.py"))["Building"](LOGS[name])
    beams = np.linspace(0, len(made.angles) - 1, 24).round().astype(int)
    sensor = robots.LikelihoodField(
        made.angles[beams], laser_max_range=8.0, z_hit=0.9, z_rand=0.1, sigma_hit=0.15,
        laser_likelihood_max_dist=1.0, exponent=0.5,
    )  # fmt: skip
    grid = robots.OccupancyGrid(made.occ, made.known & ~made.occ, resolution=0.1)
    model = robots.RobotModel(grid, GivenDeviations(), sensor, clearance=0.25)
    rng, length = np.random.default_rng(seed), steps or 40
    starts = np.linspace(0, len(made.poses) - length - 2, 4).astype(int)
    return Scene(model, 1.0, [Stretch(*made.series(start, length, rng)) for start in starts])


def drawn(
    grid: robots.OccupancyGrid,
    errors: Errors,
    seed: int,
    path: Callable[[robots.RobotModel, np.random.Generator], np.ndarray],
) -> Scene:
    """A map with eight beams all around; x_0 may be where no wall is within .12 m."""
    grid = grid.tabulated(90)
    sensor = robots.BeamModel(
        2 * np.pi * np.arange(8) / 8, laser_max_range=errors.most, sigma_hit=errors.range,
        z_hit=0.9, z_rand=0.1, z_short=0.0,
    )  # fmt: skip
    model = robots.RobotModel(grid, GivenDeviations(), sensor, clearance=0.12)

    def ranges(poses: Array) -> Array:
        return grid.ranges(poses, sensor.angles, errors.most)

    scene = simulated(model, ranges, errors, seed, partial(path, model))
    # An error of a short range may have another sign, and none is below zero.
    return scene._replace(drives=[each._replace(seen=abs(each.seen)) for each in scene.drives])


def amcl(seed: int, steps: int | None, boxes: int = 0) -> Scene:
    """TurtleBot3's world with AMCL's sensor: 60 beams all around, its weights and deviation.

    So many boxes of 30 cm, which are not on the map, stand in the robot's way.
    """
    grid, errors = turtlebot_map(), Errors(range=0.02, most=3.5)
    sensor = robots.LikelihoodField(2 * np.pi * np.arange(60) / 60, laser_max_range=errors.most)
    model = robots.RobotModel(grid, GivenDeviations(), sensor, clearance=0.12)
    walls, rng = np.array(grid.occupied), np.random.default_rng([seed, 2])
    for row, column in rng.permutation(np.argwhere(grid.free))[:boxes]:
        walls[row : row + 6, column : column + 6] = True
    actual = robots.OccupancyGrid(walls, np.array(grid.free), resolution=grid.resolution)
    world = robots.RobotModel(actual, GivenDeviations(), sensor, clearance=0.12)

    def ranges(poses: Array) -> Array:
        return actual.ranges(poses, sensor.angles, errors.most)

    return simulated(model, ranges, errors, seed, lambda rng: wander(world, steps or 20, rng))


def turtlebot_map() -> robots.OccupancyGrid:
    """The part of the map that is known."""
    grid = robots.read_map(MAP, resolution=0.05)
    rows, columns = np.nonzero(grid.free | grid.occupied)
    part = np.s_[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
    return robots.OccupancyGrid(grid.occupied[part], grid.free[part], resolution=0.05)


def turtlebot(seed: int, steps: int | None) -> Scene:
    """TurtleBot3's world, nearly six-fold symmetric, and random drives of 50 steps."""
    errors = Errors(range=0.1, most=3.5)
    return drawn(turtlebot_map(), errors, seed, lambda model, rng: wander(model, steps or 50, rng))


def wander(model: robots.RobotModel, steps: int, rng: np.random.Generator) -> np.ndarray:
    """A random drive of .2 m a step that turns before walls."""
    cell, starts = model.grid.resolution, np.asarray(model.starts)
    free = {(int(x), int(y)) for x, y in np.round(starts / cell)}

    def ahead(pose: np.ndarray, way: float) -> np.ndarray:
        return pose + way * np.array([np.cos(pose[2]), np.sin(pose[2]), 0])

    def is_free(pose: np.ndarray) -> bool:
        return (int(pose[0] / cell), int(pose[1] / cell)) in free

    pose = np.array([*(rng.choice(starts) + cell / 2), rng.uniform(-np.pi, np.pi)])
    poses = [pose]
    for _ in range(steps):
        for spread in [0.15] * 3 + [2.0] * 60:
            turned = pose + np.array([0, 0, spread * rng.normal()])
            if is_free(ahead(turned, 0.3)):
                break
        pose = ahead(turned, 0.2) if is_free(ahead(turned, 0.2)) else turned
        poses.append(pose)
    return np.array(poses)


class Rooms(NamedTuple):
    """Equal rooms side by side, and the robot's way through one of them."""

    size: tuple[int, int]  # of a room in cells of .1 m: width, height
    walls: tuple[tuple[int, int, int, int], ...]  # first and last row, first and last column
    across: int
    up: int
    home: tuple[int, int]  # where the robot is: column, row
    corners: tuple[tuple[float, float], ...]  # of its way, in metres
    pillar: tuple[int, int, int, int] | None = None  # in the robot's room alone

    def wall(self) -> np.ndarray:
        """The map."""
        room = np.zeros(self.size[::-1], bool)
        room[[0, -1]] = room[:, [0, -1]] = True
        for top, bottom, left, right in self.walls:
            room[top:bottom, left:right] = True
        wall = np.tile(room, (self.up, self.across))
        if self.pillar is not None:
            top, bottom, left, right = self.pillar
            down, along = self.home[1] * self.size[1], self.home[0] * self.size[0]
            wall[down + top : down + bottom, along + left : along + right] = True
        return wall

    def way(self, steps: int | None) -> np.ndarray:
        """The poses, .2 m apart; the last `steps` of them."""
        corners = np.array(self.corners) + 0.1 * np.array(self.size) * self.home
        lengths = np.concatenate([[0], np.cumsum(np.hypot(*np.diff(corners, axis=0).T))])
        along = np.arange(0, lengths[-1], 0.2)
        places = np.stack([np.interp(along, lengths, each) for each in corners.T], axis=1)
        headings = np.unwrap(np.arctan2(*np.diff(places, axis=0).T[::-1]))
        return np.column_stack([places[:-1], headings])[-(steps or len(along)) - 1 :]

    def masses(self, states: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Of each room, (..., rooms)."""
        place = (np.asarray(states)[..., :2] / (0.1 * np.array(self.size))).astype(int)
        place = place.clip(0, [self.across - 1, self.up - 1])
        room = place[..., 0] + self.across * place[..., 1]
        is_in = room[..., None] == np.arange(self.across * self.up)
        return np.sum(np.asarray(weights)[..., None] * is_in, axis=-2)


ROOMS = {
    "office": Rooms(
        (80, 60), ((0, 38, 55, 57), (54, 59, 18, 20), (20, 28, 12, 22), (48, 59, 34, 38)), 3, 3,
        (1, 1), ((1.0, 1.0), (4.5, 1.0), (4.5, 3.4), (1.2, 3.6), (1.2, 4.9), (2.8, 4.9), (4.6, 4.2),
                 (6.3, 4.9), (7.2, 4.4), (7.3, 2.6), (6.2, 2.6), (6.15, 0.7)), (10, 15, 66, 71),
    ),
    "twelve": Rooms(
        (50, 70), ((25, 27, 0, 22), (48, 70, 30, 32), (50, 56, 8, 16), (6, 12, 36, 42)), 4, 3,
        (2, 1), ((1.0, 1.0), (3.0, 1.4), (3.1, 3.4), (1.6, 3.6), (0.4, 4.6), (0.5, 6.2), (2.2, 6.3),
                 (2.4, 4.2), (4.0, 3.6), (4.1, 2.0)),
    ),
    "ten": Rooms(
        (60, 60), ((0, 24, 30, 32), (36, 38, 18, 60), (46, 52, 26, 34), (10, 14, 8, 12)), 5, 2,
        (3, 0), ((0.8, 0.6), (2.2, 0.9), (2.4, 2.6), (1.0, 3.0), (1.0, 4.8), (2.0, 5.3), (4.6, 5.4),
                 (5.2, 4.6), (4.4, 4.2), (1.4, 4.4), (1.4, 3.0), (4.6, 2.6), (4.8, 1.8)),
        (4, 9, 50, 55),
    ),
}  # fmt: skip


def rooms(name: str, seed: int, steps: int | None) -> Scene:
    """Rooms that are equal, but for a pillar that is seen at the end."""
    grid = robots.OccupancyGrid(ROOMS[name].wall(), resolution=0.1)
    way = ROOMS[name].way(steps)
    return drawn(grid, Errors(), seed, lambda model, rng: way)


def ring(seed: int, steps: int | None) -> Scene:
    """A ring of doors: 48 hypotheses until the end of 40 steps."""
    along = 62.5 + 0.25 * np.arange(-(steps or 40), 1)
    path = np.stack([along, 0 * along, 0 * along], axis=1)
    model, errors = Ring(), Errors(place=0.05, turn=0.0, range=0.1, most=1.0)
    return simulated(model, model.ranges, errors, seed, lambda rng: path)


def with_people(scene: Scene, share: float, seed: int) -> Scene:
    """The scene with people who cover this share of the beams, side by side, in each scan.

    They are between the scanner and the wall, at another place in each scan.
    """

    def covered(drive: Stretch, number: int) -> Stretch:
        rng, (length, beams) = np.random.default_rng([seed, number, 1]), drive.seen.shape
        first = rng.integers(beams, size=(length, 1))
        is_person = (np.arange(beams) - first) % beams < round(share * beams)
        nearer = drive.seen * rng.uniform(0.1, 0.9, (length, 1))
        return drive._replace(seen=np.where(is_person, nearer, drive.seen))

    return scene._replace(drives=[covered(each, k) for k, each in enumerate(scene.drives)])


# By name: those whose data are there, and those that always are.
SCENES: dict[str, Callable[[int, int | None], Scene]]
SCENES = {name: partial(building, name) for name in LOGS}
if MAP.is_file():
    SCENES |= {"turtlebot": turtlebot, "amcl": amcl, "boxes": partial(amcl, boxes=8)}
SCENES |= {name: partial(rooms, name) for name in ROOMS} | {"ring": ring}
