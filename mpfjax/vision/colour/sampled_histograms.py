"""Colour histograms of boxes from a grid of points in each, at any size of frame and box."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt8

from mpfjax.checks import check_shape, check_type, check_whole
from mpfjax.operations.floats import default_float
from mpfjax.operations.segments import segment_counts
from mpfjax.vision.colour.bins import AbstractColours
from mpfjax.vision.files.frames import check_frame

ROWS, COLUMNS = 18, 8


class SampledHistogram(eqx.Module):
    """The colours of a frame, counted at a grid of points in each box.

    It has the methods of an `IntegralHistogram`. Nothing is computed from the whole frame, so that
    the cost grows with the number of boxes alone, not with their size or that of the frame. A box
    is sampled at `rows` x `columns` points, each of which takes the colour of its pixel. B² differs
    from that of all pixels by about 0.03.

    - `frame`: RGB, (h, w, 3), of type uint8.
    - `colours`: the bins.
    - `rows`, `columns`: points of a box from top to bottom and from side to side.

    Raises `ValueError` for a frame of one channel or not of eight bits, and for counts that are no
    whole numbers from 1 on. Use it for up to a few thousand boxes in a large frame.
    """

    frame: UInt8[Array, "h w 3"]
    colours: AbstractColours
    rows: int = eqx.field(static=True, default=ROWS)
    columns: int = eqx.field(static=True, default=COLUMNS)

    def __check_init__(self) -> None:
        check_frame(self.frame)
        check_type(AbstractColours, "AbstractColours such as RGBColours()", colours=self.colours)
        check_whole(rows=self.rows, columns=self.columns)

    @property
    def height(self) -> int:
        """Of the frame, in pixels."""
        return self.frame.shape[0]

    @property
    def width(self) -> int:
        """Of the frame, in pixels."""
        return self.frame.shape[1]

    def counts(
        self, boxes: Float[Array, "n 4"], num_parts: int = 1
    ) -> Float[Array, "n parts channels bins"]:
        """Points of each colour in each box, cut into `num_parts` bands from top to bottom.

        Boxes are (x, y, w, h) about their centre, in pixels. Points outside the frame are not
        counted; a box that has no area or is not finite has zero counts. The rows are divided among
        the bands: each has rows / num_parts of them, rounded up. Raises `ValueError` for boxes that
        are no array of four numbers each and a number of parts that is no whole number from 1 on.
        """
        check_shape("n 4", boxes=boxes)
        check_whole(num_parts=num_parts)
        rows = -(-self.rows // num_parts) * num_parts
        row, column, inside = _points(jnp, boxes, rows, self.columns, self.height, self.width)
        pixels = self.frame.at[row[:, :, None], column[:, None, :]].get(mode="promise_in_bounds")
        return _counted(pixels, inside, self.colours, num_parts).astype(boxes.dtype)


class SampledBoxes(eqx.Module):
    """The colours of detected boxes: the pixels of a frame at a grid of points in each.

    NumPy looks them up, outside of the compiled program, whose time and shapes then do not depend
    on the frame. It counts the same points as a `SampledHistogram`, for these boxes alone.

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
        row, column, inside = _points(np, boxes, rows, columns, height, width)
        pixels = frame[row[:, :, None], column[:, None, :]]
        return cls(pixels, inside, np.asarray(height), np.asarray(width), colours)

    def counts(self, num_parts: int = 1) -> Float[Array, "d parts channels bins"]:
        """Points of each colour in each box, cut into `num_parts` bands from top to bottom.

        Raises `ValueError` for a number of bands into which the rows cannot be divided.
        """
        rows = self.pixels.shape[1]
        if rows % num_parts:
            raise ValueError(f"num_parts: {num_parts} does not divide the {rows} rows of points")
        pixels, inside = jnp.asarray(self.pixels), jnp.asarray(self.inside)
        return _counted(pixels, inside, self.colours, num_parts).astype(default_float())


def _points(
    xp: Any, boxes: Any, rows: int, columns: int, height: int, width: int
) -> tuple[Any, Any, Any]:
    """Rows and columns of the boxes' points in the frame, and whether they are in it."""
    y = boxes[:, 1, None] + boxes[:, 3, None] * _grid(xp, rows, boxes.dtype)
    x = boxes[:, 0, None] + boxes[:, 2, None] * _grid(xp, columns, boxes.dtype)
    sized = xp.all(xp.isfinite(boxes), axis=1) & xp.all(boxes[:, 2:] > 0, axis=1)
    down = sized[:, None] & (y >= 0) & (y < height)
    across = sized[:, None] & (x >= 0) & (x < width)
    row = xp.where(down, y, 0.0).astype(xp.int32)
    column = xp.where(across, x, 0.0).astype(xp.int32)
    return row, column, down[:, :, None] & across[:, None, :]


def _counted(
    pixels: Any,
    inside: Any,
    colours: AbstractColours,
    num_parts: int,
) -> Int[Array, "n parts channels bins"]:
    n, channels, bins = len(pixels), colours.num_channels, colours.num_bins
    drawn = colours.bins(pixels.reshape(n, -1, 3)).reshape(n, num_parts, -1, channels)
    group = jnp.arange(n * num_parts, dtype=jnp.int32).reshape(n, num_parts, 1, 1)
    channel = jnp.arange(channels, dtype=jnp.int32)[None, None, None]
    bin = (group * channels + channel) * bins + drawn
    seen = jnp.broadcast_to(inside.reshape(n, num_parts, -1, 1), bin.shape)
    counted = segment_counts(seen.ravel(), bin.ravel(), n * num_parts * channels * bins)
    return counted.reshape(n, num_parts, channels, bins)


def _grid(xp: Any, number: int, dtype: Any) -> Any:
    """The centres of equal parts of [-1/2, 1/2]."""
    return ((xp.arange(number, dtype=dtype) + 0.5) / number - 0.5)[None].astype(dtype)
