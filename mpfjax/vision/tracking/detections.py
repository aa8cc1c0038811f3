"""The detections of a frame: boxes or points, and the detector's score of each."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from mpfjax.arrays import to_numbers, to_rows
from mpfjax.checks import shown, warn
from mpfjax.vision.files.boxes import to_centre

# Why a detection cannot be tracked, in the order in which it is asked.
_FAULTS = ("not finite", "of no area", "outside the frame")
# So many boxes tell whether they are x, y, w, h: by a tenth of the frame beyond it, or within 1.5.
_ENOUGH, _BEYOND, _SHARES = 20, 1.1, 1.5
_FORM = "they are taken for x, y, w, h in pixels, with (x, y) the top-left corner"


class Kind(NamedTuple):
    """All in which tracking boxes differs from tracking points.

    - `coordinates`: of a detection, (x, y, w, h) or (x, y).
    - `unit`: in pixels, the length in which places are given; 1 of boxes, which have sizes.
    - `temperature`: of the association; 1 where distance is the only cue.
    - `odds`: of an object at its first detection to those that confirm it, in logarithms; 0 of
      boxes, which two strong detections confirm.
    - `missed`: the log-probability that an object has no detection, in these odds.
    """

    coordinates: int
    unit: float
    temperature: float
    odds: float
    missed: float

    @property
    def has_boxes(self) -> bool:
        """Whether detections have sizes, and so colours, and overlaps that tell cameras' motion."""
        return self.coordinates == 4


BOXES = Kind(4, 1.0, 2.0, 0.0, 0.0)


def kind_of_points(deviation: float) -> Kind:
    """Points with an error of this standard deviation.

    Before any point an object has odds of 1 to 10, and odds of 20 to 1 confirm it; one of its
    points in seven is missed.
    """
    return Kind(2, float(deviation), 1.0, -np.log(10) - np.log(20), -np.log(7))


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
    def of(cls, output: Any, named: str, coordinates: int) -> "Detections":
        """The detections from a user's boxes, or points, or a tuple (boxes, scores, classes).

        Raises `ValueError` for boxes that are not rows of four numbers, or points of two, for
        scores and classes that are not one number per box, for classes that are not integers from 0
        on, and for vectors that are not one finite row per box.
        """
        if not isinstance(output, cls):
            several = isinstance(output, tuple) and len(output) in (2, 3)
            parts: Any = output if several else (output,)
            output = cls(*parts)
        rows, (scores, classes, vectors) = to_rows(coordinates, named, output.boxes), output[1:]
        scores = _one_each(named, "scores", scores, len(rows))
        classes = _one_each(named, "classes", classes, len(rows))
        if classes is not None:
            if (classes % 1 != 0).any() or (classes < 0).any():
                raise ValueError(f"{named}: classes {shown(classes)} are no whole numbers from 0")
            classes = classes.astype(int)
        if vectors is not None:
            vectors = np.asarray(vectors, float)
            if vectors.ndim != 2 or len(vectors) != len(rows) or not np.isfinite(vectors).all():
                expected = f"{len(rows)} rows of finite numbers"
                raise ValueError(f"{named}: vectors of shape {vectors.shape} are not {expected}")
        return cls(rows, scores, classes, vectors)


def _one_each(named: str, what: str, values: Any, number: int) -> np.ndarray | None:
    """The scores, or classes, as numbers, one for each box; None where there are none."""
    if values is None:
        return None
    numbers = np.array(to_numbers(f"{named}: {what}")(values))
    if len(numbers) != number:
        raise ValueError(f"{named}: {len(numbers)} {what} for {number} boxes")
    return numbers


class FrameDetections(NamedTuple):
    """The detections of a frame that can be tracked, the strongest first, equal ones by area.

    - `boxes`: (d, 4), centre and size in pixels; or (d, 2), points in deviations.
    - `scores`, `classes`: (d,), a class of 0 for none.
    - `rows`: (d,), the row of each in what the detector gave.
    - `extent`: left, top, right, bottom of the frame; infinite where not known.
    - `warning`: of the first that cannot be tracked, empty where all can.
    - `colours`: (d, bins), None without pixels; `vectors`: (d, e), None where nobody gave them.
    """

    boxes: Float[np.ndarray, "d k"]
    scores: Float[np.ndarray, " d"]
    classes: Int[np.ndarray, " d"]
    rows: Int[np.ndarray, " d"]
    extent: Float[np.ndarray, "4"]
    warning: str
    colours: Float[np.ndarray, "d bins"] | None
    vectors: Float[np.ndarray, "d e"] | None

    @classmethod
    def of(
        cls,
        output: Any,
        number: int,
        frame_size: tuple[int, int] | None,
        kind: Kind,
        min_score: float | None = None,
    ) -> "FrameDetections":
        """From the output of a detector for frame `number`, without scores below the least.

        Raises `ValueError` for a least score where there are none, and as `Detections.of` does.
        """
        named = f"detections: frame {number}"
        boxes, scores, classes, vectors = Detections.of(output, named, kind.coordinates)
        if scores is None and min_score is not None and len(boxes):
            raise ValueError(f"min_score: {min_score}, and detections have no scores")
        scores = np.ones(len(boxes)) if scores is None else scores
        classes = np.zeros(len(boxes), int) if classes is None else classes
        extent = np.array([-np.inf, -np.inf, np.inf, np.inf])
        if frame_size is not None:
            extent = np.array([0, 0, frame_size[1], frame_size[0]], float)
        with np.errstate(invalid="ignore"):
            far = boxes[:, :2] + (boxes[:, 2:] if kind.has_boxes else 0.0)
            sound = np.stack([
                np.isfinite(boxes).all(axis=1) & np.isfinite(scores),
                (boxes[:, 2:] > 0).all(axis=1),
                ((far > extent[:2]) & (boxes[:, :2] < extent[2:])).all(axis=1),
            ])  # fmt: skip
        keep, warning = sound.all(axis=0), ""
        for row in np.flatnonzero(~keep)[:1]:
            what = f"{shown(boxes[row].tolist())}, is {_FAULTS[np.argmin(sound[:, row])]}"
            warning = f"{named}, row {row}, {what}; left out, as all such are"
        rows = np.flatnonzero(keep & (scores >= (-np.inf if min_score is None else min_score)))
        areas = np.prod(boxes[rows, 2:], axis=1)
        rows = rows[np.lexsort((rows, -areas, -scores[rows]))]
        boxes = to_centre(boxes[rows]) if kind.has_boxes else boxes[rows] / kind.unit
        vectors = None if vectors is None else vectors[rows]
        about = scores[rows], classes[rows], rows, extent / kind.unit, warning
        return cls(boxes, *about, colours=None, vectors=vectors)

    def strongest(self, most: int) -> "FrameDetections":
        """The first so many."""
        names = ["boxes", "scores", "classes", "rows", *["vectors"] * (self.vectors is not None)]
        return self._replace(**{name: getattr(self, name)[:most] for name in names})

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
