"""Boxes and points as independent coordinates, and Gaussian moments of places and velocities.

A box has the coordinates (x, y, log w, log h) in pixels, a point (x, y) in deviations of its error.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from mpfjax.checks import Renamed
from mpfjax.vision.tracking.pairs import Pairs, intervals

# The share of a size's growth rate that is left after a frame.
_GROWTH_KEPT = 0.9
_STILL = np.zeros(2)
_FURTHER = np.log(20)  # a distance beyond which one in twenty is, as -log of its probability
# A number for each object and coordinate, or fewer that broadcast to these; of NumPy, or of JAX
# in a filter whose particles are such moments.
Numbers = Float[Any, "*#n #k"]


class Gaussian(NamedTuple):
    """Moments of place and velocity along each of the coordinates, which are independent.

    - `place`, `velocity`: the means, and their change in a frame.
    - `var_place`, `cov`, `var_velocity`: the entries of the covariance of place and velocity.
    """

    place: Float[np.ndarray, "*n k"]
    velocity: Float[np.ndarray, "*n k"]
    var_place: Float[np.ndarray, "*n k"]
    cov: Float[np.ndarray, "*n k"]
    var_velocity: Float[np.ndarray, "*n k"]

    @classmethod
    def none(cls, *shape: int) -> "Gaussian":
        """Of no object: rows of this shape, of which the last are the coordinates."""
        return cls(*(np.zeros((0, *shape)) for _ in cls._fields))

    @classmethod
    def initial(cls, place: Numbers, error: Numbers, speed: Numbers) -> "Gaussian":
        """At a first detection: the deviation of its error, and that of a velocity of mean zero."""
        still = 0.0 * error * speed
        return cls(place + still, still, error**2 + still, still, speed**2 + still)

    @property
    def unit(self) -> Float[np.ndarray, "*n k"]:
        """The units of length along each coordinate, by the mean box."""
        return units(self.place)

    def predict(
        self, place_noise: Numbers, velocity_noise: Numbers, unit: Numbers, frames: float
    ) -> "Gaussian":
        """The moments so many frames later; growth rates of sizes decay, in the mean.

        In a frame x += v + noise and v += noise, with deviations in units of length.
        """
        left, sizes = _GROWTH_KEPT**frames, self.place.shape[-1] - 2
        decay = np.array([1, 1, *[left] * sizes])
        reach = np.array([frames, frames, *[(1 - left) / (1 - _GROWTH_KEPT)] * sizes])
        return Gaussian(
            self.place + reach * self.velocity,
            decay * self.velocity,
            self.var_place
            + frames * (2 * self.cov + frames * self.var_velocity + (unit * place_noise) ** 2),
            self.cov + frames * self.var_velocity,
            self.var_velocity + frames * (unit * velocity_noise) ** 2,
        )

    def update(self, detected: Numbers, errors: Numbers) -> tuple["Gaussian", Numbers, Numbers]:
        """Kalman's update by a detection: the posterior, the innovations and their variances."""
        variance = self.var_place + errors**2
        gap = detected - self.place
        gain, gain_velocity = self.var_place / variance, self.cov / variance
        posterior = Gaussian(
            self.place + gain * gap,
            self.velocity + gain_velocity * gap,
            self.var_place * (1 - gain),
            self.cov * (1 - gain),
            (self.var_velocity - gain_velocity * self.cov).clip(0.0),
        )
        return posterior, gap, variance

    def mix(self, other: "Gaussian", share: Float[Any, "*n #4"]) -> "Gaussian":
        """The moments of a mixture of this Gaussian, with weight `share`, and the other."""
        away, away_velocity = self.place - other.place, self.velocity - other.velocity
        means = (share * a + (1 - share) * b for a, b in zip(self, other, strict=True))
        mixed, between = Gaussian(*means), share * (1 - share)
        return mixed._replace(
            var_place=mixed.var_place + between * away**2,
            cov=mixed.cov + between * away * away_velocity,
            var_velocity=mixed.var_velocity + between * away_velocity**2,
        )

    def shift(
        self, shift: Float[np.ndarray, "2"], faster: Float[np.ndarray, "2"] = _STILL
    ) -> "Gaussian":
        """The moments of what has been moved by (x, y), and is so much `faster`."""
        velocity = self.velocity + along(self.place, faster)
        return self._replace(place=self.place + along(self.place, shift), velocity=velocity)

    def accelerate(self, deviations: Numbers, frames: float) -> "Gaussian":
        """The moments where velocities had so much more noise, so many frames ago."""
        more = deviations**2
        return self._replace(
            var_place=self.var_place + frames**2 * more,
            cov=self.cov + frames * more,
            var_velocity=self.var_velocity + more,
        )

    def at(self, rows: np.ndarray) -> "Gaussian":
        """The moments of some rows."""
        if rows.dtype == bool and rows.all():
            return self  # nobody writes into moments but those who made them
        return Gaussian(*(moment[rows] for moment in self))

    def put(self, rows: np.ndarray, other: "Gaussian") -> None:
        """Write those of others into some rows, in place."""
        for moment, its in zip(self, other, strict=True):
            moment[rows] = its

    def append(self, other: "Gaussian") -> "Gaussian":
        """The rows of both, one after the other."""
        if not len(other.place):
            return self
        return Gaussian(*map(np.concatenate, zip(self, other, strict=True)))


class CameraMotion(NamedTuple):
    """The motion of the static background in the image since the previous frame: a similarity.

    A point (x, y) is now at (a x - b y, b x + a y) + shift, in pixels.

    - `turn`: (a, b), the cosine and sine of the angle, times the scale; `shift`: in pixels.
    """

    turn: Float[np.ndarray, "2"]
    shift: Float[np.ndarray, "2"]

    moved = Renamed("moved", "move")
    carried = Renamed("carried", "carry")

    def move(self, points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """The new positions of static points."""
        a, b = self.turn
        return points @ np.array([[a, b], [-b, a]]) + self.shift

    def carry(self, moments: Gaussian) -> Gaussian:
        """The moments of what moves with the image.

        Means of positions and velocities are rotated, sizes grow by the scale. Covariances along x
        and y are those of the rotated ones without the coupling of the two.
        """
        a, b = np.asarray(self.turn, float).tolist()
        growth = 0.5 * np.log(a**2 + b**2)

        def rotate(rows: np.ndarray, a: float, b: float, c: float) -> np.ndarray:
            x, y = rows[..., :1], rows[..., 1:2]
            return np.concatenate([a * x + b * y, c * x + a * y, rows[..., 2:]], axis=-1)

        place, velocity, *spread = moments
        place = rotate(place, a, -b, b) + along(place, self.shift, growth)
        spread = (rotate(rows, a**2, b**2, b**2) for rows in spread)
        return Gaussian(place, rotate(velocity, a, -b, b), *spread)


def along(places: np.ndarray, of_place: np.ndarray, of_size: float = 0.0) -> np.ndarray:
    """A value for each coordinate of places: for (x, y), and for sizes where there are any."""
    return np.append(of_place, [of_size] * (places.shape[-1] - 2))


def boxes_of(places: Float[np.ndarray, "*m k"]) -> Float[np.ndarray, "*m k"]:
    """Centre and size in pixels, of places (x, y, log w, log h); points as they are."""
    return np.concatenate([places[..., :2], np.exp(places[..., 2:])], axis=-1)


def places_of(boxes: Float[np.ndarray, "*m k"]) -> Float[np.ndarray, "*m k"]:
    """(x, y, log w, log h) of boxes by centre and size; points as they are."""
    return np.concatenate([boxes[..., :2], np.log(boxes[..., 2:])], axis=-1)


def units(places: Float[np.ndarray, "*m k"]) -> Float[np.ndarray, "*m k"]:
    """The units of length along each coordinate: (w, h, 1, 1) of boxes, and 1 of points."""
    lengths = np.ones_like(places)
    np.exp(places[..., 2:], out=lengths[..., : places.shape[-1] - 2])
    return lengths


def overlapping(
    a: Float[np.ndarray, "m k"], b: Float[np.ndarray, "d k"], least: float, variance: float = 2.0
) -> Pairs:
    """The pairs of boxes, or of points, that share more than `least`, and what they share."""
    if a.shape[-1] == 2:
        shares = shared(a[:, None], b[None], variance)
        return Pairs.of(shares, shares > least)
    # Most boxes are far apart along x: pairs from each left edge less the widest box on.
    left, low = b[:, 0] - b[:, 2] / 2, a[:, 0] - a[:, 2] / 2
    widest = np.max(b[:, 2], initial=0.0)
    rows, columns = intervals(low - widest, a[:, 0] + a[:, 2] / 2, left)
    near = 2 * np.abs(a[rows, 1] - b[columns, 1]) < a[rows, 3] + b[columns, 3]
    rows, columns = rows[near], columns[near]
    pairs = Pairs(rows, columns, shared(a[rows], b[columns]), (len(a), len(b)))
    return pairs.at(pairs.values > least)


def shared(a: Numbers, b: Numbers, variance: float = 2.0) -> np.ndarray:
    """Intersection over union of boxes by centre and size, pair by pair.

    Of points it is told by their distance alone, whose variance along x and y is that of two errors
    unless given: 1 where they are equal, and 1/2 where one in twenty pairs of the same point is
    further apart.
    """
    if a.shape[-1] == 2:
        distance = (a[..., 0] - b[..., 0]) ** 2 + (a[..., 1] - b[..., 1]) ** 2
        return 0.5 ** (distance / (2 * variance * _FURTHER))
    # Coordinate by coordinate: arrays of pairs, and no larger ones.
    x, y = (
        np.minimum(a[..., k] + a[..., k + 2] / 2, b[..., k] + b[..., k + 2] / 2)
        - np.maximum(a[..., k] - a[..., k + 2] / 2, b[..., k] - b[..., k + 2] / 2)
        for k in range(2)
    )
    common = np.maximum(x, 0.0) * np.maximum(y, 0.0)
    return common / (a[..., 2] * a[..., 3] + b[..., 2] * b[..., 3] - common)


def within(
    boxes: Float[np.ndarray, "k n"],
    extent: Float[np.ndarray, "4"],
    centred: Bool[np.ndarray, " k"] | bool = False,
) -> Bool[np.ndarray, " k"]:
    """Whether any part of each box, or its centre, is inside left, top, right and bottom."""
    half = np.zeros(2)
    if boxes.shape[1] > 2:
        half = np.where(np.reshape(centred, (-1, 1)), 0.0, boxes[:, 2:] / 2)
    low, high = boxes[:, :2] - half, boxes[:, :2] + half
    return np.all((high >= extent[:2]) & (low <= extent[2:]), axis=1)
