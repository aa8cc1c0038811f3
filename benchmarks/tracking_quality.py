"""Track state, precision, recall, rates and distinct hypotheses of boxes, shared by commands.

The measures of Smith and Gatica-Perez (2004), section 3.1, for one box of each object in each
frame, E the estimated box and G the true one. Boxes are (x, y, w, h) with (x, y) the top-left
corner, in pixels. All functions work under jit and vmap.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mpfjax.checks import Count, checked


def intersection_area(
    estimates: Float[Array, "*#batch 4"], truth: Float[Array, "*#batch 4"]
) -> Float[Array, "*batch"]:
    """|E ∩ G| in square pixels; zero for a box without area or with a coordinate that is NaN."""
    low = jnp.maximum(estimates[..., :2], truth[..., :2])
    high = jnp.minimum(estimates[..., :2] + estimates[..., 2:], truth[..., :2] + truth[..., 2:])
    sides = high - low
    area = sides[..., 0] * sides[..., 1]
    return jnp.where(jnp.all(sides > 0, axis=-1), area, jnp.zeros((), area.dtype))


def track_state(
    estimates: Float[Array, "*#batch 4"], truth: Float[Array, "*#batch 4"]
) -> Bool[Array, "*batch"]:
    """T: whether E ∩ G is not empty. Boxes that only touch have an empty intersection."""
    return intersection_area(estimates, truth) > 0


def precision(
    estimates: Float[Array, "*#batch 4"], truth: Float[Array, "*#batch 4"]
) -> Float[Array, "*batch"]:
    """P = |E ∩ G| / |E|, zero where they do not meet."""
    return _share(intersection_area(estimates, truth), estimates)


def recall(
    estimates: Float[Array, "*#batch 4"], truth: Float[Array, "*#batch 4"]
) -> Float[Array, "*batch"]:
    """R = |E ∩ G| / |G|, zero where they do not meet."""
    return _share(intersection_area(estimates, truth), truth)


def success_rate(
    track_states: Bool[Array, "runs t *objects"], present: Bool[Array, "t *objects"] | None = None
) -> Float[Array, "*objects"]:
    """The share of runs with T = 1 for all t; frames without a true box (`present`) do not count.

    Raises `ValueError` for no runs or no frames.
    """
    return recovery_rate(track_states, present, num_last=max(track_states.shape[1], 1))


@checked
def recovery_rate(
    track_states: Bool[Array, "runs t *objects"],
    present: Bool[Array, "t *objects"] | None = None,
    *,
    num_last: Count = 1,
) -> Float[Array, "*objects"]:
    """The share of runs that are tracked throughout or have recovered from a loss.

    The paper leaves open when a loss is over. Here it is when T = 1 in each of the last
    `num_last` frames that have a true box. An object that is tracked throughout fulfils this too.
    Raises `ValueError` for no runs or no frames, or `num_last` below 1.
    """
    if present is None:
        present = jnp.ones(track_states.shape[1:], bool)
    to_come = jnp.cumsum(present[::-1].astype(jnp.int32), axis=0)[::-1]
    fine = track_states | ~(present & (to_come <= num_last))[None]
    return jnp.mean(jnp.all(fine, axis=1).astype(jnp.result_type(float)), axis=0)


def uniqueness(states: Float[Array, "n objects d"]) -> Float[Array, " objects"]:
    """U/N of each object: its distinct hypotheses as a share of all particles."""

    def of_object(rows: Float[Array, "n d"]) -> Float[Array, ""]:
        rows = rows[jnp.lexsort(rows.T)]
        is_new = jnp.any(rows[1:] != rows[:-1], axis=1)
        return (1 + jnp.sum(is_new)) / rows.shape[0]

    return jax.vmap(of_object, in_axes=1)(states)


def _share(area: Float[Array, "*batch"], boxes: Float[Array, "*#batch 4"]) -> Float[Array, "..."]:
    whole = boxes[..., 2] * boxes[..., 3]
    # Apart from rounding, a part of a box has no more area than the box.
    meets = area > 0
    return jnp.where(meets, jnp.minimum(area / jnp.where(meets, whole, 1.0), 1.0), 0.0)
