"""Labelled boxes as states of a model, and boxes around them."""

from typing import Annotated

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from mpfjax.checks import Count, Positive, checked, number
from mpfjax.vision.boxes.colour_model import AbstractBoxModel, BoxState
from mpfjax.vision.files.boxes import centred


@checked
def labelled_states(model: AbstractBoxModel, boxes: Float[np.ndarray, "t k 4"]) -> BoxState:
    """The states of k labelled objects in t consecutive frames: leaves (t, k, ...).

    Boxes are (x, y, w, h), top-left corner first; object j is the model's reference j, and the
    dynamics are of first order. Raises `ValueError` for another number of boxes than of references,
    and for a box that is not finite or has no area.
    """
    boxes = np.asarray(boxes, float)
    k = model.reference_boxes.shape[0]
    if boxes.ndim != 3 or boxes.shape[1:] != (k, 4):
        raise ValueError(f"boxes: shape {boxes.shape} is not (t, {k}, 4), for {k} references")
    if not (np.isfinite(boxes).all() and (boxes[..., 2:] > 0).all()):
        raise ValueError("boxes: one is not finite, or has no area")
    places = jnp.asarray(centred(boxes.reshape(-1, 4)).reshape(boxes.shape), float)
    scales = places[..., 2:] / model.reference_boxes[None, :, 2:]
    box = jnp.concatenate([places[..., :2], scales], axis=-1)
    reference = jnp.broadcast_to(jnp.arange(k, dtype=jnp.int32)[None], box.shape[:2])
    return BoxState(box, reference)


@checked
def boxes_around(
    key: Key[Array, ""],
    model: AbstractBoxModel,
    states: BoxState,
    num_boxes: Count,
    reach: Positive = 2.0,
    stretch: Annotated[float, number(lambda x: 1 <= x < np.inf, "at least 1")] = 1.5,
) -> BoxState:
    """Boxes spread evenly over the neighbourhood of each: leaves (..., n, ...).

    Centres are uniform within `reach` widths and heights to each side; width and height are
    multiplied by up to `stretch`, or divided by it, uniformly in the logarithm. Use them as
    candidates of a `LabelLikelihood`. Unlike boxes that the dynamics reach in one step, they
    include boxes of wrong sizes, without which the likelihood does not learn about size. Raises
    `ValueError` for fewer than one box, a reach that is not positive, and a stretch below one.
    """

    def each(leaf: Array) -> Array:
        lead = states.reference.shape
        shape = (*lead, num_boxes, *leaf.shape[len(lead) :])
        return jnp.broadcast_to(jnp.expand_dims(leaf, len(lead)), shape)

    spread = jax.tree.map(each, states)
    size = model.reference_boxes[spread.reference, 2:] * spread.box[..., 2:]
    shift, power = jax.random.uniform(key, (2, *size.shape), size.dtype, -1.0, 1.0)
    centre = spread.box[..., :2] + reach * size * shift
    scale = spread.box[..., 2:] * stretch**power
    return BoxState(jnp.concatenate([centre, scale], axis=-1), spread.reference, spread.previous)
