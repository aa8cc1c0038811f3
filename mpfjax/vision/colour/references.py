"""Reference histograms: the colours of boxes in a frame, by which their objects are recognised."""

from itertools import pairwise

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt8

from mpfjax.vision.colour.bins import AbstractColours
from mpfjax.vision.colour.histograms import box_edges

SURROUND = 2.0
# A box of more pixels cannot be counted in 16 bits.
LARGEST_NARROW = 2**16 - 1


def reference_histograms(
    frame: UInt8[np.ndarray, "h w 3"],
    colours: AbstractColours,
    places: Float[Array, "k 4"],
    num_parts: int,
    weigh_colours: bool,
) -> tuple[Float[Array, "k parts channels bins"], Float[Array, "k parts channels bins"]]:
    """The normalised histograms of the reference boxes, and the weights of their colours."""
    # NumPy does the rest: single operations of JAX take seconds to be compiled. Only quotients are
    # JAX's, whose last digits are not NumPy's.
    bins, inner, outer = map(np.asarray, _sorted(jnp.asarray(frame), colours, places, num_parts))
    counts = _counts(bins, inner, colours.num_bins).astype(places.dtype)
    if not weigh_colours:
        return jnp.asarray(_normalised(counts)), jnp.asarray(np.ones_like(counts))
    within = _counts(bins, outer, colours.num_bins).astype(places.dtype)
    ring = within - np.sum(counts, axis=1, keepdims=True)
    inside, outside = _normalised(counts), _normalised(ring)
    share = inside + outside
    # A colour that is neither in the box nor around it says nothing about the box.
    weights = np.where(share > 0, _ratio(inside, share), np.full_like(share, 0.5))
    return jnp.asarray(_normalised(counts * weights)), jnp.asarray(weights)


@eqx.filter_jit
def _sorted(
    frame: UInt8[Array, "h w 3"],
    colours: AbstractColours,
    places: Float[Array, "k 4"],
    num_parts: int,
) -> tuple[Int[Array, "h w channels"], Int[Array, "k inner"], Int[Array, "k outer"]]:
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
    return np.array([
        [_count(bins[top:bottom, left:right], num_bins) for top, bottom in pairwise(rows)]
        for *rows, left, right in edges.tolist()
    ])  # fmt: skip


def _count(
    bins: Int[np.ndarray, "rows columns channels"], num_bins: int
) -> Int[np.ndarray, "channels bins"]:
    channels = np.moveaxis(bins, -1, 0)
    return np.array([np.bincount(part.ravel(), minlength=num_bins) for part in channels])


def _normalised(counts: Float[np.ndarray, "... bins"]) -> Float[np.ndarray, "... bins"]:
    """Counts as shares that sum to one over the bins; all zero where nothing was counted."""
    counts = np.where(counts >= 0, counts, np.zeros_like(counts))
    # One number after the other, as in a filter's program.
    total = np.cumsum(counts, axis=-1)[..., -1:]
    return np.where(total > 0, _ratio(counts, total), np.zeros_like(counts))


def _ratio(
    values: Float[np.ndarray, "..."], by: Float[np.ndarray, "..."]
) -> Float[np.ndarray, "..."]:
    return np.asarray(jnp.divide(values, np.where(by > 0, by, np.ones_like(by))))
