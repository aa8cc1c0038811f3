"""The observation of a tracker in a frame, and how boxes overlap."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mpfjax.vision.colour.histograms import normalise
from mpfjax.vision.colour.sampled_histograms import SampledBoxes
from mpfjax.vision.tracking.detections import Detections
from mpfjax.vision.tracking.model import Gaussian, Pixels


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
        dtype = moments.place.dtype
        a, b = jnp.where(self.known, self.turn, jnp.array([1.0, 0.0])).astype(dtype)
        shift = jnp.where(self.known, self.shift, jnp.zeros(2)).astype(dtype)
        growth = 0.5 * jnp.log(a**2 + b**2)
        added = jnp.concatenate([shift, jnp.stack([growth, growth])])
        added = added.reshape((1,) * (moments.place.ndim - 1) + (4,))

        def means(rows: Float[Array, "*n 4"]) -> Float[Array, "*n 4"]:
            x, y = rows[..., :1], rows[..., 1:2]
            return jnp.concatenate([a * x - b * y, b * x + a * y, rows[..., 2:]], axis=-1)

        def variances(rows: Float[Array, "*n 4"]) -> Float[Array, "*n 4"]:
            x, y = rows[..., :1], rows[..., 1:2]
            turned = [a**2 * x + b**2 * y, b**2 * x + a**2 * y, rows[..., 2:]]
            return jnp.concatenate(turned, axis=-1)

        place, velocity, *spread = moments
        return Gaussian(means(place) + added, means(velocity), *map(variances, spread))


class TrackedFrame(NamedTuple):
    """One frame: its detections, its pixels, and the camera's motion, None where not used."""

    detections: Detections
    pixels: Pixels | None = None
    motion: CameraMotion | None = None

    def detected_colours(self, num_parts: int) -> Float[Array, "d parts channels bins"]:
        """The histograms of each detection's bands; all zero where a band holds no pixel."""
        if isinstance(self.pixels, SampledBoxes):
            return normalise(self.pixels.counts(num_parts))
        assert self.pixels is not None
        return normalise(self.pixels.counts(self.detections.boxes, num_parts))

    @property
    def extent(self) -> Float[Array, "4"]:
        """Left, top, right, bottom of the frame; as far as can be where not known."""
        if self.pixels is None:
            return self.detections.extent
        size = [0, 0, self.pixels.width, self.pixels.height]
        return jnp.stack([jnp.asarray(side, self.detections.extent.dtype) for side in size])


def within(boxes: Float[Array, "k 4"], extent: Float[Array, "4"]) -> Bool[Array, " k"]:
    """Whether any part of each box lies inside left, top, right and bottom."""
    low, high = boxes[:, :2] - boxes[:, 2:] / 2, boxes[:, :2] + boxes[:, 2:] / 2
    return jnp.all((high > extent[None, :2]) & (low < extent[None, 2:]), axis=1)


def overlap(a: Float[Array, "m 4"], b: Float[Array, "d 4"]) -> Float[Array, "m d"]:
    """Intersection over union of every box with every other, 0 where one has no area."""
    common = _common(a, b)
    union = jnp.prod(a[:, 2:], axis=1)[:, None] + jnp.prod(b[:, 2:], axis=1)[None] - common
    return jnp.where(union > 0, common / jnp.where(union > 0, union, 1.0), 0.0)


def _common(a: Float[Array, "m 4"], b: Float[Array, "d 4"]) -> Float[Array, "m d"]:
    low = jnp.maximum(a[:, None, :2] - a[:, None, 2:] / 2, b[None, :, :2] - b[None, :, 2:] / 2)
    high = jnp.minimum(a[:, None, :2] + a[:, None, 2:] / 2, b[None, :, :2] + b[None, :, 2:] / 2)
    return jnp.prod(jnp.maximum(high - low, 0.0), axis=2)
