"""What a detector found in a frame: boxes, and how sure it was of each."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mpfjax.checks import as_numbers, check_whole, shown, to_array, to_rows
from mpfjax.vision.files.boxes import centred


class Detections(eqx.Module):
    """The boxes that a detector found in one frame, padded to a fixed number.

    - `boxes`: (d, 4), centre and size in pixels.
    - `valid`: (d,), which rows are detections.
    - `scores`: (d,), how sure the detector was of each, on any scale, higher for surer.
    """

    boxes: Float[Array, "d 4"] = eqx.field(converter=to_array("boxes"))
    valid: Bool[Array, " d"] = eqx.field(converter=to_array("valid", floating=False))
    scores: Float[Array, " d"] = eqx.field(converter=to_array("scores"))

    @classmethod
    def from_boxes(
        cls,
        boxes: Float[np.ndarray, "k 4"],
        max_detections: int,
        scores: Float[np.ndarray, " k"] | None = None,
    ) -> "Detections":
        """Boxes (x, y, w, h), top-left corner first, and a score for each, all equal where None.

        Of too many, the strongest are kept, and of equally strong ones the largest. They may leave
        the frame in part or as a whole. Raises `ValueError` for boxes that are not four finite
        numbers each, or without area, for scores that are not one finite number for each box, and
        for room for less than one.
        """
        check_whole(max_detections=max_detections)
        rows = to_rows(4, "boxes", boxes).astype(np.float32)
        # One box alone is more likely a slip than meant.
        if len(rows) > 0 and np.ndim(boxes) != 2:
            raise ValueError(f"boxes: shape {np.shape(boxes)} is not (k, 4), of boxes x,y,w,h")
        for row in rows[~(np.isfinite(rows).all(axis=1) & (rows[:, 2:] > 0).all(axis=1))]:
            raise ValueError(f"boxes: {row.tolist()} has no area, or is not finite")
        strengths = _checked_scores(scores, len(rows))
        strongest = np.lexsort((-rows[:, 2] * rows[:, 3], -strengths))[:max_detections]
        padded = np.ones((max_detections, 4), np.float32)
        padded[: len(strongest)] = centred(rows[strongest])
        padded_scores = np.zeros(max_detections, np.float32)
        padded_scores[: len(strongest)] = strengths[strongest]
        valid = np.arange(max_detections) < len(strongest)
        return cls(jnp.asarray(padded), jnp.asarray(valid), jnp.asarray(padded_scores))


def _checked_scores(scores: Any, number: int) -> np.ndarray:
    """A finite score for each of so many boxes, all one where there are none given."""
    if scores is None:
        return np.ones(number, np.float32)
    values = np.asarray(as_numbers("scores", scores, floating=True), np.float32)
    if values.shape != (number,):
        raise ValueError(f"scores: shape {values.shape} is not that of one a box, ({number},)")
    if not np.isfinite(values).all():
        raise ValueError(f"scores: {shown(values)} are not all finite")
    return values
