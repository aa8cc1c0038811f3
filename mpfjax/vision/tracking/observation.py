"""The observation of a tracker in a frame, and how boxes overlap."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mpfjax.vision.colour.histograms import normalise
from mpfjax.vision.colour.sampled_histograms import SampledBoxes
from mpfjax.vision.tracking.detections import Detections
from mpfjax.vision.tracking.model import Pixels


class TrackedFrame(NamedTuple):
    """One frame: its detections, and its pixels, None where they are not used."""

    detections: Detections
    pixels: Pixels | None = None

    def detected_colours(self, num_parts: int) -> Float[Array, "d parts channels bins"]:
        """The histograms of each detection's bands; all zero where a band holds no pixel."""
        if isinstance(self.pixels, SampledBoxes):
            return normalise(self.pixels.counts(num_parts))
        assert self.pixels is not None
        return normalise(self.pixels.counts(self.detections.boxes, num_parts))

    def extent(self, known: Float[Array, "4"]) -> Float[Array, "4"]:
        """Left, top, right, bottom of the frame; without pixels, of `known` and the detections."""
        if self.pixels is not None:
            size = [0, 0, self.pixels.width, self.pixels.height]
            return jnp.stack([jnp.asarray(side, known.dtype) for side in size])
        valid, boxes = self.detections.valid[:, None], self.detections.boxes
        low, high = boxes[:, :2] - boxes[:, 2:] / 2, boxes[:, :2] + boxes[:, 2:] / 2
        lowest = jnp.min(jnp.where(valid, low, jnp.inf), axis=0, initial=jnp.inf)
        highest = jnp.max(jnp.where(valid, high, -jnp.inf), axis=0, initial=-jnp.inf)
        return jnp.concatenate(
            [jnp.minimum(known[:2], lowest), jnp.maximum(known[2:], highest)]
        ).astype(known.dtype)


def within(boxes: Float[Array, "k 4"], extent: Float[Array, "4"]) -> Bool[Array, " k"]:
    """Whether the centre of each box lies inside left, top, right and bottom."""
    centres = boxes[:, :2]
    return jnp.all((centres >= extent[None, :2]) & (centres <= extent[None, 2:]), axis=1)


def overlap(a: Float[Array, "m 4"], b: Float[Array, "d 4"]) -> Float[Array, "m d"]:
    """Intersection over union of every box with every other, 0 where one has no area."""
    common = _common(a, b)
    union = jnp.prod(a[:, 2:], axis=1)[:, None] + jnp.prod(b[:, 2:], axis=1)[None] - common
    return jnp.where(union > 0, common / jnp.where(union > 0, union, 1.0), 0.0)


def covered(a: Float[Array, "m 4"], b: Float[Array, "d 4"]) -> Float[Array, "m d"]:
    """The share of each box of `a` that every box of `b` covers, 0 where the first has no area."""
    area = jnp.prod(a[:, 2:], axis=1)[:, None]
    return jnp.where(area > 0, _common(a, b) / jnp.where(area > 0, area, 1.0), 0.0)


def _common(a: Float[Array, "m 4"], b: Float[Array, "d 4"]) -> Float[Array, "m d"]:
    low = jnp.maximum(a[:, None, :2] - a[:, None, 2:] / 2, b[None, :, :2] - b[None, :, 2:] / 2)
    high = jnp.minimum(a[:, None, :2] + a[:, None, 2:] / 2, b[None, :, :2] + b[None, :, 2:] / 2)
    return jnp.prod(jnp.maximum(high - low, 0.0), axis=2)
