"""Scenes of objects that come and go: how they move, what sensors report, and where they appear."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key
from numpy.random import Generator

import mpfjax

PLACE, SURVIVAL = [0, 2], 0.99  # a state is x, vx, y, vy, and the rate of turn where there is one
STEP = np.kron(np.eye(2), [[1.0, 1.0], [0.0, 1.0]])
JOLTS = np.kron(np.eye(2), [[0.5], [1.0]])  # of 1 m/s², even over a second


@dataclass(frozen=True)
class Sensor:
    """Measures x and y, or range and bearing where it has an origin; clutter is even in a box."""

    deviations: tuple[float, float]
    low: tuple[float, float]
    high: tuple[float, float]
    clutter: float  # false plots to expect
    p_d: float
    origin: tuple[float, float] | None = None
    reach: float = np.inf  # p_D falls by the density of a Gaussian of this deviation
    has_border: bool = False  # p_D is 0 outside of the box

    def seen(self, states: Any, xp: Any = np) -> Any:
        """Measurements without noise, (2, n)."""
        x, y = states[:, 0], states[:, 2]
        if self.origin is None:
            return xp.stack([x, y])
        x, y = x - self.origin[0], y - self.origin[1]
        return xp.stack([xp.hypot(x, y), xp.arctan2(y, x)])

    def detection(self, states: Any, xp: Any = np) -> Any:
        """p_D(x)."""
        seen = self.seen(states, xp)
        p = self.p_d * xp.exp(-0.5 * xp.square(seen[0] / self.reach))
        if not self.has_border:
            return p
        low, high = (xp.asarray(end, p.dtype)[:, None] for end in (self.low, self.high))
        return xp.where(xp.all((seen >= low) & (seen <= high), axis=0), p, 0.0)

    def gaps(self, plots: Any, seen: Any, xp: Any = np) -> Any:
        """Differences, (2, ...), of bearings on the circle."""
        gaps = plots - seen
        if self.origin is None:
            return gaps
        return xp.stack([gaps[0], gaps[1] - 2 * np.pi * xp.round(gaps[1] / (2 * np.pi))])

    @property
    def density(self) -> float:
        """False plots to expect in a unit of what is measured."""
        return self.clutter / float(np.prod(np.subtract(self.high, self.low)))

    def scan(self, rng: Generator, states: np.ndarray, room: int) -> np.ndarray:
        """Plots of the objects there, and false ones, with rows of NaN up to `room`."""
        own = self.seen(states).T + self.deviations * rng.normal(size=(len(states), 2))
        own = own[rng.random(len(own)) < self.detection(states)]
        false = rng.uniform(self.low, self.high, (rng.poisson(self.clutter), 2))
        plots = rng.permutation(np.concatenate([own, false]))[:room]
        return np.pad(plots, ((0, room - len(plots)), (0, 0)), constant_values=np.nan)


@dataclass(frozen=True, eq=False)
class Scene:
    """What is drawn, and what a filter is told of it."""

    truth: Callable[[Generator], np.ndarray]  # states (t, k, d), NaN where there is none
    sensors: tuple[Sensor, ...]
    root: np.ndarray  # of the covariance of the motion's noise, (d, q)
    rate: float  # new objects in a step
    deviations: tuple[float, ...]  # of a new object's state around a spot
    spots: np.ndarray | None  # (s, d), or None where objects appear anywhere
    cutoff: float  # of OSPA
    room: int  # plots of a scan
    first: float = 0.0  # objects to expect at the start
    score: str = "ospa"  # or "gospa", of order 1
    corners: tuple = ()  # of the box where objects appear anywhere; else the first sensor's

    @property
    def region(self) -> tuple:
        """The corners of the box where objects appear anywhere."""
        return self.corners or (self.sensors[0].low, self.sensors[0].high)


def moved(states: Any, xp: Any = np) -> Any:
    """States a second later, without noise; on an arc where they have a rate of turn."""
    if states.shape[1] == 4:
        return states @ xp.asarray(STEP.T, states.dtype)
    x, vx, y, vy, turn = states.T
    safe = xp.where(xp.abs(turn) < 1e-4, 1e-4, turn)
    s, c = xp.sin(safe), xp.cos(safe)
    along, aside = s / safe, (1 - c) / safe
    rows = [x + along * vx - aside * vy, c * vx - s * vy]
    rows += [y + aside * vx + along * vy, s * vx + c * vy, turn]
    return xp.stack(rows, axis=1)


Data = tuple[np.ndarray, tuple[np.ndarray, ...]]


def drawn(scene: Scene, seed: int, steps: int) -> Data:
    """The true states, and the plots of each sensor, (t, room, 2)."""
    rng = np.random.default_rng(seed)
    truth = scene.truth(rng)[:steps]
    scans = [
        [sensor.scan(rng, states[~np.isnan(states[:, 0])], scene.room) for states in truth]
        for sensor in scene.sensors
    ]
    return truth, tuple(np.array(each) for each in scans)


# Near these spots, with the first and last step of each object.
SPOTS = np.array([[0.0, 0.0], [400.0, -600.0], [-800.0, -200.0], [-200.0, 800.0]])
LIVES = [
    (0, 100),
    (0, 100),
    (0, 70),
    *[(20, 100)] * 3,
    *[(t, 100) for t in (40, 40, 60, 60, 80, 80)],
]


def twelve(rng: Generator, known: bool, apart: float = 0.0) -> np.ndarray:
    """From the spots or anywhere, at about 10 m/s; all in the square, and `apart` of each other."""
    chosen: list[np.ndarray] = []
    while len(chosen) < len(LIVES):
        first, last = LIVES[len(chosen)]
        place = SPOTS[len(chosen) % 4] + 10 * rng.normal(size=2)
        place = place if known else rng.uniform(-800, 800, 2)
        track = np.full((100, 4), np.nan)
        state = place @ np.eye(4)[PLACE] + 10 * rng.normal(size=2) @ np.eye(4)[[1, 3]]
        for t in range(first, last):
            track[t] = state
            state = STEP @ state + 0.5 * JOLTS @ rng.normal(size=2)
        gaps = [np.linalg.norm((track - other)[:, PLACE], axis=1) for other in chosen]
        inside = np.nanmax(np.abs(track[:, PLACE])) < 1000
        if inside and all(np.nanmin(gap, initial=np.inf) >= apart for gap in gaps):
            chosen.append(track)
    return np.stack(chosen, axis=1)


# The linear scene of Xia et al. (2017): first and last step, and state before the first one.
TWELVE = (
    (0, 50, 0, 0, 0, -10), (0, 100, -200, -3, 800, -15), (0, 50, -800, 20, -200, -5),
    (19, 70, 400, -7, -600, -4), (19, 100, 400, -2.5, -600, 10), (19, 70, 400, -10, -600, 5),
    (39, 100, -200, 15, 800, -5), (39, 100, -200, 15, 800, -10), (59, 100, -800, 3, -200, 15),
    (59, 100, 0, 7.5, 0, -5), (79, 100, 0, -20, 0, -15), (79, 100, -800, 12, -200, 7),
)  # fmt: skip


def straight(rng: Generator) -> np.ndarray:
    """From near the spots, without noise on the way."""
    truth = np.full((100, len(TWELVE), 4), np.nan)
    for k, (first, last, *state) in enumerate(TWELVE):
        states = np.array([state]) + 10 * rng.normal(size=2) @ np.eye(4)[PLACE]
        for t in range(first, last):
            states = moved(states)
            truth[t, k] = states[0]
    return truth


# Ten that turn, after that of Vo, Vo and Cantoni: first and last step, state, and 2° a second over.
ARC = np.deg2rad(2.0)
TEN = (
    (0, 100, 1004, -10, 1488, -10, 1 / 8), (10, 100, -256, 20, 1011, 3, -1 / 3),
    (10, 100, -1507, 11, 257, 10, -1 / 2), (10, 66, -1500, 43, 250, 0, 0),
    (20, 80, 246, 11, 739, 5, 1 / 4), (40, 100, -243, -12, 993, -12, 1 / 2),
    (40, 100, 1000, 0, 1500, -10, 1 / 4), (40, 80, 250, -50, 750, 0, -1 / 4),
    (60, 100, 1000, -50, 1500, 0, -1 / 4), (60, 100, 250, -40, 750, 25, 1 / 4),
)  # fmt: skip
CORNERS = [(-1500, 250), (-250, 1000), (250, 750), (1000, 1500)]
TURN_SPOTS = np.array([[x, 0.0, y, 0.0, 0.0] for x, y in CORNERS])
TURN_ROOT = np.zeros((5, 3))
TURN_ROOT[:4, :2], TURN_ROOT[4, 2] = 5.0 * JOLTS, np.deg2rad(1.0)


def ten(rng: Generator) -> np.ndarray:
    """Arcs, the same for each seed."""
    del rng
    truth = np.full((100, len(TEN), 5), np.nan)
    for k, (first, last, *state, share) in enumerate(TEN):
        states = np.array([[*state, share * ARC]])
        for t in range(first, last):
            truth[t, k] = states[0]
            states = moved(states)
    return truth


def pair(rng: Generator) -> np.ndarray:
    """Two that cross, or come as near as two metres and part."""
    t, crosses = np.arange(60.0), rng.random() < 0.5
    side = (30 - t) / 3 if crosses else 1 + 9 * np.abs(30 - t) / 30
    along, one = t - 30, np.ones_like(t)
    speed = np.gradient(side)
    return np.stack([np.stack([along, one, s * side, s * speed], axis=1) for s in (1, -1)], axis=1)


def convoy(rng: Generator) -> np.ndarray:
    """Five in a line, eight metres from each to the next."""
    states = np.stack([8.0 * np.arange(5) - 90, np.full(5, 2.0), *np.zeros((2, 5))], axis=1)
    truth = np.empty((60, 5, 4))
    for t in range(60):
        truth[t] = states
        states = states @ STEP.T + rng.normal(size=(5, 4)) @ SLOW_ROOT.T
    return truth


SLOW_ROOT = 0.1 * np.kron(np.eye(2), np.linalg.cholesky([[1 / 3, 1 / 2], [1 / 2, 1.0]]))


def four(rng: Generator) -> np.ndarray:
    """Four that are near each other at the middle step, where one ends (Williams 2015)."""
    middle = [150, 0, 150, 0] + np.sqrt(0.1) * rng.normal(size=(4, 4))
    truth = np.empty((81, 4, 4))
    for way, matrix in ((1, STEP), (-1, np.linalg.inv(STEP))):
        states = middle
        for t in range(41):
            truth[40 + way * t] = states
            noise = rng.normal(size=(4, 4)) @ SLOW_ROOT.T
            states = states @ matrix.T + noise if way > 0 else (states + noise) @ matrix.T
    truth[40:, 0] = np.nan
    return truth


SQUARE = ((-1000.0, -1000.0), (1000.0, 1000.0))
RADAR = Sensor((10.0, ARC), (0.0, 0.0), (2000.0, np.pi), 10.0, 0.98, (0.0, 0.0), 6000.0)


def _linear(known: bool, p_d: float, **options: Any) -> Scene:
    sensor = Sensor((10.0, 10.0), *SQUARE, 60.0, p_d)
    spots = SPOTS @ np.eye(4)[PLACE] if known else None
    truth = partial(twelve, known=known, **options)
    return Scene(truth, (sensor,), 0.5 * JOLTS, 0.12, (10.0,) * 4, spots, 100.0, 100)


def _published(p_d: float, clutter: float) -> Scene:
    sensor = Sensor((10.0, 10.0), *SQUARE, clutter, p_d)
    spots, rest = SPOTS @ np.eye(4)[PLACE], (100.0, 70)
    return Scene(straight, (sensor,), 5 * JOLTS, 0.4, (10.0,) * 4, spots, *rest, score="gospa")


def _two_radars() -> Scene:
    """The same twelve, from anywhere, with two radars beside them that each see half as well."""
    low, high = (0.0, 0.0), (3000.0, np.pi / 2)
    west = Sensor((10.0, 0.01), low, high, 30.0, 0.95, (-1000.0, -1000.0), 2000.0)
    low, high = (0.0, np.pi / 2), (3000.0, np.pi)
    east = Sensor((10.0, 0.01), low, high, 30.0, 0.95, (1000.0, -1000.0), 2000.0)
    return replace(_linear(False, 0.9), sensors=(west, east), room=70, corners=SQUARE)


def _two_fields() -> Scene:
    """The same twelve, with two sensors that see a part of the square each."""
    west, east = ((-1000.0, -600.0), (100.0, 600.0)), ((-100.0, -600.0), (1000.0, 600.0))
    fields = [Sensor((10.0, 10.0), *box, 25.0, 0.95, has_border=True) for box in (west, east)]
    return replace(_linear(False, 0.9), sensors=tuple(fields), room=60, corners=SQUARE)


SCENES = {
    "known spots": _linear(True, 0.98),
    "known spots, p_D .9": _linear(True, 0.9),
    "anywhere": _linear(False, 0.98),
    "four deviations apart": _linear(False, 0.98, apart=57.0),
    "turning": Scene(
        ten, (RADAR,), TURN_ROOT, 0.1,
        (50.0, 50.0, 50.0, 50.0, 3 * ARC), TURN_SPOTS, 100.0, 40,
    ),
    "two radars": _two_radars(),
    "two fields of view": _two_fields(),
    "convoy": Scene(
        convoy, (Sensor((1.0, 1.0), (-100.0, -50.0), (100.0, 50.0), 10.0, 0.9),),
        SLOW_ROOT, 0.02, (1.0, 1.0, 1.0, 1.0), None, 10.0, 30, 5.0,
    ),
    "crossing or parting": Scene(
        pair, (Sensor((1.0, 1.0), (-50.0, -50.0), (50.0, 50.0), 5.0, 0.95),),
        SLOW_ROOT, 0.02, (1.0, 1.0, 1.0, 1.0), None, 10.0, 20,
    ),
    "four that meet": Scene(
        four, (Sensor((1.0, 1.0), (0.0, 0.0), (300.0, 300.0), 10.0, 0.98),), SLOW_ROOT, 0.005,
        (150.0, 1.0, 150.0, 1.0), np.array([[100.0, 0.0, 100.0, 0.0]]), 10.0, 40, 3.0,
    ),
    "published, p_D .98, 10 false": _published(0.98, 10.0),
    "published, p_D .98, 30 false": _published(0.98, 30.0),
    "published, p_D .75, 30 false": _published(0.75, 30.0),
}  # fmt: skip


class Object(mpfjax.AbstractStateSpaceModel):
    """One object of a scene, in one of its sensors."""

    scene: Any
    number: int

    def sample_initial(self, key: Key[Array, ""], num_particles: int) -> Float[Array, "n d"]:
        """None: births draw them."""
        return jnp.zeros((num_particles, len(self.scene.root)))

    def sample_transition(self, key: Key[Array, ""], states: Array) -> Array:
        """A second later."""
        noise = jax.random.normal(key, (len(states), self.scene.root.shape[1]))
        return moved(states, jnp) + noise @ jnp.asarray(self.scene.root.T, noise.dtype)

    def log_likelihood(self, observation: Array, states: Array) -> Array:
        """Of one plot."""
        sensor = self.scene.sensors[self.number]
        gaps = sensor.gaps(observation[:, None], sensor.seen(states, jnp), jnp)
        scales = jnp.asarray(sensor.deviations, gaps.dtype)[:, None]
        return jnp.sum(jax.scipy.stats.norm.logpdf(gaps, scale=scales), axis=0)


class Spots(mpfjax.AbstractBirth):
    """New objects around known spots."""

    rate: Any
    scene: Any

    def sample(self, key: Key[Array, ""], num_particles: int) -> Float[Array, "n d"]:
        """One of the spots, and a normal state around it."""
        key_spot, key_state = jax.random.split(key)
        spots = jnp.asarray(self.scene.spots, jnp.float32)
        spots = jax.random.choice(key_spot, spots, (num_particles,))
        noise = jax.random.normal(key_state, spots.shape)
        return spots + jnp.asarray(self.scene.deviations, noise.dtype)[None] * noise

    def propose(self, key: Key[Array, ""], measurement: Array, num_particles: int, sensor: int = 0):
        """At a place given the plot and one of the spots, extended where it is not linear."""
        key_spot, key_place, key_rest = jax.random.split(key, 3)
        states, normal = self.sample(key_rest, num_particles), jax.scipy.stats.multivariate_normal
        place, error = _place_of(self.scene.sensors[0], measurement)
        spots = jnp.asarray(self.scene.spots[:, PLACE], place.dtype)
        prior = jnp.diag(
            jnp.square(jnp.asarray(self.scene.deviations, place.dtype)[np.array(PLACE)])
        )
        gain = prior @ jnp.linalg.inv(prior + error)
        means, spread = spots + (place[None] - spots) @ gain.T, gain @ error
        log_shares = jax.nn.log_softmax(normal.logpdf(spots, place, prior + error))
        chosen = jax.random.categorical(key_spot, log_shares, shape=(num_particles,))
        places = jax.random.multivariate_normal(key_place, means[chosen], spread)

        def log_density(means: Array, covariance: Array, log_shares: Array) -> Array:
            gaps = places[:, None] - means[None]
            each = normal.logpdf(gaps, jnp.zeros(2, gaps.dtype), covariance)
            return jax.nn.logsumexp(each + log_shares[None], axis=1)

        log_birth = log_density(spots, prior, jnp.full_like(log_shares, -np.log(len(spots))))
        log_proposal = log_density(means, spread, log_shares)
        return states.at[:, np.array(PLACE)].set(places), log_birth - log_proposal


def _place_of(sensor: Sensor, plot: Array) -> tuple[Array, Array]:
    """Where a plot is, and the covariance of its error there."""
    error = jnp.diag(jnp.square(jnp.asarray(sensor.deviations, plot.dtype)))
    if sensor.origin is None:
        return plot, error
    r, c, s = plot[0], jnp.cos(plot[1]), jnp.sin(plot[1])
    turn = jnp.stack([jnp.stack([c, -r * s]), jnp.stack([s, r * c])])
    # At least 1 m in each direction, so that it has an inverse near the origin.
    error = turn @ error @ turn.T + jnp.eye(2)
    return jnp.stack([r * c, r * s]) + jnp.float32(sensor.origin), error


def _located(sensor: Sensor, key: Key[Array, ""], plot: Array, n: int) -> tuple[Array, Array]:
    """Places that a plot may come from, and their log density."""
    noise, scales = jax.random.normal(key, (n, 2)), jnp.asarray(sensor.deviations, jnp.float32)
    seen = plot[None] + scales[None] * noise
    log_density = jnp.sum(jax.scipy.stats.norm.logpdf(noise) - jnp.log(scales)[None], axis=1)
    if sensor.origin is None:
        return seen, log_density
    r, angle = seen.T
    places = jnp.stack([r * jnp.cos(angle), r * jnp.sin(angle)], axis=1)
    return places + jnp.float32(sensor.origin)[None], log_density - jnp.log(jnp.abs(r))


def model_of(scene: Scene) -> mpfjax.TargetsModel:
    """Motion, sensors, clutter and births."""
    rate = jnp.float32(scene.rate)
    if scene.spots is None:
        speeds = scene.deviations[1]

        def newborn(key: Key[Array, ""], places: Array) -> Array:
            v = speeds * jax.random.normal(key, places.shape)
            return jnp.stack([places[:, 0], v[:, 0], places[:, 1], v[:, 1]], axis=1)

        locate = tuple(partial(_located, sensor) for sensor in scene.sensors)
        birth: Any = mpfjax.UniformBirth(rate, mpfjax.Box(*scene.region), newborn, locate)
    else:
        birth = Spots(rate, scene)
    sensors = [
        mpfjax.ClutteredModel(
            Object(scene, number), partial(_detection, sensor), sensor.density
        )
        for number, sensor in enumerate(scene.sensors)
    ]  # fmt: skip
    return mpfjax.TargetsModel(sensors, birth, SURVIVAL, scene.first)


def _detection(sensor: Sensor, states: Array) -> Array:
    return sensor.detection(states, jnp)


def told(truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions, and which are there."""
    return np.nan_to_num(truth[..., PLACE]), ~np.isnan(truth[..., 0])
