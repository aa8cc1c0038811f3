"""The four filters: one component or two, resampling or Gaussian regeneration."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import mpfjax
from mpfjax.vision.boxes.colour_model import BoxState, ColourModel
from mpfjax.vision.colour.bins import HSVColours

NAMES = {"pf": "PF", "gpf": "GPF", "mpf": "MPF", "gm_mpf": "GM-MPF"}
MOMENTUM = 0.5
STEP_DEVIATIONS = (0.12, 0.04, 0.01, 0.01)  # a frame, in widths, heights, and shares of the size
SIGMA, NUM_PARTS = 0.1, 3


def make_model(still: np.ndarray, boxes: np.ndarray) -> ColourModel:
    """HSV histograms and second-order dynamics for two boxes (x, y, w, h), top-left corner."""
    deviations = np.array(STEP_DEVIATIONS)[None] * np.concatenate(
        [boxes[:, 2:], np.ones_like(boxes[:, 2:])], axis=1
    )
    each = [mpfjax.Autoregression.with_momentum(MOMENTUM, jnp.asarray(row)) for row in deviations]
    return ColourModel.from_frame(
        still,
        boxes,
        colours=HSVColours(),
        sigma=SIGMA,
        num_parts=NUM_PARTS,
        weigh_colours=True,
        deviations=deviations,
        dynamics=jax.tree.map(lambda *leaves: jnp.stack(leaves), *each),
    )


def make_filter(name: str, model: ColourModel, num_particles: int) -> mpfjax.Filter:
    """One of {one component, two} x {resample, Gaussian regeneration}."""
    redraw = mpfjax.GaussianRegeneration(where=motion) if "g" in name else mpfjax.Resample()
    moves = [redraw, mpfjax.Propagate(model)]
    if name in ("pf", "gpf"):
        return mpfjax.Filter(model, moves, num_particles)
    one_each = [
        mpfjax.KMeans(10, reseed=True, features=_reference),
        mpfjax.Merge(None, 0.5, features=_reference),
    ]
    return mpfjax.Filter(model, moves, num_particles, 2, one_each)


def motion(states: BoxState) -> tuple[Array | None, ...]:
    return states.box, states.previous


def _reference(states: BoxState) -> Array:
    return states.reference[:, None].astype(states.box.dtype)
