"""Labelled boxes as states of a model, and boxes around them."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from mpfjax.vision.boxes.colour_model import AbstractBoxModel, BoxState
from mpfjax.vision.files.boxes import centred


def labelled_states(model: AbstractBoxModel, boxes: Float[np.ndarray, "t k 4"]) -> BoxState:
    """The states of k labelled objects in t consecutive frames: leaves (t, k, ...).

    Boxes are (x, y, w, h), top-left corner first; object j is the model's reference j, and the
    dynamics are of first order.
    """
    places = jnp.asarray(centred(boxes.reshape(-1, 4)).reshape(boxes.shape), float)
    scales = places[..., 2:] / model.reference_boxes[None, :, 2:]
    box = jnp.concatenate([places[..., :2], scales], axis=-1)
    reference = jnp.broadcast_to(jnp.arange(boxes.shape[1], dtype=jnp.int32), box.shape[:2])
    return BoxState(box, reference)


def boxes_around(
    key: Key[Array, ""],
    model: AbstractBoxModel,
    states: BoxState,
    num_boxes: int,
    reach: float = 2.0,
    stretch: float = 1.5,
) -> BoxState:
    """Boxes spread evenly over the neighbourhood of each: leaves (t, k, n, ...).

    Centres are uniform within `reach` widths and heights to each side; width and height are
    multiplied by up to `stretch`, or divided by it, uniformly in the logarithm. Use them as
    candidates of a `LabelLikelihood`. Unlike boxes that the dynamics reach in one step, they
    include boxes of wrong sizes, without which the likelihood does not learn about size.
    """
    spread = jax.tree.map(lambda leaf: jnp.repeat(leaf[:, :, None], num_boxes, axis=2), states)
    size = model.reference_boxes[spread.reference, 2:] * spread.box[..., 2:]
    shift, power = jax.random.uniform(key, (2, *size.shape), size.dtype, -1.0, 1.0)
    box = [spread.box[..., :2] + reach * size * shift, spread.box[..., 2:] * stretch**power]
    return BoxState(jnp.concatenate(box, axis=-1), spread.reference, spread.previous)
