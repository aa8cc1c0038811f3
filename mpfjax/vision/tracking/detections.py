"""The detections of a frame: boxes, and how sure the detector was of each."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mpfjax.checks import as_numbers, check_whole, shown, to_array, to_rows
from mpfjax.operations.indexing import take
from mpfjax.vision.files.boxes import centred


class Detections(eqx.Module):
    """The boxes that a detector found in one frame, padded to a fixed number.

    - `boxes`: (d, 4), centre and size in pixels.
    - `valid`: (d,), which rows are detections.
    - `scores`: (d,), how sure the detector was of each, on any scale, higher for surer.
    - `rows`: (d,), the row of each in what the detector gave; None counts them as they stand here.
    """

    boxes: Float[Array, "d 4"] = eqx.field(converter=to_array("boxes"))
    valid: Bool[Array, " d"] = eqx.field(converter=to_array("valid", floating=False))
    scores: Float[Array, " d"] = eqx.field(converter=to_array("scores"))
    rows: Int[Array, " d"] | None = None

    @classmethod
    def from_boxes(
        cls,
        boxes: Float[np.ndarray, "k 4"],
        max_detections: int,
        scores: Float[np.ndarray, " k"] | None = None,
    ) -> "Detections":
        """Boxes (x, y, w, h), top-left corner first, and a score for each; all 1 where None.

        The boxes stay in their order. If there are too many, the strongest are kept, and of equally
        strong ones the largest. They may leave the frame in part or as a whole. Raises `ValueError`
        for boxes that are not four finite numbers each, or have no area, for scores that are not
        one finite number for each box, and for a size below one.
        """
        check_whole(max_detections=max_detections)
        rows = to_rows(4, "boxes", boxes).astype(np.float32)
        # A single box without its axis is more likely a slip than meant.
        if len(rows) > 0 and np.ndim(boxes) != 2:
            raise ValueError(f"boxes: shape {np.shape(boxes)} is not (k, 4), of boxes x,y,w,h")
        for row in rows[~(np.isfinite(rows).all(axis=1) & (rows[:, 2:] > 0).all(axis=1))]:
            raise ValueError(f"boxes: {row.tolist()} has no area, or is not finite")
        strengths = _checked_scores(scores, len(rows))
        strongest = np.lexsort((-rows[:, 2] * rows[:, 3], -strengths))[:max_detections]
        kept = np.sort(strongest)
        padded = np.ones((max_detections, 4), np.float32)
        padded[: len(kept)] = centred(rows[kept])
        padded_scores = np.zeros(max_detections, np.float32)
        padded_scores[: len(kept)] = strengths[kept]
        padded_rows = np.full(max_detections, -1, np.int32)
        padded_rows[: len(kept)] = kept
        valid = np.arange(max_detections) < len(kept)
        return cls(*map(jnp.asarray, (padded, valid, padded_scores, padded_rows)))

    def rows_of(self, indices: Int[Array, " m"]) -> Int[Array, " m"]:
        """The rows, in what the detector gave, of detections by their indices; -1 stays -1."""
        if self.rows is None:
            return indices
        return jnp.where(indices >= 0, take(self.rows, jnp.maximum(indices, 0)), -1)


def _checked_scores(scores: Any, number: int) -> np.ndarray:
    """A finite score for each box, all one where none are given."""
    if scores is None:
        return np.ones(number, np.float32)
    values = np.asarray(as_numbers("scores", scores, floating=True), np.float32)
    if values.shape != (number,):
        raise ValueError(f"scores: shape {values.shape} is not that of one a box, ({number},)")
    if not np.isfinite(values).all():
        raise ValueError(f"scores: {shown(values)} are not all finite")
    return values
