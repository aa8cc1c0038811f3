"""Colour histograms of boxes from a grid of points in each, at any size of frame and box."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt8

from mpfjax.operations.logarithms import default_float
from mpfjax.operations.segments import segment_counts
from mpfjax.vision.colour.bins import AbstractColours
from mpfjax.vision.files.frames import check_frame

ROWS, COLUMNS = 18, 8


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
        num_parts: int,
        rows: int = ROWS,
        columns: int = COLUMNS,
    ) -> "SampledBoxes":
        """Sample boxes (x, y, w, h) about their centre, in `num_parts` bands.

        Raises `ValueError` for a frame that is not (h, w, 3) of type uint8.
        """
        check_frame(frame)
        height, width = frame.shape[:2]
        rows = -(-rows // num_parts) * num_parts
        row, column, inside = _points(boxes, rows, columns, height, width)
        pixels = frame[row[:, :, None], column[:, None, :]]
        return cls(pixels, inside, np.asarray(height), np.asarray(width), colours)

    def counts(self, num_parts: int = 1) -> Float[Array, "d parts channels bins"]:
        """Points of each colour in each box, cut into `num_parts` bands from top to bottom.

        Raises `ValueError` for a number of bands into which the rows cannot be divided.
        """
        rows = self.pixels.shape[1]
        if rows % num_parts:
            raise ValueError(f"num_parts: {num_parts} does not divide the {rows} rows of points")
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
    boxes: np.ndarray, rows: int, columns: int, height: int, width: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows and columns of the boxes' points in the frame, and whether they are in it."""
    y = boxes[:, 1, None] + boxes[:, 3, None] * _grid(rows, boxes.dtype)
    x = boxes[:, 0, None] + boxes[:, 2, None] * _grid(columns, boxes.dtype)
    sized = np.all(np.isfinite(boxes), axis=1) & np.all(boxes[:, 2:] > 0, axis=1)
    down = np.expand_dims(sized, 1) & (y >= 0) & (y < height)
    across = np.expand_dims(sized, 1) & (x >= 0) & (x < width)
    row = np.where(down, y, 0.0).astype(np.int32)
    column = np.where(across, x, 0.0).astype(np.int32)
    return row, column, down[:, :, None] & across[:, None, :]


def _grid(number: int, dtype: Any) -> np.ndarray:
    """The centres of equal parts of [-1/2, 1/2]."""
    return ((np.arange(number, dtype=dtype) + 0.5) / number - 0.5)[None].astype(dtype)
