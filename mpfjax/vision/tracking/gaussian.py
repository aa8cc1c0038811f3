"""Boxes as four independent coordinates, and Gaussian moments of their places and velocities."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

# The share of a size's growth rate that is left after a frame.
_GROWTH_KEPT = 0.9


def zeros(*shape: int, dtype: Any = np.float32) -> Any:
    """By NumPy: each operation of JAX would be a program of its own before the first frame."""
    return np.zeros(shape, dtype)


class Gaussian(NamedTuple):
    """Moments of place and velocity along each of the four coordinates, which are independent.

    - `place`, `velocity`: the means; (x, y) in pixels, (log w, log h), and their change in a frame.
    - `var_place`, `cov`, `var_velocity`: the entries of the covariance of place and velocity.
    """

    place: Float[Array, "*n 4"]
    velocity: Float[Array, "*n 4"]
    var_place: Float[Array, "*n 4"]
    cov: Float[Array, "*n 4"]
    var_velocity: Float[Array, "*n 4"]

    @classmethod
    def nowhere(cls, *shape: int) -> "Gaussian":
        """Boxes of one pixel about the origin, to fill empty rows."""
        zero = zeros(*shape, 4)
        return cls(zero, zero, zero, zero, zero)

    @classmethod
    def begun(
        cls,
        place: Float[Array, "*#n #4"],
        error: Float[Array, "*#n #4"],
        speed: Float[Array, "*#n #4"],
    ) -> "Gaussian":
        """At a first detection: the deviation of its error, and that of a velocity of mean zero."""
        still = jnp.zeros_like(error * speed)
        return cls(place + still, still, error**2 + still, still, speed**2 + still)

    @property
    def unit(self) -> Float[Array, "*n 4"]:
        """The units of length along each coordinate, by the mean box."""
        return units(self.place)

    def predicted(
        self, place_noise: Float[Array, "*#n #4"], velocity_noise: Float[Array, "*#n #4"]
    ) -> "Gaussian":
        """The moments a frame later: x += v + noise, v += noise; growth rates of sizes decay, in
        the mean.

        Deviations of the noises are in boxes.
        """
        kept = _along_last(np.array([1, 1, _GROWTH_KEPT, _GROWTH_KEPT], np.float32), self.place)
        unit = self.unit
        return Gaussian(
            self.place + self.velocity,
            kept * self.velocity,
            self.var_place + 2 * self.cov + self.var_velocity + (unit * place_noise) ** 2,
            self.cov + self.var_velocity,
            self.var_velocity + (unit * velocity_noise) ** 2,
        )

    def updated(
        self, detected: Float[Array, "*#n #4"], errors: Float[Array, "*#n #4"]
    ) -> tuple["Gaussian", Float[Array, "*n 4"], Float[Array, "*n 4"]]:
        """Kalman's update by a detection: the posterior, the innovations and their variances."""
        variance = self.var_place + errors**2
        gap = detected - self.place
        gain, gain_velocity = self.var_place / variance, self.cov / variance
        posterior = Gaussian(
            self.place + gain * gap,
            self.velocity + gain_velocity * gap,
            self.var_place * (1 - gain),
            self.cov * (1 - gain),
            jnp.maximum(self.var_velocity - gain_velocity * self.cov, 0.0),
        )
        return posterior, gap, variance

    def mixed_with(self, other: "Gaussian", share: Float[Array, "*n #4"]) -> "Gaussian":
        """The moments of a mixture of this Gaussian, with weight `share`, and the other."""
        away, away_velocity = self.place - other.place, self.velocity - other.velocity
        means = (share * a + (1 - share) * b for a, b in zip(self, other, strict=True))
        mixed, between = Gaussian(*means), share * (1 - share)
        return mixed._replace(
            var_place=mixed.var_place + between * away**2,
            cov=mixed.cov + between * away * away_velocity,
            var_velocity=mixed.var_velocity + between * away_velocity**2,
        )

    def shifted(self, shift: Float[Array, "2"]) -> "Gaussian":
        """The moments of what has been moved by (x, y)."""
        return self._replace(place=self.place + _along_last(jnp.pad(shift, (0, 2)), self.place))

    def where(self, chosen: Bool[Array, "*n"], other: "Gaussian") -> "Gaussian":
        """These moments in the chosen rows, and the other's elsewhere."""
        shape = chosen.shape + (1,) * (self.place.ndim - chosen.ndim)
        rows = chosen.reshape(shape)
        return Gaussian(*(jnp.where(rows, a, b) for a, b in zip(self, other, strict=True)))


class CameraMotion(NamedTuple):
    """Where the picture of what stands still has gone since the frame before: a similarity.

    A point (x, y) is now at (a x - b y, b x + a y) + shift, in pixels.

    - `turn`: (a, b), the cosine and sine of the angle, times the scale; `shift`: in pixels.
    - `known`: whether it was found; if not, the others mean nothing.
    """

    turn: Float[Array | np.ndarray, "2"]
    shift: Float[Array | np.ndarray, "2"]
    known: Bool[Array | np.ndarray, ""]

    @classmethod
    def unknown(cls) -> "CameraMotion":
        """No motion was found."""
        return cls(np.array([1, 0], np.float32), np.zeros(2, np.float32), np.asarray(False))

    def carried(self, moments: Gaussian) -> Gaussian:
        """The moments of what moves with the picture; as they are where the motion is unknown.

        Means of places and velocities turn, sizes grow by the scale. Covariances along x and y are
        those of the turned ones without what couples the two.
        """
        a, b = jnp.where(self.known, self.turn, np.array([1.0, 0.0], np.float32))
        growth = 0.5 * jnp.log(a**2 + b**2)
        added = jnp.where(self.known, jnp.append(self.shift, jnp.stack([growth, growth])), 0.0)

        def turned(rows: Float[Array, "*n 4"], a: Array, b: Array, c: Array) -> Array:
            x, y = rows[..., :1], rows[..., 1:2]
            return jnp.concatenate([a * x + b * y, c * x + a * y, rows[..., 2:]], axis=-1)

        place, velocity, *spread = moments
        means = turned(place, a, -b, b) + _along_last(added, place), turned(velocity, a, -b, b)
        return Gaussian(*means, *(turned(rows, a**2, b**2, b**2) for rows in spread))


def _along_last(values: Any, rows: Array) -> Any:
    """Values with as many axes as rows have."""
    return values.reshape((1,) * (rows.ndim - 1) + (-1,))


def boxes_of(places: Float[Array, "*m 4"]) -> Float[Array, "*m 4"]:
    """Centre and size in pixels, of places (x, y, log w, log h)."""
    return jnp.concatenate([places[..., :2], jnp.exp(places[..., 2:])], axis=-1)


def places_of(boxes: Float[Array, "*m 4"]) -> Float[Array, "*m 4"]:
    """(x, y, log w, log h) of boxes by centre and size."""
    return jnp.concatenate([boxes[..., :2], jnp.log(boxes[..., 2:])], axis=-1)


def units(places: Float[Array, "*m 4"]) -> Float[Array, "*m 4"]:
    """The units of length along each coordinate: (w, h, 1, 1)."""
    sizes = jnp.exp(places[..., 2:])
    return jnp.concatenate([sizes, jnp.ones_like(sizes)], axis=-1)


def overlap(a: Float[Array, "m 4"], b: Float[Array, "d 4"]) -> Float[Array, "m d"]:
    """Intersection over union of every box with every other, 0 where one has no area."""
    return shared(a[:, None], b[None])


def shared(a: Float[Array, "*#n 4"], b: Float[Array, "*#n 4"]) -> Float[Array, "*n"]:
    """Intersection over union of boxes, pair by pair, 0 where one has no area."""
    low = jnp.maximum(a[..., :2] - a[..., 2:] / 2, b[..., :2] - b[..., 2:] / 2)
    high = jnp.minimum(a[..., :2] + a[..., 2:] / 2, b[..., :2] + b[..., 2:] / 2)
    common = jnp.prod(jnp.maximum(high - low, 0.0), axis=-1)
    union = jnp.prod(a[..., 2:], axis=-1) + jnp.prod(b[..., 2:], axis=-1) - common
    return jnp.where(union > 0, common / jnp.where(union > 0, union, 1.0), 0.0)


def within(
    boxes: Float[Array, "k 4"],
    extent: Float[Array, "4"],
    centred: Bool[Array, " k"] | bool = False,
) -> Bool[Array, " k"]:
    """Whether any part of each box, or its centre, is inside left, top, right and bottom."""
    half = jnp.where(jnp.reshape(jnp.asarray(centred), (-1, 1)), 0.0, boxes[:, 2:] / 2)
    low, high = boxes[:, :2] - half, boxes[:, :2] + half
    return jnp.all((high >= extent[None, :2]) & (low <= extent[None, 2:]), axis=1)
