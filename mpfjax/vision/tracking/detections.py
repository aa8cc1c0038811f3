"""The detections of a frame: boxes, and how sure the detector was of each."""

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mpfjax.checks import Count, as_numbers, checked, shown, to_array, to_rows
from mpfjax.operations.stored import take
from mpfjax.vision.files.boxes import centred

# Finite, as observations have to be.
_FAR = float(np.finfo(np.float32).max)
_UNBOUNDED = (-_FAR, -_FAR, _FAR, _FAR)
# The largest step between neighbours in float32, in boxes: within the errors of detectors.
_FINEST = 0.1


class DetectedBoxes(NamedTuple):
    """The boxes (x, y, w, h) detected in one frame; a score and a class for each, or None.

    Boxes with a masked entry are no detections.
    """

    boxes: Float[np.ndarray, "k 4"]
    scores: Float[np.ndarray, " k"] | None = None
    classes: Int[np.ndarray, " k"] | None = None

    @classmethod
    def of(cls, found: Any, named: str) -> "DetectedBoxes":
        """What users hand over: boxes, or (boxes, scores), or (boxes, scores, classes)."""
        several = isinstance(found, tuple) and len(found) in (2, 3)
        boxes, scores, classes = (*(found if several else (found,)), None, None)[:3]
        scores = None if scores is None else np.asanyarray(scores, float).reshape(-1)
        classes = None if classes is None else np.asarray(classes).reshape(-1)
        rows = to_masked_rows(4, named, boxes)
        for each, values in (("scores", scores), ("classes", classes)):
            if values is not None and len(values) != len(rows):
                raise ValueError(f"{named}: {len(values)} {each} for {len(rows)} boxes")
        return cls(rows, scores, classes)


class Detections(eqx.Module):
    """The boxes that a detector found in one frame, padded to a fixed number.

    - `boxes`: (d, 4), centre and size in pixels.
    - `valid`: (d,), which rows are detections.
    - `scores`: (d,), how sure the detector was of each, on any scale, higher for surer.
    - `rows`: (d,), the row of each in what the detector gave; None counts them as they stand here.
    - `extent`: left, top, right, bottom of the frame; as far as can be where not known.
    - `classes`: (d,), the class of each, whole numbers from 1 on; 0 for none.
    """

    boxes: Float[Array, "d 4"] = eqx.field(converter=to_array("boxes"))
    valid: Bool[Array, " d"] = eqx.field(converter=to_array("valid", floating=False))
    scores: Float[Array, " d"] = eqx.field(converter=to_array("scores"))
    rows: Int[Array, " d"] | None = None
    extent: Float[Array, "4"] = eqx.field(converter=to_array("extent"), default=_UNBOUNDED)
    classes: Int[Array, " d"] = eqx.field(converter=to_array("classes", floating=False), default=0)

    @classmethod
    @checked
    def from_boxes(
        cls,
        boxes: Float[np.ndarray, "k 4"],
        max_detections: Count,
        scores: Float[np.ndarray, " k"] | None = None,
        *,
        frame_size: tuple[int, int] | None = None,
        origin: Float[np.ndarray, "2"] | None = None,
        classes: Int[np.ndarray, " k"] | None = None,
    ) -> "Detections":
        """Boxes (x, y, w, h), top-left corner first, a score (1 where None) and a class for each.

        The boxes stay in their order. If there are too many, the strongest are kept, and of equally
        strong ones the largest. They may leave the frame in part or as a whole. Rows of a masked
        array with a masked entry are no detections. `frame_size` is height and width, where known.
        A tracker counts in float32: `origin`, the (x, y) of a point near the boxes, is subtracted
        from coordinates that are large, as those of maps are; add it to the tracks again.

        Raises `ValueError` for boxes that are not four finite numbers each, have no area, or are
        finer than float32 where they are; for scores that are masked, or not one finite number for
        each box; and for a size below one.
        """
        rows = to_masked_rows(4, "boxes", boxes)
        strengths = _one_each("scores", scores, len(rows), 1)
        kinds = _one_each("classes", classes, len(rows), 0)
        if not np.array_equal(kinds, np.abs(kinds).astype(np.int32)):
            raise ValueError(f"classes: {shown(kinds)} are not all whole numbers from 0 on")
        present = np.flatnonzero(~np.any(np.ma.getmaskarray(rows), axis=1))
        rows, strengths = centred(rows.data[present]), strengths[present]
        corner = np.zeros(2) if origin is None else np.asarray(origin, float)
        rows[:, :2] -= corner
        rounded = rows.astype(np.float32)
        steps, sides = np.spacing(np.abs(rounded[:, :2])), rounded[:, 2:]
        sound = (sides > 0) & (steps <= _FINEST * sides) & np.isfinite(sides)
        for box in rows[~sound.all(axis=1)].tolist():
            raise ValueError(f"boxes: about {box}: no area, or float32 needs an origin there")
        strongest = np.lexsort((-rows[:, 2] * rows[:, 3], -strengths))[:max_detections]
        kept = np.sort(strongest)
        extent = np.array(_UNBOUNDED, np.float32)
        if frame_size is not None:
            height, width = frame_size
            extent = np.array([*-corner, *([width, height] - corner)], np.float32)

        def padded(values: np.ndarray, none: float, dtype: Any) -> Array:
            places = np.full((max_detections, *values.shape[1:]), none, dtype)
            places[: len(kept)] = values
            return jnp.asarray(places)

        return cls(
            boxes=padded(rows[kept], 1, np.float32),
            valid=padded(np.ones(len(kept)), 0, bool),
            scores=padded(strengths[kept], 0, np.float32),
            rows=padded(present[kept], -1, np.int32),
            extent=jnp.asarray(extent),
            classes=padded(kinds[present[kept]], 0, np.int32),
        )

    def rows_of(self, indices: Int[Array, " m"]) -> Int[Array, " m"]:
        """The rows, in what the detector gave, of detections by their indices; -1 stays -1."""
        if self.rows is None:
            return indices
        return jnp.where(indices >= 0, take(self.rows, jnp.maximum(indices, 0)), -1)


def to_masked_rows(width: int, name: str, value: Any) -> np.ma.MaskedArray:
    """The argument as rows of `width` numbers, of which masked ones stay masked."""
    if isinstance(value, list | tuple) and any(map(np.ma.is_masked, value)):
        value = np.ma.array(value)
    mask: Any = False
    if isinstance(value, np.ma.MaskedArray):
        value, mask = value.data, np.ma.getmaskarray(value)
    rows = to_rows(width, name, value)
    return np.ma.array(rows, mask=np.broadcast_to(mask, rows.shape))


def _one_each(name: str, values: Any, number: int, none: int) -> np.ndarray:
    """A finite number for each box, the same one for all where none are given."""
    values = np.asarray(as_numbers(name, np.full(number, none) if values is None else values))
    if values.shape != (number,) or not np.isfinite(values).all():
        raise ValueError(f"{name}: {shown(values)} are not {number} finite numbers, one a box")
    return values
