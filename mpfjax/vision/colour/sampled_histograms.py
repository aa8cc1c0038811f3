"""Colour histograms of boxes from a grid of points in each, at any size of frame and box."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt8

from mpfjax.operations.logarithms import default_float
from mpfjax.operations.segments import segment_counts
from mpfjax.vision.colour.bins import AbstractColours
from mpfjax.vision.files.frames import check_frame

_ROWS, _COLUMNS = 18, 8


class SampledBoxes(eqx.Module):
    """The colours of detected boxes: the pixels of a frame at a grid of points in each.

    NumPy looks them up, outside of the compiled program, whose time and shapes then do not depend
    on the frame. B² differs from that of all pixels by about 0.03.

    - `pixels`: RGB, (d, rows, columns, 3), of type uint8; `inside`: (d, rows, columns), whether the
      point is in the frame.
    - `height`, `width`: of the frame, in pixels.
    """

    pixels: UInt8[Array | np.ndarray, "d rows columns 3"]
    inside: Bool[Array | np.ndarray, "d rows columns"]
    height: Int[Array | np.ndarray, ""]
    width: Int[Array | np.ndarray, ""]
    colours: AbstractColours

    @classmethod
    def of(
        cls,
        frame: UInt8[np.ndarray, "h w 3"],
        boxes: Float[np.ndarray, "d 4"],
        colours: AbstractColours,
    ) -> "SampledBoxes":
        """Sample boxes (x, y, w, h) about their centre.

        Raises `ValueError` for a frame that is not (h, w, 3) of type uint8.
        """
        check_frame(frame)
        height, width = frame.shape[:2]
        row, down = _points(boxes[:, 1], boxes[:, 3], _ROWS, height)
        column, across = _points(boxes[:, 0], boxes[:, 2], _COLUMNS, width)
        pixels = frame[row[:, :, None], column[:, None, :]]
        inside = down[:, :, None] & across[:, None, :]
        return cls(pixels, inside, np.asarray(height), np.asarray(width), colours)

    def counts(self, num_parts: int = 1) -> Float[Array, "d parts channels bins"]:
        """Points of each colour in each box, cut into 1, 2 or 3 bands from top to bottom."""
        pixels, n = jnp.asarray(self.pixels), len(self.pixels)
        channels, bins = self.colours.num_channels, self.colours.num_bins
        drawn = self.colours.bins(pixels.reshape(n, -1, 3)).reshape(n, num_parts, -1, channels)
        group = jnp.arange(n * num_parts, dtype=jnp.int32).reshape(n, num_parts, 1, 1)
        channel = jnp.arange(channels, dtype=jnp.int32)[None, None, None]
        bin = (group * channels + channel) * bins + drawn
        seen = jnp.broadcast_to(jnp.asarray(self.inside).reshape(n, num_parts, -1, 1), bin.shape)
        counted = segment_counts(seen.ravel(), bin.ravel(), n * num_parts * channels * bins)
        return counted.reshape(n, num_parts, channels, bins).astype(default_float())


def _points(
    centres: np.ndarray, lengths: np.ndarray, number: int, size: int
) -> tuple[np.ndarray, np.ndarray]:
    """The pixels of points at the centres of equal parts, and whether they are in the frame."""
    shares = (np.arange(number, dtype=centres.dtype) + 0.5) / number - 0.5
    places = np.expand_dims(centres, 1) + np.expand_dims(lengths, 1) * np.expand_dims(shares, 0)
    inside = (places >= 0) & (places < size)
    return np.where(inside, places, 0.0).astype(np.int32), inside
