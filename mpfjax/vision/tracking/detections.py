"""The detections of a frame: boxes or points, and the detector's score of each."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from mpfjax.arrays import (
    to_numbers,
    to_rows,
)
from mpfjax.checks import shown, warn
from mpfjax.vision.files.boxes import to_centre
from mpfjax.vision.tracking.gaussian import places_of
from mpfjax.vision.tracking.kinds import BOXES, Kind

# Why a detection cannot be tracked, in the order in which it is asked.
FAULTS: tuple[str, ...] = ("not finite", "of no area", "outside the frame")

# So many boxes tell whether they are x, y, w, h: by a tenth of the frame beyond it, or within 1.5.
_ENOUGH, _BEYOND, _SHARES = 20, 1.1, 1.5
_FORM = "they are taken for x, y, w, h in pixels, with (x, y) the top-left corner"
_UNBOUNDED = (-np.inf, -np.inf, np.inf, np.inf)


class Detections(NamedTuple):
    """The output of a detector for one frame, a row for each detection; missing fields are None.

    - `boxes`: (k, 4), (x, y, w, h) with (x, y) the top-left corner, in pixels; or points, (k, 2).
    - `scores`: (k,), the detector's confidence, on any scale, higher for more certain.
    - `classes`: (k,), integers from 1 on, and 0 for none.
    - `vectors`: (k, e), any vectors that distinguish objects, such as embeddings for
      re-identification, on any scale; zeros if there is none.
    """

    boxes: Float[np.ndarray, "k n"]
    scores: Float[np.ndarray, " k"] | None = None
    classes: Int[np.ndarray, " k"] | None = None
    vectors: Float[np.ndarray, "k e"] | None = None

    @classmethod
    def of(cls, output: Any, named: str, coordinates: int = 4) -> "Detections":
        """The detections from a user's boxes, or points, or a tuple (boxes, scores, classes).

        Raises `ValueError` for boxes that are not rows of four numbers, or points of two, for
        scores and classes that are not one number per box, for classes that are not integers from 0
        on, and for vectors that are not one finite row per box.
        """
        several = isinstance(output, tuple) and len(output) in (2, 3)
        parts: tuple[Any, ...] = output if several or isinstance(output, cls) else (output,)
        rows = to_rows(coordinates, named, parts[0])
        rest: list[Any] = []
        for each, values in zip(cls._fields[1:3], parts[1:], strict=False):
            if values is not None:
                values = np.array(to_numbers(f"{named}: {each}")(values))
                if len(values) != len(rows):
                    raise ValueError(f"{named}: {len(values)} {each} for {len(rows)} boxes")
            rest.append(values)
        detections = cls(rows, *rest)
        if isinstance(output, cls) and output.vectors is not None:
            vectors = np.asarray(output.vectors, float)
            if vectors.ndim != 2 or len(vectors) != len(rows) or not np.isfinite(vectors).all():
                expected = f"{len(rows)} rows of finite numbers"
                raise ValueError(f"{named}: vectors of shape {vectors.shape} are not {expected}")
            detections = detections._replace(vectors=vectors)
        if detections.classes is None:
            return detections
        if (detections.classes % 1 != 0).any() or (detections.classes < 0).any():
            what = shown(detections.classes)
            raise ValueError(f"{named}: classes {what} are no whole numbers from 0")
        return detections._replace(classes=detections.classes.astype(int))


class FrameDetections(NamedTuple):
    """The detections of a frame that can be tracked, the strongest first, equal ones by area.

    - `boxes`: (d, 4), centre and size in pixels; or (d, 2), points in deviations.
    - `scores`, `classes`: (d,), a class of 0 for none.
    - `rows`: (d,), the row of each in what the detector gave.
    - `extent`: left, top, right, bottom of the frame; infinite where not known.
    - `left_out`: (3,), how many cannot be tracked, by `FAULTS`; `warnings`: the first of each.
    - `colours`: (d, bins), None without pixels; `vectors`: (d, e), None where nobody gave them.
    """

    boxes: Float[np.ndarray, "d k"]
    scores: Float[np.ndarray, " d"]
    classes: Int[np.ndarray, " d"]
    rows: Int[np.ndarray, " d"]
    extent: Float[np.ndarray, "4"]
    left_out: Int[np.ndarray, "3"]
    warnings: tuple[str, ...]
    colours: Float[np.ndarray, "d bins"] | None = None
    vectors: Float[np.ndarray, "d e"] | None = None

    @classmethod
    def of(
        cls,
        detections: Detections,
        named: str,
        frame_size: tuple[int, int] | None,
        kind: Kind = BOXES,
    ) -> "FrameDetections":
        """Leave out what cannot be tracked, and count it."""
        rows, scores, classes, vectors = detections
        boxes = np.asarray(rows, float)
        scores = np.ones(len(rows)) if scores is None else scores
        keep = np.ones(len(rows), bool)
        extent = np.array(_UNBOUNDED)
        if frame_size is not None:
            extent = np.array([0, 0, frame_size[1], frame_size[0]], float)
        with np.errstate(invalid="ignore"):
            far = boxes[:, :2] + (boxes[:, 2:] if kind.has_boxes else 0.0)
            sound = (
                np.isfinite(boxes).all(axis=1) & np.isfinite(scores),
                (boxes[:, 2:] > 0).all(axis=1),
                ((far > extent[:2]) & (boxes[:, :2] < extent[2:])).all(axis=1),
            )
        left_out, warnings = np.zeros(len(FAULTS), int), []
        for i, (good, fault) in enumerate(zip(sound, FAULTS, strict=True)):
            wrong = np.flatnonzero(keep & ~good)
            left_out[i], keep = len(wrong), keep & good
            first = f"row {wrong[0]}, {shown(boxes[wrong[0]].tolist())}, is" if len(wrong) else ""
            warnings.append(f"{named}, {first} {fault}; left out, as all such are")
        rows = np.flatnonzero(keep)
        areas = np.prod(boxes[rows, 2:], axis=1)
        rows = rows[np.lexsort((rows, -areas, -scores[rows]))]
        classes = np.zeros(len(scores), int) if classes is None else classes
        boxes = to_centre(boxes[rows]) if kind.has_boxes else boxes[rows] / kind.unit
        about, extent = (scores[rows], classes[rows], rows), extent / kind.unit
        vectors = None if vectors is None else vectors[rows]
        return cls(boxes, *about, extent, left_out, tuple(warnings), vectors=vectors)

    def at(self, rows: np.ndarray | slice) -> "FrameDetections":
        """Some of them."""
        names = ["boxes", "scores", "classes", "rows", *["vectors"] * (self.vectors is not None)]
        return self._replace(**{name: getattr(self, name)[rows] for name in names})

    def warn_of_first(self, before: Int[np.ndarray, "3"]) -> None:
        """Warn of each fault that comes for the first time: so many came before."""
        for warning, had, has in zip(self.warnings, before, self.left_out, strict=True):
            if has and not had:
                warn(warning)

    def form_counts(self, before: Int[np.ndarray, "3"]) -> Int[np.ndarray, "3"]:
        """How many boxes there were, how many far beyond the frame, and how many within [0, 1.5].

        `before` this frame, and now. Warns once of those that are no x, y, w, h: of second corners,
        by which most reach beyond the frame, and of shares of the frame, all of which are small.
        """
        if before[0] >= _ENOUGH or self.boxes.shape[1] == 2:
            return before
        centres, halves = self.boxes[:, :2], self.boxes[:, 2:] / 2
        beyond = (centres + halves > _BEYOND * self.extent[2:]).any(axis=1)
        small = (centres >= halves).all(axis=1) & (centres + halves <= 2 * _SHARES).all(axis=1)
        small &= (self.boxes <= _SHARES).all(axis=1)
        counts = before + np.array([len(self.boxes), np.sum(beyond), np.sum(small)])
        number, num_beyond, num_small = counts
        if number >= _ENOUGH and 2 * num_beyond > number:
            warn(f"detections: {num_beyond} of {number} boxes reach far beyond the frame; {_FORM}")
        if number >= _ENOUGH and num_small == number:
            warn(f"detections: all of {number} boxes lie within [0, {_SHARES}]; {_FORM}")
        return counts

    @property
    def places(self) -> Float[np.ndarray, "d k"]:
        """(x, y, log w, log h), or (x, y)."""
        return places_of(self.boxes)
