"""What may be given as detections: rows of a file, boxes frame by frame, or a detector to call."""

import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from mpfjax.arrays import to_rows
from mpfjax.checks import is_series, saying, shown, warn
from mpfjax.vision.files.boxes import read_detections
from mpfjax.vision.tracking.detections import Detections

_NAMES = {4: "frame,id,x,y,w,h,score", 2: "frame,id,x,y,score"}
# A tracker that is made for rows of detections has room for at most so many objects.
LEAST_ROOM, MOST_ROOM = 24, 1024
_END = object()


class Rows:
    """Rows (frame, id, x, y, w, h, score) as MOTChallenge files have them; the id is not read.

    Where there are eight columns, the last is the class, as `read_detections` has it. Points have
    two coordinates in the place of four, without w and h.

    Frames count from 1; in a frame without rows nothing is there.
    """

    def __init__(self, rows: Float[np.ndarray, "r columns"], *, coordinates: int = 4) -> None:
        self._score = 2 + coordinates
        most = self._score + (4 if coordinates == 4 else 2)
        if rows.ndim != 2 or not (rows.size == 0 or self._score <= rows.shape[1] <= most):
            raise ValueError(f"detections: shape {rows.shape} is not of {_NAMES[coordinates]}")
        rows = rows if rows.size else np.zeros((0, self._score + 1))
        rows = to_rows(rows.shape[1], "detections", rows)
        bad = ~np.isfinite(rows[:, 0]) | (rows[:, 0] % 1 != 0) | (rows[:, 0] < 1)
        for number in np.flatnonzero(bad)[:1]:
            named = f"detections: row {number}, {shown(rows[number])},"
            raise ValueError(f"{named} is of no frame; they count from 1")
        self._rows = rows[np.argsort(rows[:, 0], kind="stable")]
        self.frames = self._rows[:, 0].astype(int)

    def get(self, number: int) -> Detections:
        """The detections of a frame."""
        begin, end = np.searchsorted(self.frames, [number, number + 1])
        rows = self._rows[begin:end]
        at, width = self._score, rows.shape[1]
        of_kind = rows[:, at + 1] if width == at + 2 else None
        return Detections(rows[:, 2:at], rows[:, at] if width > at else None, of_kind)

    def most_objects(self) -> int:
        """One and a half times the number of detections in all but the fullest frames."""
        counts = np.unique(self.frames, return_counts=True)[1]
        usual = float(np.quantile(counts, 0.95)) if len(counts) else 0.0
        return int(np.clip(8 * np.ceil(1.5 * usual / 8), LEAST_ROOM, MOST_ROOM))


Detector = Rows | Callable[[Any], Any] | Mapping[int, Any] | Iterable[Any]


def as_detector(detections: Any, coordinates: int) -> Detector:
    """Files and arrays as rows; a callable, a mapping and an iterable as they are.

    Raises `ValueError` for anything else, and for rows that are not in MOTChallenge's form.
    """
    if isinstance(detections, str | Path):
        detections = read_detections(detections, points=coordinates == 2)
    if isinstance(detections, np.ndarray | jax.Array):
        return Rows(np.asanyarray(detections), coordinates=coordinates)
    is_detector = callable(detections) and not isinstance(detections, type)
    if is_detector or isinstance(detections, Rows | Mapping) or is_series(detections):
        return detections
    raise ValueError(f"detections: {shown(detections)} is no detector, rows, file or boxes a frame")


def _frames_of(detector: Detector) -> np.ndarray | None:
    """The frames of detections that have numbers, in order; None for other detections."""
    if isinstance(detector, Rows):
        return detector.frames
    return np.array(sorted(detector), int) if isinstance(detector, Mapping) else None


def first_step(detector: Detector, first: int | None, frames_per_second: float) -> int:
    """The number of the first frame where there are no pixels: that of the first row, if not given.

    Frame numbers decide how many steps there are: those of several clips, or times, would make many
    of nothing. Raises `ValueError` for a row that comes more than a minute after the one before it.
    """
    frames = _frames_of(detector)
    if frames is None or not len(frames):
        return first or 1
    first, most = first or int(frames[0]), int(60 * frames_per_second)
    before = np.append(first, frames[:-1])
    late = np.flatnonzero(frames - before > most)
    if len(late):
        at = late[0]
        raise ValueError(
            f"detections: frame {frames[at]} comes {frames[at] - before[at]} frames after frame"
            f" {before[at]}, and a minute has {most}; number the frames one by one, and track apart"
            " what is far apart"
        )
    return first


def observe(
    stills: Iterator[np.ndarray | None] | None, detector: Detector, first: int
) -> Iterator[tuple[int, np.ndarray | None, Any]]:
    """Number, pixels and detections of each frame; None where no detector ran.

    Warns of detections after the last frame.
    """
    frames, number = _frames_of(detector), first - 1
    is_numbered = isinstance(detector, Rows | Mapping)
    coming = iter(()) if is_numbered or callable(detector) else iter(detector)
    if stills is not None:
        steps = enumerate(stills, first)
    elif frames is None:
        steps = zip(itertools.count(first), itertools.repeat(None))
    else:
        steps = zip(range(first, frames.max(initial=0) + 1), itertools.repeat(None))

    def detect(number: int, still: np.ndarray | None) -> Any:
        if isinstance(detector, Rows | Mapping):
            return detector.get(number)
        if not callable(detector):
            return next(coming, _END)
        if still is None:  # it cannot be decoded
            return None
        with saying(f"detections: raised by the detector at frame {number}"):
            return detector(still)

    for number, still in steps:
        output = detect(number, still)
        if output is _END and still is None:
            return
        if output is _END:
            raise ValueError(f"detections: end before the frames do, at frame {number}")
        yield number, still, output
    if frames is not None and (late := np.sum(frames > number)):
        warn(f"detections: {late} lie in frames after the last, {number}, and were left out")
    if next(coming, _END) is not _END:
        warn(f"detections: go on after the last frame, {number}, and were left out")
