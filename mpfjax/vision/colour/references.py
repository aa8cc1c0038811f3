"""Reference histograms: the colours of boxes in a frame, by which their objects are recognised."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt8

from mpfjax.vision.colour.bins import AbstractColours
from mpfjax.vision.colour.histograms import integral_histogram, normalise, num_pixels

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
    around = places * jnp.array([[1.0, 1.0, SURROUND, SURROUND]], places.dtype)
    largest = _most_pixels(around if weigh_colours else places, *frame.shape[:2])
    wide = bool(largest > LARGEST_NARROW)
    counts, within = _counts(jnp.asarray(frame), colours, places, around, num_parts, wide)
    if not weigh_colours:
        return normalise(counts), jnp.ones_like(counts)
    ring = within[:, 0, None] - jnp.sum(counts, axis=1, keepdims=True)
    inside, outside = normalise(counts), normalise(ring)
    share = inside + outside
    # A colour that is neither in the box nor around it says nothing about the box.
    weights = jnp.where(share > 0, inside / jnp.where(share > 0, share, 1.0), 0.5)
    return normalise(counts, weights), weights


# Two programs: a hundred single operations take seconds to be loaded, even from the cache.
@eqx.filter_jit
def _most_pixels(boxes: Float[Array, "k 4"], height: int, width: int) -> Int[Array, ""]:
    return jnp.max(num_pixels(boxes, height, width))


@eqx.filter_jit
def _counts(
    frame: UInt8[Array, "h w 3"],
    colours: AbstractColours,
    places: Float[Array, "k 4"],
    around: Float[Array, "k 4"],
    num_parts: int,
    wide: bool,
) -> tuple[Float[Array, "k parts channels bins"], Float[Array, "k 1 channels bins"]]:
    table = integral_histogram(frame, colours, wide)
    return table.counts(places, num_parts), table.counts(around)
