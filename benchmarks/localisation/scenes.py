"""Where a robot is lost: real buildings and a public map, where the data are, an office, a ring.

The data are in the folder that MPFJAX_DATA names, or in ../shared/data: laser logs of buildings in
logs/, TurtleBot3's world in maps/. The likelihoods are those of the READMEs there.
"""

import os
import re
import runpy
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key
from scipy.ndimage import distance_transform_edt

import mpfjax

DATA = Path(os.environ.get("MPFJAX_DATA", "../shared/data"))
MAP = DATA / "maps" / "turtlebot3_world.pgm"
LOGS = {path.name.removesuffix(".log.gz"): path for path in sorted(DATA.glob("logs/*.log.gz"))}
NOWHERE = -1000.0  # log L where the map knows nothing


class Stretch(NamedTuple):
    """A drive: in each of t steps odometry, where the robot then is, and what it sees there."""

    motion: Float[np.ndarray, "t 3"]  # forward, left, turn, in the robot's frame
    deviations: Float[np.ndarray, "t 2"]  # of a place and of a turn
    poses: Float[np.ndarray, "t 3"]
    seen: Float[np.ndarray, "t beams"]


# --- models -----------------------------------------------------------------------------------


class Robot(mpfjax.AbstractStateSpaceModel):
    """A robot with a map that knows neither its place nor its heading; its motion is the input.

    States are (x, y, heading), in metres and radians. x_0 is uniform on free cells and headings.
    Beams end near an obstacle (Thrun, Burgard and Fox 2005, table 6.3), and the likelihood is to
    the power of one half, since neighbouring beams are not independent.
    """

    free: Float[Array, "cells 2"]  # centres
    known: Bool[Array, "h w"]
    cell: float
    distances: Any = None  # (h, w), metres to the nearest obstacle
    angles: Any = None  # of the beams
    inputs: Any = None
    most, deviation, outliers = 8.0, 0.15, 0.1  # metres, and a share of the beams
    near = 1.0  # metres from the true pose

    def sample_initial(self, key: Key[Array, ""], num_particles: int) -> Float[Array, "n 3"]:
        """x_0."""
        keys = jax.random.split(key, 3)
        corner = self.free[jax.random.randint(keys[0], (num_particles,), 0, len(self.free))]
        places = corner + self.cell * (jax.random.uniform(keys[1], (num_particles, 2)) - 0.5)
        headings = jax.random.uniform(keys[2], (num_particles, 1), minval=-jnp.pi, maxval=jnp.pi)
        return jnp.concatenate([places, headings], axis=1)

    def log_initial(self, states: Float[Array, "n 3"]) -> Float[Array, " n"]:
        """Zero on free cells."""
        is_free = jnp.zeros(self.known.shape, bool).at[self.cells(self.free)[:2]].set(True)
        rows, columns, inside = self.cells(states[:, :2])
        return jnp.where(inside & is_free[rows, columns], 0.0, -jnp.inf)

    def sample_transition(
        self, key: Key[Array, ""], states: Float[Array, "n 3"]
    ) -> Float[Array, "n 3"]:
        """x_t: the motion with noise, in the robot's frame."""
        motion, (place, turn) = self.inputs
        noise = jnp.stack([place, place, turn])[None] * jax.random.normal(key, states.shape)
        forward, left, turned = (motion[None] + noise).T
        cos, sin = jnp.cos(states[:, 2]), jnp.sin(states[:, 2])
        moved = jnp.stack([cos * forward - sin * left, sin * forward + cos * left, turned], axis=1)
        return states + moved

    def cells(self, places: Float[Array, "*n 2"]) -> tuple[Int[Array, "*n"], Int[Array, "*n"], Any]:
        """Row and column of each place, and whether it is in the map."""
        height, width = self.known.shape
        columns, rows = jnp.moveaxis(jnp.floor(places / self.cell).astype(jnp.int32), -1, 0)
        inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
        return jnp.clip(rows, 0, height - 1), jnp.clip(columns, 0, width - 1), inside

    def log_likelihood(
        self, observation: Float[Array, " beams"], states: Float[Array, "n 3"]
    ) -> Float[Array, " n"]:
        """Of all beams, or next to nothing where the map knows nothing."""
        rows, columns, inside = self.cells(states[:, :2])
        is_known = inside & self.known[rows, columns]
        return jnp.where(is_known, self.log_of_beams(observation, states), NOWHERE)

    def log_density(self, gaps: Array) -> Array:
        """Of a beam: Gaussian, or uniform up to the longest range."""
        gaussian = jnp.exp(-0.5 * (gaps / self.deviation) ** 2)
        gaussian /= self.deviation * np.sqrt(2 * np.pi)
        return jnp.log((1 - self.outliers) * gaussian + self.outliers / self.most)

    def log_of_beams(self, observation: Array, states: Array) -> Array:
        """By the distance of each beam's end to the nearest obstacle."""
        headings = states[:, 2:] + self.angles[None]
        reach = jnp.minimum(observation, self.most)[None, :, None]
        along = jnp.stack([jnp.cos(headings), jnp.sin(headings)], axis=-1)
        rows, columns, inside = self.cells(states[:, None, :2] + reach * along)
        gaps = jnp.where(inside, self.distances[rows, columns], 1.0)
        logs = self.log_density(gaps)
        return 0.5 * jnp.sum(jnp.where((observation < self.most)[None], logs, 0.0), axis=1)


class Ranges(Robot):
    """Beams all around, each with a Gaussian error or with any range at all."""

    table: Any = None  # (h, w, angles), metres to the next wall
    most: float = 6.0
    deviation: float = 0.2
    near, num_beams = 0.6, 8
    odometry = (0.02, 0.03)  # deviations of a step in metres, and of a turn in radians

    def ranges(self, states: Float[Array, "n 3"]) -> Float[Array, "n beams"]:
        """Those of a beam without error."""
        rows, columns, _ = self.cells(states[:, None, :2])
        turns = states[:, 2:] / (2 * jnp.pi) + jnp.arange(self.num_beams)[None] / self.num_beams
        num_angles = self.table.shape[2]
        angles = jnp.round(turns * num_angles).astype(jnp.int32) % num_angles
        return self.table[rows, columns, angles]

    def log_of_beams(self, observation: Array, states: Array) -> Array:
        """By the range to the next wall."""
        gaps = observation[None] - self.ranges(states)
        return jnp.sum(self.log_density(gaps), axis=1)


class Ring(Ranges):
    """A corridor that runs round a building, 60 m with a door every 2.5, that look alike.

    Either way may be forward, so that there are 48 hypotheses until a door with a niche behind it
    comes by. What is seen is how much farther the wall is than where there is no door. x is along
    the corridor, y nothing, and the heading 0 or pi.
    """

    odometry = (0.05, 0.0)
    log_initial: Any = None  # its heading is one of two

    def sample_initial(self, key: Key[Array, ""], num_particles: int) -> Float[Array, "n 3"]:
        """x_0."""
        place, way = jax.random.uniform(key, (2, num_particles))
        return jnp.stack([60 * place, 0 * place, jnp.where(way < 0.5, 0.0, jnp.pi)], axis=1)

    initial_noise_dimension = 2

    def initial_from_noise(self, noise: Float[Array, "n 2"]) -> Float[Array, "n 3"]:
        """x_0 of normal numbers."""
        place, way = jax.scipy.special.ndtr(noise).T
        return jnp.stack([60 * place, 0 * place, jnp.where(way < 0.5, 0.0, jnp.pi)], axis=1)

    def ranges(self, states: Float[Array, "n 3"]) -> Float[Array, "n 1"]:
        """The doors, and a niche of twice their depth 1 m behind the one at 0."""
        place = (states[:, 0] + 30) % 60 - 30
        gaps = place - 2.5 * jnp.round(place / 2.5)
        niche = jnp.exp(-0.5 * ((place - 1.0) / 0.4) ** 2)
        return (0.5 * jnp.exp(-0.5 * (gaps / 0.3) ** 2) + niche)[:, None]

    def log_likelihood(
        self, observation: Float[Array, "1"], states: Float[Array, "n 3"]
    ) -> Float[Array, " n"]:
        """Of the range to the wall, everywhere."""
        return self.log_of_beams(observation, states)


# --- scenes: a model, and four drives of so many steps, or of as many as the scene has ----------

Scene = tuple[Any, list[Stretch]]


def drives(model: Any, seed: int, path: Callable[[np.random.Generator], np.ndarray]) -> Scene:
    """Noisy odometry and scans along four paths, each from the pose of x_0 on."""
    found = []
    for rng in [np.random.default_rng([seed, number]) for number in range(4)]:
        poses = path(rng)
        moved, cos, sin = np.diff(poses, axis=0), np.cos(poses[:-1, 2]), np.sin(poses[:-1, 2])
        forward, left = cos * moved[:, 0] + sin * moved[:, 1], cos * moved[:, 1] - sin * moved[:, 0]
        deviations = np.tile(model.odometry, (len(moved), 1))
        motion = np.stack([forward, left, moved[:, 2]], axis=1)
        motion += deviations[:, [0, 0, 1]] * rng.normal(size=motion.shape)
        true = np.asarray(model.ranges(jnp.asarray(poses[1:], jnp.float32)))
        seen = true + model.deviation * rng.normal(size=true.shape)
        anything = rng.uniform(0, model.most, true.shape)
        seen = np.where(rng.random(true.shape) < model.outliers, anything, seen)
        found.append(Stretch(motion, deviations, poses[1:], seen))
    return model, found


def building(name: str, seed: int, steps: int | None) -> Scene:
    """A real building, its map from its log, and stretches of 40 real scans."""
    made = runpy.run_path(str(DATA / "logs" / "building.py"))["Building"](LOGS[name])
    beams = np.linspace(0, len(made.angles) - 1, 24).round().astype(int)
    model = Robot(
        jnp.asarray(made.free, jnp.float32), jnp.asarray(made.known), 0.1,
        distances=jnp.asarray(made.field, jnp.float32),
        angles=jnp.asarray(made.angles[beams], jnp.float32),
    )  # fmt: skip
    rng, length = np.random.default_rng(seed), steps or 40
    starts = np.linspace(0, len(made.poses) - length - 2, 4).astype(int)
    return model, [Stretch(*made.series(start, length, rng)) for start in starts]


def with_table(wall: np.ndarray, known: np.ndarray, cell: float, **options: Any) -> Ranges:
    """The model of a map. It may start where no wall is within .12 m."""
    field = cell * np.asarray(distance_transform_edt(~wall))
    rows, columns = np.nonzero(known & (field > 0.12))
    free = jnp.asarray(cell * (np.stack([columns, rows], axis=1) + 0.5), jnp.float32)
    model = Ranges(free, jnp.asarray(known), cell, **options)
    angles = jnp.arange(90.0) * 2 * jnp.pi / 90
    along = jnp.stack([jnp.cos(angles), jnp.sin(angles)], axis=-1)
    places = cell * (jnp.asarray(np.stack([*np.indices(wall.shape)][::-1], -1)[:, :, None]) + 0.5)

    @jax.jit
    def table(field: Array, reach: Array) -> Array:
        def advance(_: Any, reach: Array) -> Array:
            rows, columns, _ = model.cells(places + reach[..., None] * along[None, None])
            gap = field[rows, columns]
            step = jnp.where(gap > 0, jnp.maximum(gap - cell, cell / 2), 0)
            return jnp.minimum(reach + step, model.most)

        return jax.lax.fori_loop(0, int(2 * model.most / cell), advance, reach)

    found = table(jnp.asarray(field, jnp.float32), jnp.zeros((*wall.shape, 90)))
    return Ranges(free, model.known, cell, table=found, **options)


def turtlebot(seed: int, steps: int | None) -> Scene:
    """TurtleBot3's world, nearly six-fold symmetric, and random drives of 50 steps."""
    raw = MAP.read_bytes()
    head: Any = re.match(rb"P5\s+(?:#.*\n)?(\d+)\s+(\d+)\s+\d+\s", raw)
    grey = np.frombuffer(raw[head.end() :], np.uint8).reshape(int(head[2]), int(head[1]))
    rows, columns = np.nonzero((grey < 90) | (grey > 250))
    grey = grey[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
    model = with_table(grey < 90, grey > 250, 0.05, most=3.5, deviation=0.1)
    return drives(model, seed, lambda rng: wander(model, steps or 50, rng))


def wander(model: Ranges, steps: int, rng: np.random.Generator) -> np.ndarray:
    """A random drive of .2 m a step that turns before walls."""
    free = {(int(x), int(y)) for x, y in np.asarray(model.free) / model.cell}

    def ahead(pose: np.ndarray, way: float) -> np.ndarray:
        return pose + way * np.array([np.cos(pose[2]), np.sin(pose[2]), 0])

    def is_free(pose: np.ndarray) -> bool:
        return (int(pose[0] / model.cell), int(pose[1] / model.cell)) in free

    pose = np.array([*rng.choice(np.asarray(model.free)), rng.uniform(-np.pi, np.pi)])
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
    wall = ROOMS[name].wall()
    way = ROOMS[name].way(steps)
    return drives(with_table(wall, ~wall, 0.1), seed, lambda _: way)


def ring(seed: int, steps: int | None) -> Scene:
    """A ring of doors: 48 hypotheses until the end of 40 steps."""
    model = Ring(jnp.zeros((1, 2)), jnp.zeros((1, 1), bool), 1.0, most=1.0, deviation=0.1)
    along = 62.5 + 0.25 * np.arange(-(steps or 40), 1)
    path = np.stack([along, 0 * along, 0 * along], axis=1)
    return drives(model, seed, lambda _: path)


# By name: those whose data are there, and those that always are.
SCENES: dict[str, Callable[[int, int | None], Scene]]
SCENES = {name: partial(building, name) for name in LOGS}
SCENES |= {"turtlebot": turtlebot} if MAP.is_file() else {}
SCENES |= {name: partial(rooms, name) for name in ROOMS} | {"ring": ring}
