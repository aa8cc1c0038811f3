"""What may be given as detections: rows of a file, boxes frame by frame, or a detector to call."""

import itertools
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from mpfjax.checks import CountOrZero, checked, is_series, saying, shown, warn
from mpfjax.vision.files.boxes import read_detections
from mpfjax.vision.tracking.detections import DetectedBoxes, to_masked_rows

# MOTChallenge's columns: frame, id, x, y, w, h, and the score, where there is one.
_BOX, _SCORE = slice(2, 6), 6
# A tracker that is made for rows of detections has room for at most so many objects.
LEAST_ROOM, MOST_ROOM = 24, 1024
_END = object()


class Rows:
    """Rows (frame, id, x, y, w, h, score) as MOTChallenge files have them; the id is not read.

    Frames count from 1. Without pixels `last` is the last frame, by default that of the last row.
    """

    @checked
    def __init__(
        self, rows: Float[np.ndarray, "r columns"], *, last: CountOrZero | None = None
    ) -> None:
        if rows.ndim != 2 or not (rows.size == 0 or 6 <= rows.shape[1] <= 10):
            raise ValueError(f"detections: shape {rows.shape} is not of frame,id,x,y,w,h,score")
        rows = rows if rows.size else np.zeros((0, 7))
        rows = to_masked_rows(rows.shape[1], "detections", rows)
        bad = ~np.isfinite(rows[:, : _SCORE + 1]).all(axis=1)
        bad |= (rows[:, 0] % 1 != 0) | (rows[:, 0] < 1)
        for number in np.flatnonzero(bad.filled(False))[:1]:
            row = shown(rows.data[number])
            raise ValueError(f"detections: row {number}, {row}, is not finite, or of no frame")
        rows = rows[~np.ma.getmaskarray(rows)[:, 0]]
        rows = rows[np.argsort(rows.data[:, 0], kind="stable")]
        self._rows, self._frames = rows, rows.data[:, 0].astype(int)
        self.last = int(self._frames.max(initial=0)) if last is None else last

    def of_frame(self, number: int) -> DetectedBoxes:
        """The detections of a frame."""
        begin, end = np.searchsorted(self._frames, [number, number + 1])
        rows = self._rows[begin:end]
        return DetectedBoxes(rows[:, _BOX], rows[:, _SCORE] if rows.shape[1] > _SCORE else None)

    def num_after(self, last: int) -> int:
        """How many rows lie in later frames."""
        return int(np.sum(self._frames > last))

    def most_objects(self) -> int:
        """One and a half times the number of detections in all but the fullest frames."""
        counts = np.unique(self._frames, return_counts=True)[1]
        usual = float(np.quantile(counts, 0.95)) if len(counts) else 0.0
        return int(np.clip(8 * np.ceil(1.5 * usual / 8), LEAST_ROOM, MOST_ROOM))


Detector = Rows | Callable[[Any], Any] | Iterable[Any]


def as_detector(detections: Any) -> Detector:
    """Files and arrays as rows; a callable and an iterable as they are.

    Raises `ValueError` for anything else, and for rows that are not in MOTChallenge's form.
    """
    if isinstance(detections, str | Path):
        detections = read_detections(detections)
    if isinstance(detections, np.ndarray | jax.Array):
        return Rows(np.asanyarray(detections))
    is_detector = callable(detections) and not isinstance(detections, type)
    if is_detector or isinstance(detections, Rows) or is_series(detections):
        return detections
    raise ValueError(f"detections: {shown(detections)} is no detector, rows, file or boxes a frame")


def observed(
    stills: Iterator[np.ndarray] | None, detector: Detector, first: int
) -> Iterator[tuple[int, np.ndarray | None, DetectedBoxes]]:
    """Number, pixels and detections of each frame; warns of detections after the last."""
    number, end = first - 1, detector.last + 1 if isinstance(detector, Rows) else None
    numbers = itertools.count(first) if end is None else range(first, end)
    frames = zip(numbers, itertools.repeat(None)) if stills is None else enumerate(stills, first)
    if isinstance(detector, Rows):
        for number, still in frames:
            yield number, still, detector.of_frame(number)
        if late := detector.num_after(number):
            warn(f"detections: {late} lie in frames after the last, {number}, and were left out")
        return
    coming = iter(()) if callable(detector) else iter(detector)
    for number, still in frames:
        if callable(detector) and still is None:  # it cannot be decoded
            found = []
        elif callable(detector):
            with saying(f"detections: raised by the detector at frame {number}"):
                found = detector(still)
        else:
            found = next(coming, _END)
        if found is _END and still is None:
            return
        if found is _END:
            raise ValueError(f"detections: end before the frames do, at frame {number}")
        yield number, still, DetectedBoxes.of(found, f"detections: frame {number}")
    if next(coming, _END) is not _END:
        warn(f"detections: go on after the last frame, {number}, and were left out")


class Sieve:
    """Removes detections that cannot be tracked, and warns once of each kind.

    Detections with a score below `min_score` are left out silently; those without area, and those
    wholly outside the frame, with a warning. `frame_size` is height and width, for recordings
    without pixels. Raises `ValueError` for boxes or scores that are not finite, for scores of the
    wrong shape, and where `min_score` is given and there are no scores.
    """

    def __init__(self, min_score: float | None, frame_size: tuple[int, int] | None = None) -> None:
        self.min_score, self.frame_size = min_score, frame_size
        self.once = Once()

    def __call__(
        self, found: DetectedBoxes, number: int, frame: np.ndarray | None
    ) -> tuple[DetectedBoxes, Int[np.ndarray, " k"]]:
        """The detections of a frame that can be tracked, and the row of each among all of them."""
        found, keep = _present(found, number)
        boxes, scores, _ = found
        if self.min_score is not None and len(boxes):
            if scores is None:
                raise ValueError(f"min_score: {self.min_score}, and detections have no scores")
            keep &= scores >= self.min_score
        frame_size = self.frame_size if frame is None else frame.shape[:2]
        height, width = (np.inf, np.inf) if frame_size is None else frame_size
        low, far = boxes[:, :2], boxes[:, :2] + boxes[:, 2:]
        inside = ((far > 0) & (low < [width, height])).all(axis=1) | (frame_size is None)
        for what, good in (
            ("of no area", (boxes[:, 2:] > 0).all(axis=1)),
            (f"outside the frame, {width} x {height}", inside),
        ):
            if np.any(keep & ~good):
                self.once.warn(what, f"detections: frame {number} has boxes {what}; left out")
            keep &= good
        rest = (None if part is None else part[keep] for part in found[1:])
        return DetectedBoxes(boxes[keep], *rest), np.flatnonzero(keep).astype(np.int32)


class Once:
    """Warns of each kind of problem once, and not in every frame."""

    def __init__(self) -> None:
        self.said: set[str] = set()

    def warn(self, kind: str, message: str) -> None:
        """Warn, unless a warning of this kind was given before."""
        if kind not in self.said:
            self.said.add(kind)
            warn(f"{message} (here and wherever else it is so)")


def _present(found: DetectedBoxes, number: int) -> tuple[DetectedBoxes, Bool[np.ndarray, " k"]]:
    """The boxes and scores without masks, and which of them are detections."""
    boxes, scores, classes = found
    present = np.logical_not(np.any(np.ma.getmaskarray(boxes), axis=1))
    named = f"detections: frame {number}"
    for what, values in (("", boxes), ("scores ", scores)):
        if values is not None and not np.isfinite(np.ma.filled(values[present], np.nan)).all():
            raise ValueError(f"{named}: {what}{shown(values)} is not finite, or masked")
    kept = None if scores is None else np.ma.getdata(scores)
    return DetectedBoxes(np.ma.getdata(boxes), kept, classes), present
