"""What may be given as detections: rows of a file, boxes frame by frame, or a detector to call."""

import abc
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from mpfjax.checks import check_finite, check_whole, given, is_series, saying, shown
from mpfjax.vision.files.boxes import read_detections
from mpfjax.vision.tracking.detections import to_masked_rows

# MOTChallenge's columns: frame, id, x, y, w, h, and the score, where there is one.
_BOX, _SCORE = slice(2, 6), 6
# A tracker that is made for rows of detections has room for at most so many objects.
LEAST_ROOM, MOST_ROOM = 24, 1024


class DetectedBoxes(NamedTuple):
    """The boxes (x, y, w, h) detected in one frame, and a score for each, or None.

    Boxes with a masked entry are no detections.
    """

    boxes: Float[np.ndarray, "k 4"]
    scores: Float[np.ndarray, " k"] | None


class AbstractDetector(abc.ABC):
    """Finds the detections of a frame, given its number and its pixels."""

    @abc.abstractmethod
    def find(self, number: int, frame: Any) -> DetectedBoxes:
        """Return the detections of a frame; `frame` is None where there are no pixels.

        Raises `StopIteration` where there are no further frames.
        """

    def warn_of_the_rest(self, last: int) -> None:
        """Warn of detections in frames after the last."""
        del last

    def most_objects(self) -> int:
        """How many objects there should be room for, as far as is known beforehand."""
        return LEAST_ROOM


def as_detector(detections: Any, first: int = 1) -> AbstractDetector:
    """Wrap rows, an iterable or a callable as a detector. Frames are numbered from `first` on.

    Raises `ValueError` for anything else, and for rows that are not in MOTChallenge's form.
    """
    if isinstance(detections, AbstractDetector):
        return detections
    if isinstance(detections, str | Path):
        detections = read_detections(detections)
    if isinstance(detections, np.ndarray | jax.Array):
        return Rows(np.asanyarray(detections), first)
    if callable(detections) and not isinstance(detections, type):
        return _Called(detections)
    if is_series(detections):
        return _Streamed(iter(detections))
    raise ValueError(
        f"detections: {shown(detections)} is neither a detector to call with a frame, nor an array"
        " or a file of rows frame,id,x,y,w,h,score, nor the boxes of one frame after the other"
    )


class Rows(AbstractDetector):
    """Rows (frame, id, x, y, w, h, score) as MOTChallenge files have them; the id is not read.

    Frames count from 1. Without pixels `last` is the last frame, by default that of the last row.
    """

    def __init__(
        self, rows: Float[np.ndarray, "r columns"], first: int = 1, last: int | None = None
    ) -> None:
        check_whole(0, first=first, **given(last=last))
        if rows.ndim != 2 or not (rows.size == 0 or 6 <= rows.shape[1] <= 10):
            raise ValueError(
                f"detections: shape {rows.shape} is not that of rows frame,id,x,y,w,h and,"
                " if any, a score"
            )
        rows = rows if rows.size else np.zeros((0, 7))
        rows = to_masked_rows(rows.shape[1], "detections", rows)
        bad = ~np.isfinite(rows[:, : _SCORE + 1]).all(axis=1) | (rows[:, 0] % 1 != 0)
        for number in np.flatnonzero(bad.filled(False))[:1]:
            raise ValueError(
                f"detections: row {number}, {shown(rows.data[number])}, is not finite, or its"
                " frame is no whole number"
            )
        for number in np.flatnonzero((rows[:, 0] < 1).filled(False))[:1]:
            raise ValueError(
                f"detections: row {number} lies in frame {rows[number, 0]:.0f}, and frames count"
                " from 1"
            )
        rows = rows[~np.ma.getmaskarray(rows)[:, 0]]
        self.first = first
        self.frames = rows.data[:, 0].astype(int)
        self.last = int(self.frames.max(initial=0)) if last is None else last
        order = np.argsort(self.frames, kind="stable")
        self._rows, self._sorted = rows[order], self.frames[order]

    def find(self, number: int, frame: Any) -> DetectedBoxes:
        """The rows of this frame."""
        if frame is None and number > self.last:
            raise StopIteration
        begin, end = np.searchsorted(self._sorted, [number, number + 1])
        rows = self._rows[begin:end]
        scores = rows[:, _SCORE] if rows.shape[1] > _SCORE else None
        return DetectedBoxes(rows[:, _BOX], scores)

    def warn_of_the_rest(self, last: int) -> None:
        """Warn of rows after the last frame."""
        late = int(np.sum(self.frames > last))
        if late:
            _warn(f"detections: {late} lie in frames after the last, {last}, and were left out")

    def most_objects(self) -> int:
        """One and a half times the number of detections in all but the fullest frames."""
        counts = np.unique(self.frames, return_counts=True)[1]
        usual = float(np.quantile(counts, 0.95)) if len(counts) else 0.0
        return int(np.clip(8 * np.ceil(1.5 * usual / 8), LEAST_ROOM, MOST_ROOM))


class _Called(AbstractDetector):
    """A user's function from a frame to its boxes, or to a pair of boxes and scores."""

    def __init__(self, function: Callable[[Any], Any]) -> None:
        self.function = function

    def find(self, number: int, frame: Any) -> DetectedBoxes:
        with saying(f"detections: raised by the detector at frame {number}"):
            found = self.function(frame)
        return _as_found(found, number)


class _Streamed(AbstractDetector):
    """A user's iterable of boxes, or of pairs of boxes and scores, one item for each frame."""

    def __init__(self, stream: Iterator[Any]) -> None:
        self.stream = stream

    def find(self, number: int, frame: Any) -> DetectedBoxes:
        try:
            found = next(self.stream)
        except StopIteration:
            if frame is None:
                raise
            raise ValueError(f"detections: end before the frames do, at frame {number}") from None
        return _as_found(found, number)

    def warn_of_the_rest(self, last: int) -> None:
        """Warn where there are detections for one more frame."""
        if next(self.stream, None) is not None:
            _warn(f"detections: go on after the last frame, {last}, and were left out")


class Sieve:
    """Removes detections that cannot be tracked, and warns once of each kind.

    Detections with a score below `min_score` are left out silently; those without area, and those
    wholly outside the frame, with a warning. `frame_size` is height and width, for recordings
    without pixels. Raises `ValueError` for boxes or scores that are not finite, for scores of the
    wrong shape, and where `min_score` is given and there are no scores.
    """

    def __init__(self, min_score: float | None, frame_size: tuple[int, int] | None = None) -> None:
        check_finite(**given(min_score=min_score))
        self.min_score, self.frame_size = min_score, frame_size
        self.once = Once()

    def __call__(
        self, found: DetectedBoxes, number: int, frame: np.ndarray | None
    ) -> tuple[DetectedBoxes, Int[np.ndarray, " k"]]:
        """The detections of a frame that can be tracked, and the row of each among all of them."""
        (boxes, scores), keep = _present(found, number)
        if self.min_score is not None and len(boxes):
            if scores is None:
                raise ValueError(
                    f"min_score: {self.min_score} is given, and detections have no scores"
                )
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
        kept = DetectedBoxes(boxes[keep], None if scores is None else scores[keep])
        return kept, np.flatnonzero(keep).astype(np.int32)


class Once:
    """Warns of each kind of problem once, and not in every frame."""

    def __init__(self) -> None:
        self.said: set[str] = set()

    def warn(self, kind: str, message: str) -> None:
        """Warn, unless a warning of this kind was given before."""
        if kind not in self.said:
            self.said.add(kind)
            _warn(f"{message} (here and wherever else it is so)")


def _as_found(value: Any, number: int) -> DetectedBoxes:
    """A pair of boxes and scores, whether the user gave both or boxes alone."""
    boxes, scores = value if isinstance(value, tuple) and len(value) == 2 else (value, None)
    named = f"detections: frame {number}"
    if boxes is None:
        raise ValueError(f"{named}: None is no array; [] has no detections")
    if scores is not None:
        try:
            scores = np.asanyarray(scores, float).reshape(-1)
        except (TypeError, ValueError) as error:
            raise ValueError(f"{named}: scores {shown(scores)} are no numbers") from error
    return DetectedBoxes(to_masked_rows(4, named, boxes), scores)


def _present(found: DetectedBoxes, number: int) -> tuple[DetectedBoxes, Bool[np.ndarray, " k"]]:
    """The boxes and scores without masks, and which of them are detections."""
    boxes, scores = found
    present = np.logical_not(np.any(np.ma.getmaskarray(boxes), axis=1))
    named = f"detections: frame {number}"
    if scores is not None and len(scores) != len(boxes):
        raise ValueError(f"{named}: {len(scores)} scores for {len(boxes)} boxes")
    for what, values in (("", boxes), ("scores ", scores)):
        if values is not None and not np.isfinite(np.ma.filled(values[present], np.nan)).all():
            raise ValueError(f"{named}: {what}{shown(values)} is not finite, or masked")
    kept = None if scores is None else np.ma.getdata(scores)
    return DetectedBoxes(np.ma.getdata(boxes), kept), present


def _warn(message: str) -> None:
    warnings.warn(message, RuntimeWarning, stacklevel=4)
