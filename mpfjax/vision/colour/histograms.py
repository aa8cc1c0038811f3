"""Colour histograms of boxes: of many from one integral histogram, of a few by a grid of points."""

from functools import partial
from itertools import pairwise

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Shaped, UInt8

from mpfjax.operations.stored import stored
from mpfjax.vision.colour.bins import AbstractColours
from mpfjax.vision.files.frames import check_frame

Histograms = Float[Array, "#n parts channels bins"]

SURROUND = 2.0
# A box of more pixels cannot be counted in 16 bits.
LARGEST_NARROW = 2**16 - 1
# Widths of rows for which XLA for a CPU builds the table up to twice as fast.
_BINS_STEP, _LEAST_WIDTH = 16, 48
# The grid of points in a box.
_ROWS, _COLUMNS = 18, 8


class IntegralHistogram(eqx.Module):
    """How many pixels of each colour lie above and to the left of every corner of a frame.

    Entry (r, c, k) counts the pixels in rows < r and columns < c whose channel k // num_bins falls
    into bin k % num_bins. Any box is counted exactly from its four corners, at a cost that does not
    depend on its size (Porikli 2005). Build it once a frame, for all particles and all runs.

    - `table`: shape (h + 1, w + 1, num_channels times at least num_bins). Counts wrap
      around in 16 bits, which cancels in the difference of corners as long as a box holds fewer
      than 65 536 pixels.
    - `num_channels`, `num_bins`: of the colours that were counted; static.
    - `height`, `width`: of the frame in pixels; static.
    """

    table: Shaped[Array, "rows columns k"]
    num_channels: int = eqx.field(static=True)
    num_bins: int = eqx.field(static=True)
    height: int = eqx.field(static=True)
    width: int = eqx.field(static=True)

    @property
    def largest_box(self) -> int:
        """The most pixels a box may hold and still be counted exactly."""
        return int(min(np.iinfo(self.table.dtype).max, np.iinfo(np.int32).max))

    def counts(self, boxes: Float[Array, "n 4"], num_parts: int = 1) -> Histograms:
        """Pixels of each colour in each box, cut into `num_parts` bands from top to bottom.

        Boxes are (x, y, w, h) about their centre, in pixels, and the frame spans [0, width] x [0,
        height]. A pixel belongs to a box that covers its centre. Boxes that leave the frame are
        clipped to it. A box that lies wholly outside, has no area or is not finite has zero counts.
        The counts of a box with more than `largest_box` pixels are NaN, since zeros would mean that
        it has none of a colour.
        """
        edges = jnp.concatenate(box_edges(boxes, num_parts, self.height, self.width), axis=1)
        # Otherwise XLA finds them again in each operation that uses the counts.
        edges = stored(edges)
        rows, columns = edges[:, : num_parts + 1], edges[:, num_parts + 1 :]
        corners = self.table.at[rows[:, :, None], columns[:, None, :]].get(mode="clip")
        bands = jnp.diff(corners[:, :, 1] - corners[:, :, 0], axis=1)
        pixels = (rows[:, -1] - rows[:, 0]) * (columns[:, 1] - columns[:, 0])
        # An unsigned count is never negative, so an inverted box must be silenced by its edges.
        valid = (columns[:, 1] > columns[:, 0]) & (rows[:, -1] > rows[:, 0])
        too_large = valid & (pixels > self.largest_box)
        instead = jnp.where(too_large, jnp.nan, 0.0).astype(boxes.dtype)
        counts = bands.reshape(boxes.shape[0], num_parts, self.num_channels, -1)
        counts = counts[..., : self.num_bins].astype(boxes.dtype)
        counted = (valid & ~too_large)[:, None, None, None]
        return jnp.where(counted, counts, instead[:, None, None, None])


def integral_histogram(
    frame: UInt8[Array, "h w 3"], colours: AbstractColours, wide_counts: bool = False
) -> IntegralHistogram:
    """Build the integral histogram of an RGB frame, whose pixels `colours` sorts into bins.

    `wide_counts` counts in 32 bits, which takes two to four times as long, for boxes of 65 536
    pixels or more. Raises `ValueError` for a frame of one channel or not of eight bits.
    """
    check_frame(frame)
    height, width, _ = frame.shape
    table = _table(frame, colours, wide_counts)
    return IntegralHistogram(table, colours.num_channels, colours.num_bins, height, width)


def normalise(
    counts: Float[Array, "... bins"], bin_weights: Float[Array, "... bins"] | None = None
) -> Float[Array, "... bins"]:
    """Counts as shares that sum to one over the bins.

    All zero where nothing was counted, and where counts are NaN; derivatives are then zero too.
    """
    counts = jnp.where(counts >= 0, counts, 0.0)
    if bin_weights is not None:
        counts = counts * jnp.broadcast_to(bin_weights, counts.shape)
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
    num_bins = _stored_bins(colours.num_bins, colours.num_channels)
    above = jnp.zeros((bins.shape[1], colours.num_channels * num_bins), dtype)

    def add_row(above: Array, row: Array) -> tuple[Array, Array]:
        below = above + _one_hot(row, num_bins, dtype)
        return below, below

    table = jax.lax.scan(add_row, above, bins)[1]

    def add_left(k: Int[Array, ""], table: Array) -> Array:
        return table.at[:, k].add(table[:, k - 1])

    return jax.lax.fori_loop(1, bins.shape[1], add_left, table)


def _stored_bins(num_bins: int, num_channels: int) -> int:
    """How many bins of a channel the table has room for; no pixel falls into the last of them."""
    least = max(num_bins, -(-_LEAST_WIDTH // num_channels))
    return -(-least // _BINS_STEP) * _BINS_STEP


def _one_hot(row: Int[Array, "w channels"], num_bins: int, dtype: jnp.dtype) -> Array:
    one_hot = (row[:, :, None] == jnp.arange(num_bins)[None, None]).astype(dtype)
    return one_hot.reshape(row.shape[0], -1)


def box_edges(
    boxes: Float[Array, "n 4"], num_parts: int, height: int, width: int
) -> tuple[Int[Array, "n rows"], Int[Array, "n 2"]]:
    """The rows at which the bands of each box begin and end, and its first column and its end."""
    x, y, w, h = (boxes[:, i, None] for i in range(4))
    across = jnp.array([[-0.5, 0.5]], boxes.dtype)
    down = jnp.linspace(-0.5, 0.5, num_parts + 1, dtype=boxes.dtype)[None]
    return _pixel(y + h * down, height), _pixel(x + w * across, width)


def _pixel(edges: Float[Array, "n e"], size: int) -> Int[Array, "n e"]:
    """The first pixel whose centre lies at or past each edge, within [0, size]."""
    inside = jnp.clip(jnp.nan_to_num(edges, nan=0.0), -1.0, size + 1.0)
    return jnp.clip(jnp.ceil(inside - 0.5).astype(jnp.int32), 0, size)


# --- references: the colours of boxes in a frame, by which their objects are recognised -------


def reference_histograms(
    frame: UInt8[np.ndarray, "h w 3"],
    colours: AbstractColours,
    places: Float[Array, "k 4"],
    num_parts: int,
    weigh_colours: bool,
) -> tuple[Histograms, Histograms]:
    """The normalised histograms of the reference boxes, and the weights of their colours."""
    # NumPy counts: boxes differ in size, and a program for each would have to be compiled.
    bins, inner, outer = map(
        np.asarray, _assign_bins(jnp.asarray(frame), colours, places, num_parts)
    )
    counts, within = (
        jnp.asarray(_counts(bins, edges, colours.num_bins), places.dtype)
        for edges in (inner, outer)
    )
    return _weigh(counts, within, weigh_colours)


@eqx.filter_jit
def _weigh(counts, within, weigh_colours):
    """Histograms by the counts in boxes and in their surroundings, and the weights of colours."""
    weights = jnp.ones_like(counts)
    if weigh_colours:
        inside = normalise(counts)
        share = inside + normalise(within - jnp.sum(counts, axis=1, keepdims=True))
        # A colour that is neither in the box nor around it says nothing about the box.
        weights = jnp.where(share > 0, inside / jnp.where(share > 0, share, 1.0), 0.5)
    return normalise(counts, weights), weights


@eqx.filter_jit
def _assign_bins(frame, colours, places, num_parts):
    """The bin of each pixel; the edges of each box and its bands, and those of its surroundings.

    The edges of a box are the rows at which its bands begin and end, its first column and its end.
    """
    around = places * jnp.array([[1.0, 1.0, SURROUND, SURROUND]], places.dtype)
    inner, outer = (
        jnp.concatenate(box_edges(boxes, parts, *frame.shape[:2]), axis=1)
        for boxes, parts in ((places, num_parts), (around, 1))
    )
    return colours.bins(frame), inner, outer


def _counts(
    bins: Int[np.ndarray, "h w channels"], edges: Int[np.ndarray, "k edges"], num_bins: int
) -> Int[np.ndarray, "k parts channels bins"]:
    """Pixels of each colour in each band of each box; none in a box without area."""

    def count(pixels: Int[np.ndarray, "rows columns channels"]) -> list[np.ndarray]:
        each = np.moveaxis(pixels, -1, 0).reshape(pixels.shape[-1], -1)
        return [np.bincount(channel, minlength=num_bins) for channel in each]

    return np.array([
        [count(bins[top:bottom, left:right]) for top, bottom in pairwise(rows)]
        for *rows, left, right in edges.tolist()
    ])  # fmt: skip


def sampled_histograms(
    frame: UInt8[np.ndarray, "h w 3"],
    boxes: Float[np.ndarray, "d 4"],
    colours: AbstractColours,
    num_parts: int = 1,
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
    pixels = np.asarray(frame)[row[:, :, None], column[:, None, :]]
    pixels = pixels.reshape(d, _ROWS * _COLUMNS, 3)
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
    centres: np.ndarray, lengths: np.ndarray, number: int, size: int
) -> tuple[np.ndarray, np.ndarray]:
    """The pixels of points at the centres of equal parts, and whether they are in the frame."""
    shares = (np.arange(number, dtype=centres.dtype) + 0.5) / number - 0.5
    places = np.expand_dims(centres, 1) + np.expand_dims(lengths, 1) * np.expand_dims(shares, 0)
    inside = (places >= 0) & (places < size)
    return np.where(inside, places, 0.0).astype(np.int32), inside
