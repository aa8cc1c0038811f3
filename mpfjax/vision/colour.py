"""Colour histograms of boxes: of many from one integral histogram, of a few by a grid of points."""

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Shaped, UInt8

from mpfjax.checks import Checked, Count
from mpfjax.operations.stored import stored
from mpfjax.vision.files.frames import check_frame

Histograms = Float[Array, "#n parts channels bins"]
Numbers = Float[np.ndarray, " n"]
# Where a pixel has less of either, its hue is not reliable (Pérez et al. 2002).
_LEAST_SATURATION, _LEAST_VALUE = 0.1, 0.2
SURROUND = 2.0
# A box of more pixels cannot be counted in 16 bits.
LARGEST_NARROW = 2**16 - 1
# Widths of rows for which XLA for a CPU builds the table up to twice as fast.
_BINS_STEP, _LEAST_WIDTH = 16, 48
# The grid of points in a box.
_ROWS, _COLUMNS = 18, 8


class RGBColours(Checked):
    """Red, green and blue separately, each in `num_bins` equal bins.

    Vermaak et al. (2003), section 5.2. Raises `ValueError` for a number of bins below 1.
    """

    num_bins: Count = eqx.field(static=True, default=30)

    num_channels = 3
    """How many histograms a box has."""

    def bins(self, frame: UInt8[Any, "h w 3"]) -> Int[Any, "h w 3"]:
        """Red, green and blue in steps of 256 / num_bins."""
        return frame.astype(jnp.int32) * self.num_bins // 256


class HSVColours(Checked):
    """Hue and saturation jointly, and the value of pixels with little colour.

    N = N_h N_s + N_v bins in one histogram, Lin et al. (2012), section 2.1, after Pérez, Hue,
    Vermaak and Gangnet (2002). A pixel with a saturation of at least .1 and a value of at least .2
    (both in [0, 1]) is counted in one of N_h N_s bins of hue and saturation. The hue of any other
    pixel is unreliable: the pixel is counted in one of N_v bins of value. Each of the three is 10,
    as in the paper; a subclass may have other numbers. Use it if the illumination changes, or if
    one histogram should replace three.
    """

    num_hues = num_saturations = num_values = 10
    num_channels = 1
    """How many histograms a box has."""

    @property
    def num_bins(self) -> int:
        """N = N_h N_s + N_v."""
        return self.num_hues * self.num_saturations + self.num_values

    def bins(self, frame: UInt8[Any, "h w 3"]) -> Int[Any, "h w 1"]:
        """Hue N_s + saturation if there is colour, N_h N_s + value otherwise."""
        hue, saturation, value = hue_saturation_value(frame)
        coloured = (saturation >= _LEAST_SATURATION) & (value >= _LEAST_VALUE)
        colour = _bin(hue, self.num_hues) * self.num_saturations
        colour += _bin(saturation, self.num_saturations)
        grey = self.num_hues * self.num_saturations + _bin(value, self.num_values)
        return _numpy_of(frame).where(coloured, colour, grey)[:, :, None]


def _numpy_of(frame: Any) -> Any:
    """NumPy for its own arrays, JAX's for others."""
    return np if isinstance(frame, np.ndarray) else jnp


def hue_saturation_value(
    frame: UInt8[Any, "h w 3"],
) -> tuple[Float[Any, "h w"], Float[Any, "h w"], Float[Any, "h w"]]:
    """Hue, saturation and value of each pixel in [0, 1], by the usual hexcone.

    Hue runs from red at 0 through green at 1/3 and blue at 2/3; it is 0 where there is no colour.
    By NumPy where the frame is an array of it, without compiling anything.
    """
    xp = _numpy_of(frame)
    red, green, blue = (frame[:, :, i].astype(xp.float32) for i in range(3))
    high = xp.maximum(xp.maximum(red, green), blue)
    chroma = high - xp.minimum(xp.minimum(red, green), blue)
    unit = xp.where(chroma > 0, chroma, 1.0)
    from_red = (green - blue) / unit
    sector = xp.where(
        high == red,
        xp.where(from_red < 0, from_red + 6, from_red),
        xp.where(high == green, (blue - red) / unit + 2, (red - green) / unit + 4),
    )
    hue = xp.where(chroma > 0, sector / 6, 0.0)
    return hue, chroma / xp.where(high > 0, high, 1.0), high / 255


def _bin(share: Float[Any, "h w"], num_bins: int) -> Int[Any, "h w"]:
    return (share * num_bins).astype(jnp.int32).clip(0, num_bins - 1)


Colours = RGBColours | HSVColours


class IntegralHistogram(eqx.Module):
    """How many pixels of each colour lie above and to the left of every corner of a frame.

    Entry (r, c, k) counts the pixels in rows < r and columns < c whose channel k // num_bins falls
    into bin k % num_bins. Any box is counted exactly from its four corners, at a cost that does not
    depend on its size (Porikli 2005). Build it once a frame, for all particles and all runs.

    - `table`: shape (h + 1, w + 1, num_channels times at least num_bins). Counts wrap
      around in 16 bits, which cancels in the difference of corners as long as a box holds fewer
      than 65 536 pixels.
    - `num_channels`, `num_bins`: of the colours that were counted; static.
    """

    table: Shaped[Array, "rows columns k"]
    num_channels: int = eqx.field(static=True)
    num_bins: int = eqx.field(static=True)

    def counts(self, boxes: Float[Array, "n 4"], num_parts: int) -> Histograms:
        """Pixels of each colour in each box, cut into `num_parts` bands from top to bottom.

        Boxes are (x, y, w, h) about their centre, in pixels, and the frame spans [0, width] x [0,
        height]. A pixel belongs to a box that covers its centre. Boxes that leave the frame are
        clipped to it. A box that lies wholly outside, has no area or is not finite has zero counts.
        The counts of a box of more pixels than a number of the table can hold are NaN, since zeros
        would mean that it has none of a colour.
        """
        height, width = self.table.shape[0] - 1, self.table.shape[1] - 1
        x, y, w, h = (boxes[:, i, None] for i in range(4))
        across = jnp.array([[-0.5, 0.5]], boxes.dtype)
        down = jnp.linspace(-0.5, 0.5, num_parts + 1, dtype=boxes.dtype)[None]
        edges = _pixel(y + h * down, height), _pixel(x + w * across, width)
        # Otherwise XLA finds them again in each operation that uses the counts.
        edges = stored(jnp.concatenate(edges, axis=1))
        rows, columns = edges[:, : num_parts + 1], edges[:, num_parts + 1 :]
        corners = self.table.at[rows[:, :, None], columns[:, None, :]].get(mode="clip")
        bands = jnp.diff(corners[:, :, 1] - corners[:, :, 0], axis=1)
        pixels = (rows[:, -1] - rows[:, 0]) * (columns[:, 1] - columns[:, 0])
        # An unsigned count is never negative, so an inverted box must be silenced by its edges.
        valid = (columns[:, 1] > columns[:, 0]) & (rows[:, -1] > rows[:, 0])
        most = min(np.iinfo(self.table.dtype).max, np.iinfo(np.int32).max)
        too_large = valid & (pixels > most)
        instead = jnp.where(too_large, jnp.nan, 0.0).astype(boxes.dtype)
        counts = bands.reshape(boxes.shape[0], num_parts, self.num_channels, -1)
        counts = counts[..., : self.num_bins].astype(boxes.dtype)
        counted = (valid & ~too_large)[:, None, None, None]
        return jnp.where(counted, counts, instead[:, None, None, None])


def integral_histogram(
    frame: UInt8[Array, "h w 3"], colours: Colours, wide_counts: bool
) -> IntegralHistogram:
    """Build the integral histogram of an RGB frame, whose pixels `colours` sorts into bins.

    `wide_counts` counts in 32 bits, which takes two to four times as long, for boxes of 65 536
    pixels or more. Raises `ValueError` for a frame of one channel or not of eight bits.
    """
    check_frame(frame)
    table = _table(frame, colours, wide_counts)
    return IntegralHistogram(table, colours.num_channels, colours.num_bins)


def normalise(
    counts: Float[Array, "... bins"], weights: Float[Array, "... bins"] | float = 1.0
) -> Float[Array, "... bins"]:
    """Counts as shares that sum to one over the bins, by the weights of these.

    All zero where nothing was counted, and where counts are NaN; derivatives are then zero too.
    """
    counts = jnp.where(counts >= 0, counts, 0.0) * weights
    total = jnp.sum(counts, axis=-1, keepdims=True)
    return jnp.where(total > 0, counts / jnp.where(total > 0, total, 1.0), 0.0)


def bhattacharyya(
    histograms: Float[Array, "*#batch bins"], references: Float[Array, "*#batch bins"]
) -> Float[Array, "*batch"]:
    """B² = 1 - Σ_b sqrt(h_b r_b), the squared Bhattacharyya distance of normalised histograms.

    Vermaak et al. (2003), section 5.2. Between 0, for equal histograms, and 1, for histograms that
    share no colour; an empty histogram shares none. The square is what the likelihood needs.
    """
    return jnp.clip(1 - jnp.sum(jnp.sqrt(histograms * references), axis=-1), 0.0, 1.0)


@partial(jax.jit, static_argnames="wide_counts")
def _table(frame, colours, wide_counts):
    dtype = jnp.dtype(jnp.uint32 if wide_counts else jnp.uint16)
    # Pixels of no colour fill the row above, and the column to the left.
    bins = jnp.pad(colours.bins(frame), ((1, 0), (1, 0), (0, 0)), constant_values=-1)
    # The table has room for so many bins of a channel; no pixel falls into the last of them.
    least = max(colours.num_bins, -(-_LEAST_WIDTH // colours.num_channels))
    each = jnp.arange(-(-least // _BINS_STEP) * _BINS_STEP)[None, None]
    above = jnp.zeros((bins.shape[1], colours.num_channels * each.size), dtype)

    def add_row(above: Array, row: Array) -> tuple[Array, Array]:
        below = above + (row[:, :, None] == each).astype(dtype).reshape(above.shape)
        return below, below

    table = jax.lax.scan(add_row, above, bins)[1]

    def add_left(k: Int[Array, ""], table: Array) -> Array:
        return table.at[:, k].add(table[:, k - 1])

    return jax.lax.fori_loop(1, bins.shape[1], add_left, table)


def _pixel(edges: Float[Array, "n e"], size: int) -> Int[Array, "n e"]:
    """The first pixel whose centre lies at or past each edge, within [0, size]."""
    inside = jnp.clip(jnp.nan_to_num(edges, nan=0.0), -1.0, size + 1.0)
    return jnp.clip(jnp.ceil(inside - 0.5).astype(jnp.int32), 0, size)


@eqx.filter_jit
def reference_histograms(table, places, num_parts, weigh_colours):
    """The normalised histograms of reference boxes, and the weights of their colours.

    A colour is weighed by its share in the box relative to its share in the surroundings.
    """
    counts = table.counts(places, num_parts)
    weights = jnp.ones_like(counts)
    if weigh_colours:
        around = places * jnp.array([[1.0, 1.0, SURROUND, SURROUND]], places.dtype)
        inside, within = normalise(counts), table.counts(around, 1)
        share = inside + normalise(within - jnp.sum(counts, axis=1, keepdims=True))
        # A colour that is neither in the box nor around it says nothing about the box.
        weights = jnp.where(share > 0, inside / jnp.where(share > 0, share, 1.0), 0.5)
    return normalise(counts, weights), weights


def sampled_histograms(
    frame: UInt8[np.ndarray, "h w 3"],
    boxes: Float[np.ndarray, "d 4"],
    colours: Colours,
    num_parts: int,
) -> Float[np.ndarray, "d parts channels bins"]:
    """The colours of a few boxes (x, y, w, h) about their centres, at a grid of points in each.

    By NumPy, at a cost that does not depend on the frame. Boxes are cut into 1, 2 or 3 bands from
    top to bottom. B² differs from that of all pixels by about 0.03. Raises `ValueError` for a frame
    that is not (h, w, 3) of type uint8.
    """
    check_frame(frame)
    d, channels, num_bins = len(boxes), colours.num_channels, colours.num_bins
    row, down = _points(boxes[:, 1], boxes[:, 3], _ROWS, frame.shape[0])
    column, across = _points(boxes[:, 0], boxes[:, 2], _COLUMNS, frame.shape[1])
    pixels = np.asarray(frame)[row[:, :, None], column[:, None, :]].reshape(d, _ROWS * _COLUMNS, 3)
    shape = d, num_parts, _ROWS * _COLUMNS // num_parts
    drawn = np.asarray(colours.bins(pixels)).reshape(*shape, channels)
    inside = (down[:, :, None] & across[:, None, :]).reshape(*shape, 1)
    place = np.arange(d * num_parts * channels).reshape(d, num_parts, 1, channels)
    weights = np.broadcast_to(inside, drawn.shape).ravel()
    size = d * num_parts * channels * num_bins
    counts = np.bincount((place * num_bins + drawn).ravel(), weights, size)
    counts = counts.reshape(d, num_parts, channels, num_bins)
    return counts / np.maximum(counts.sum(axis=-1, keepdims=True), 1.0)


def _points(
    centres: Numbers, lengths: Numbers, number: int, size: int
) -> tuple[Int[np.ndarray, "n p"], Bool[np.ndarray, "n p"]]:
    """The pixels of points at the centres of equal parts, and whether they are in the frame."""
    shares = (np.arange(number, dtype=centres.dtype) + 0.5) / number - 0.5
    places = np.expand_dims(centres, 1) + np.expand_dims(lengths, 1) * np.expand_dims(shares, 0)
    inside = (places >= 0) & (places < size)
    return np.where(inside, places, 0.0).astype(np.int32), inside
