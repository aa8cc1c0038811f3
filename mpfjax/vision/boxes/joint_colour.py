"""Several objects, each recognised by its colours, as in Smith and Gatica-Perez (2004)."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree, UInt8

from mpfjax.arrays import to_rows
from mpfjax.checks import Positive, check_shape, checked
from mpfjax.models.dynamics import Autoregression
from mpfjax.models.multi_object import MultiObjectModel
from mpfjax.vision.boxes.colour_model import BoxState, ColourModel, positive_deviations
from mpfjax.vision.colour import HSVColours

_MOMENTUM, _BANDS = 0.5, 2
PAPER_DEVIATIONS = (2.0, 2.0, 0.001, 0.001)


@checked
def joint_colour_model(
    frame: UInt8[np.ndarray, "h w 3"],
    boxes: Float[np.ndarray, "objects 4"],
    *,
    lambda_: Positive = 20.0,
    deviations: Sequence[float] = PAPER_DEVIATIONS,
    templates: Mapping[int, tuple[UInt8[np.ndarray, "h w 3"], Float[np.ndarray, "4"]]]
    | None = None,
    interaction: Callable[[PyTree, PyTree], Float[Array, " n"]] | None = None,
) -> MultiObjectModel:
    """J boxes with second-order dynamics, each recognised by the histograms of its own template.

    Smith and Gatica-Perez (2004), sections 2 and 3.2:

        L(y | x^j) ∝ exp(-λ d²),  x_t = x_{t-1} + 0.5 (x_{t-1} - x_{t-2}) + σ ω_t

    d² is the squared Bhattacharyya distance of `HSVColours` histograms, summed over the upper and
    the lower half of a box, as in Pérez, Hue, Vermaak and Gangnet (2002), where λ is 20 as well.
    Each object has a `ColourModel`, which averages over both, so that its σ² is 1 / (4 λ). The
    paper has one scale α; here width and height have separate scales. An observation is an RGB
    frame for all objects. Its integral histogram is computed once in each step, and under
    `monte_carlo` once for all runs.

    - `boxes`: (x, y, w, h), top-left corner first, the initial positions of the objects and of
      their templates in `frame`.
    - `lambda_`: λ.
    - `deviations`: σ of x and y in pixels and of the scales of width and height; also those of x_0.
    - `templates`: (frame, box) for an object whose template is in another frame, by its index.
    - `interaction`: as in `MultiObjectModel`, between `BoxState`s.

    Raises `ValueError`, with the name of the argument, for no boxes, a box without area or outside
    its frame, a key of `templates` that is not an object's index, and numbers that are not
    positive. Use it if each object has distinct colours.
    """
    boxes = to_rows(4, "boxes", boxes)
    # σ of exp(-(mean of d²) / 2σ²) for exp(-λ (sum of d²)).
    sigma = float((2 * lambda_ * _BANDS) ** -0.5)
    steps = positive_deviations(deviations, 1).reshape(4)
    momentum = Autoregression.with_momentum(_MOMENTUM, jnp.asarray(steps, float))

    learn = partial(
        ColourModel.from_frame, colours=HSVColours(), sigma=sigma, deviations=steps,
        dynamics=momentum, num_parts=_BANDS,
    )  # fmt: skip
    model = learn(frame, boxes)
    for j, (other_frame, box) in (templates or {}).items():
        if j not in range(len(boxes)):
            raise ValueError(f"templates: {j} is none of the {len(boxes)} objects, from 0 on")
        looks = learn(other_frame, to_rows(4, "templates", box)[:1]).references[0]
        model = eqx.tree_at(lambda m: m.references, model, model.references.at[j].set(looks))
    return MultiObjectModel(_one_each(model), len(boxes), interaction, True, per_object=True)


@checked
def object_boxes(model: MultiObjectModel, states: BoxState) -> Float[Array, "n objects 4"]:
    """(x, y, w, h) of every object of every particle, (x, y) the top-left corner, in pixels.

    For particles of a `joint_colour_model`, whose leaves are (n, J, ...). Raises `ValueError` for
    states of another kind or shape.
    """
    check_shape(f"n {model.num_objects} 4", states=states.box)

    def place(colour_model: ColourModel, states: BoxState) -> Float[Array, "n 4"]:
        boxes = colour_model.boxes(states)
        return jnp.concatenate([boxes[:, :2] - 0.5 * boxes[:, 2:], boxes[:, 2:]], axis=1)

    return eqx.filter_vmap(place, in_axes=(0, 1), out_axes=1)(model.object_model, states)


def _one_each(model: ColourModel) -> ColourModel:
    """k models with one reference each, stacked, made of one model with k references."""
    k = model.reference_boxes.shape[0]
    return jax.tree.map(lambda x: x[:, None] if x.ndim else jnp.broadcast_to(x, (k,)), model)
