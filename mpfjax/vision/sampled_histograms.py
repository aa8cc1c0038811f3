"""Colour histograms of boxes from a grid of points in each, at any size of frame and box."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, UInt8

from mpfjax.checks import check_shape, check_type, check_whole
from mpfjax.operations.segments import segment_counts
from mpfjax.vision.colours import AbstractColours
from mpfjax.vision.frames import check_frame


class SampledHistogram(eqx.Module):
    """The colours of a frame, counted at a grid of points in each box that is asked for.

    It stands where an `IntegralHistogram` does and is asked the same way, but its cost grows with
    the number of boxes alone, not with the frame or with their size: nothing is made of a frame
    before. A box is seen through `rows` x `columns` points, each of which takes the colour of the
    pixel that it lies in; B² differs from that of all pixels by about 0.03.

    - `frame`: RGB, (h, w, 3), of type uint8.
    - `colours`: the bins.
    - `rows`, `columns`: points of a box from top to bottom and from side to side.

    Raises `ValueError` for a frame of one channel or not of eight bits, and for counts that are no
    whole numbers from 1 on. Use it where a few thousand boxes are asked for in a large frame.
    """

    frame: UInt8[Array, "h w 3"]
    colours: AbstractColours
    rows: int = eqx.field(static=True, default=18)
    columns: int = eqx.field(static=True, default=8)

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

        Boxes are (x, y, w, h) about their centre, in pixels. Points outside the frame count
        nothing, nor does a box that has no area or is not finite. The rows are shared out over the
        bands: each has rows / num_parts of them, rounded up. Raises `ValueError` for boxes that are
        no array of four numbers each and a number of parts that is no whole number from 1 on.
        """
        check_shape("n 4", boxes=boxes)
        check_whole(num_parts=num_parts)
        rows = -(-self.rows // num_parts) * num_parts
        y = boxes[:, 1, None] + boxes[:, 3, None] * _grid(rows, boxes.dtype)
        x = boxes[:, 0, None] + boxes[:, 2, None] * _grid(self.columns, boxes.dtype)
        sized = jnp.all(jnp.isfinite(boxes), axis=1) & jnp.all(boxes[:, 2:] > 0, axis=1)
        down = sized[:, None] & (y >= 0) & (y < self.height)
        across = sized[:, None] & (x >= 0) & (x < self.width)
        inside = down[:, :, None] & across[:, None, :]
        row = jnp.where(down, y, 0.0).astype(jnp.int32)
        column = jnp.where(across, x, 0.0).astype(jnp.int32)
        pixels = self.frame.at[row[:, :, None], column[:, None, :]].get(mode="promise_in_bounds")
        n, channels, bins = len(boxes), self.colours.num_channels, self.colours.num_bins
        drawn = self.colours.bins(pixels.reshape(n, -1, 3)).reshape(n, num_parts, -1, channels)
        group = jnp.arange(n * num_parts, dtype=jnp.int32).reshape(n, num_parts, 1, 1)
        channel = jnp.arange(channels, dtype=jnp.int32)[None, None, None]
        bin = (group * channels + channel) * bins + drawn
        seen = jnp.broadcast_to(inside.reshape(n, num_parts, -1, 1), bin.shape)
        total = n * num_parts * channels * bins
        counted = segment_counts(seen.ravel(), bin.ravel(), total)
        return counted.reshape(n, num_parts, channels, bins).astype(boxes.dtype)


def _grid(number: int, dtype: jnp.dtype) -> Float[Array, "1 number"]:
    """The middles of so many equal parts of [-1/2, 1/2]."""
    return ((jnp.arange(number, dtype=dtype) + 0.5) / number - 0.5)[None]
