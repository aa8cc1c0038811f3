"""Colour histograms that are differentiable in the box, in the image and in their parameters."""

import math
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.ndimage import map_coordinates
from jaxtyping import Array, Float, Num, UInt8

from mpfjax.models.dynamics import AbstractDynamics
from mpfjax.vision.boxes.colour_model import AbstractBoxModel, BoxState, ColourModel
from mpfjax.vision.colour.bins import RGBColours
from mpfjax.vision.colour.histograms import bhattacharyya, normalise


class SoftColourModel(AbstractBoxModel):
    """Boxes recognised by their colours, with a likelihood that is smooth in all its arguments.

        L(y | x) ∝ exp(-λ Σ_c B²(h^c, h_ref^c))

    as in `ColourModel` with λ = 1 / 2σ², where the histograms h are those of `soft_histograms`. h
    and h_ref are mixed with a thousandth of the uniform histogram, which bounds the derivative of
    the square root in B² = 1 - Σ_b sqrt(h_b h_ref,b). A box outside the frame has B = 1. The motion
    is that of `ColourModel`.

    An observation is an RGB frame (h, w, 3), uint8 or floating point in [0, 256). Make one with
    `from_frame`. Use it to tune λ, the reference and the bandwidth (`maximise` with a
    `LabelLikelihood`), or where you need the derivative in the box. `ColourModel` is faster.

    - `reference_boxes`, `dynamics`, `initial_deviations`, `switch_probability`: see `ColourModel`.
    - `reference_logits`: (k, parts, 3, bins), whose softmax over the bins is h_ref.
    - `lambda_`: λ.
    - `bandwidth`: of the soft bins, in bins.
    - `num_points`: K, of the grid in a box, a multiple of the number of parts; static.
    """

    reference_boxes: Float[Array, "k 4"]
    reference_logits: Float[Array, "k parts 3 bins"]
    dynamics: AbstractDynamics
    initial_deviations: Float[Array, "k 4"]
    lambda_: Float[Array, ""]
    bandwidth: Float[Array, ""]
    num_points: int = eqx.field(static=True, default=10)
    switch_probability: float = eqx.field(static=True, default=0.0)

    @classmethod
    def from_frame(
        cls,
        frame: UInt8[np.ndarray, "h w 3"],
        boxes: Float[np.ndarray, "k 4"],
        *,
        num_bins: int = 16,
        bandwidth: float = 0.5,
        num_points: int = 10,
        num_parts: int = 1,
        **options: Any,
    ) -> "SoftColourModel":
        """The model whose references are boxes (x, y, w, h), top-left corner first, of a frame.

        - `num_bins`: of each of red, green and blue.
        - `bandwidth`, `num_points`: see the class.
        - The other arguments and the errors are those of `ColourModel.from_frame`, but for σ, which
          is 0.15 and says λ = 1 / 2σ².
        """
        options = {"sigma": 0.15, "num_parts": num_parts} | options
        hard = ColourModel.from_frame(frame, boxes, colours=RGBColours(num_bins), **options)
        width = jnp.asarray(bandwidth, hard.sigma.dtype)
        counts = soft_histograms(
            jnp.asarray(frame), hard.reference_boxes, num_bins, width, num_points, num_parts
        )
        return cls(
            reference_boxes=hard.reference_boxes,
            reference_logits=jnp.log(_mixed(normalise(counts))),
            dynamics=hard.dynamics,
            initial_deviations=hard.initial_deviations,
            lambda_=0.5 / hard.sigma**2,
            bandwidth=width,
            num_points=num_points,
            switch_probability=hard.switch_probability,
        )

    @property
    def references(self) -> Float[Array, "k parts 3 bins"]:
        """h_ref, the reference histograms."""
        return jax.nn.softmax(self.reference_logits, axis=-1)

    def log_likelihood(
        self, observation: Num[Array, "h w 3"], states: BoxState
    ) -> Float[Array, " n"]:
        """-λ Σ_c B², each B² averaged over the bands."""
        _, num_parts, _, num_bins = self.reference_logits.shape
        boxes = self.boxes(states)
        counts = soft_histograms(
            observation, boxes, num_bins, self.bandwidth, self.num_points, num_parts
        )
        references = self.references[states.reference]
        distances = bhattacharyya(_mixed(normalise(counts)), references)
        empty = jnp.sum(counts, axis=-1) <= 0
        squares = jnp.mean(jnp.sum(jnp.where(empty, 1.0, distances), axis=2), axis=1)
        return -self.lambda_ * squares


@partial(jax.jit, static_argnames=("num_bins", "num_points", "num_parts"))
def soft_histograms(
    frame: Num[Array, "h w 3"],
    boxes: Float[Array, "n 4"],
    num_bins: int,
    bandwidth: Float[Array, ""],
    num_points: int = 10,
    num_parts: int = 1,
) -> Float[Array, "n parts 3 bins"]:
    """The shares of K x K points in each box that have each shade of red, green and blue.

    The points are the centres of K x K cells of the box. The frame's colours there are interpolated
    linearly from the four pixels around, as in a spatial transformer (Jaderberg et al. 2015). Each
    shade is spread over the bins by a triangular kernel of half-width `bandwidth` (in bins), with a
    sum of one for each point. As the bandwidth goes to zero, with a point on every pixel, the limit
    is the hard histogram. The shares are smooth in the boxes, the frame and the bandwidth, apart
    from kinks where a point moves from one pixel to the next.

    Boxes are (x, y, w, h) about their centre, in pixels. Points outside the frame do not count, and
    those within half a pixel of its edge count in part. Bands run from top to bottom. A box that is
    not finite has zero counts. K is a multiple of `num_parts`.
    """
    finite = jnp.all(jnp.isfinite(boxes), axis=1, keepdims=True)
    boxes = jnp.where(finite, boxes, -1e6)
    steps = (jnp.arange(num_points, dtype=boxes.dtype)[None] + 0.5) / num_points - 0.5
    x, y = (boxes[:, i, None] + boxes[:, i + 2, None] * steps for i in (0, 1))
    height, width, _ = frame.shape
    colours = _interpolated(frame, x, y).astype(boxes.dtype)
    inside = _inside(y, height)[:, :, None] * _inside(x, width)[:, None]
    shares = _soft_bins(colours, num_bins, bandwidth.astype(boxes.dtype))
    weighted = inside[:, :, :, None, None] * shares
    rows = num_points // num_parts
    banded = weighted.reshape(-1, num_parts, rows * num_points, 3, num_bins)
    return jnp.sum(banded, axis=2) / (rows * num_points)


def _interpolated(
    frame: Num[Array, "h w 3"], x: Float[Array, "n K"], y: Float[Array, "n K"]
) -> Float[Array, "n K K 3"]:
    """The frame between its pixels, whose centres are at half coordinates."""
    rows, columns = jnp.broadcast_arrays(y[:, :, None] - 0.5, x[:, None] - 0.5)
    channels = jnp.moveaxis(frame.astype(x.dtype), -1, 0)
    at = lambda channel: map_coordinates(channel, [rows, columns], 1, "nearest")  # noqa: E731
    return jnp.stack([at(channel) for channel in channels], axis=-1)


def _inside(places: Float[Array, "n K"], size: int) -> Float[Array, "n K"]:
    """1 within [0, size], 0 outside, and a ramp of one pixel between."""
    return jnp.clip(places + 0.5, 0.0, 1.0) * jnp.clip(size - places + 0.5, 0.0, 1.0)


def _soft_bins(
    values: Float[Array, "*batch"], num_bins: int, bandwidth: Float[Array, ""]
) -> Float[Array, "*batch bins"]:
    """The mass that a triangular kernel about each value, in [0, 256), has in each bin."""
    # Whole values are kept away from the edges of the bins, as far as possible. So in the limit
    # each counts in bin v num_bins // 256.
    clear = math.gcd(num_bins, 256) / 2
    places = (values * num_bins + clear) / 256
    edges = jnp.arange(1, num_bins, dtype=values.dtype)
    edges = edges.reshape(*[1] * values.ndim, num_bins - 1)
    z = jnp.clip((edges - places[..., None]) / bandwidth, -1.0, 1.0)
    below = 0.5 + z - 0.5 * z * jnp.abs(z)
    # The mass of the kernel outside all bins goes to the first and the last bin.
    ends = [(0, 0)] * values.ndim
    return jnp.diff(
        jnp.pad(jnp.pad(below, [*ends, (1, 0)]), [*ends, (0, 1)], constant_values=1.0), axis=-1
    )


def _mixed(histograms: Float[Array, "*batch bins"]) -> Float[Array, "*batch bins"]:
    """A thousandth of them uniform."""
    return (1 - 1e-3) * histograms + 1e-3 / histograms.shape[-1]
