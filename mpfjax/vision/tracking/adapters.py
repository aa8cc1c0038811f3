"""What may be given as detections: rows of a file, boxes frame by frame, or a detector to call."""

import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from mpfjax.arrays import (
    to_rows,
)
from mpfjax.checks import CountOrZero, checked, is_series, saying, shown, warn
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

    Frames count from 1; in a frame without rows nothing is there. Without pixels `last` is the last
    frame, by default that of the last row.
    """

    @checked
    def __init__(
        self,
        rows: Float[np.ndarray, "r columns"],
        *,
        last: CountOrZero | None = None,
        coordinates: int = 4,
    ) -> None:
        self._score = 2 + coordinates
        most = self._score + (4 if coordinates == 4 else 2)
        if rows.ndim != 2 or not (rows.size == 0 or self._score <= rows.shape[1] <= most):
            raise ValueError(f"detections: shape {rows.shape} is not of {_NAMES[coordinates]}")
        rows = rows if rows.size else np.zeros((0, self._score + 1))
        rows = to_rows(rows.shape[1], "detections", rows)
        bad = ~np.isfinite(rows[:, 0]) | (rows[:, 0] % 1 != 0) | (rows[:, 0] < 1)
        for number in np.flatnonzero(bad)[:1]:
            row = shown(rows[number])
            raise ValueError(f"detections: row {number}, {row}, is of no frame; they count from 1")
        # Which row each is, in the order of the frames.
        self.places = np.argsort(rows[:, 0], kind="stable")
        self._rows = rows[self.places]
        self.frames = self._rows[:, 0].astype(int)
        self.is_limited = last is not None
        self.last = int(self.frames.max(initial=0)) if last is None else last

    def of_frame(self, number: int) -> Detections:
        """The detections of a frame."""
        begin, end = np.searchsorted(self.frames, [number, number + 1])
        rows = self._rows[begin:end]
        at, width = self._score, rows.shape[1]
        of_kind = rows[:, at + 1] if width == at + 2 else None
        return Detections(rows[:, 2:at], rows[:, at] if width > at else None, of_kind)

    def num_after(self, last: int) -> int:
        """How many rows lie in later frames."""
        return int(np.sum(self.frames > last))

    def most_objects(self) -> int:
        """One and a half times the number of detections in all but the fullest frames."""
        counts = np.unique(self.frames, return_counts=True)[1]
        usual = float(np.quantile(counts, 0.95)) if len(counts) else 0.0
        return int(np.clip(8 * np.ceil(1.5 * usual / 8), LEAST_ROOM, MOST_ROOM))


Detector = Rows | Callable[[Any], Any] | Mapping[int, Any] | Iterable[Any]


def as_detector(detections: Any, coordinates: int = 4) -> Detector:
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


def first_step(detector: Detector, first: int | None, frames_per_second: float) -> int:
    """The number of the first frame where there are no pixels: that of the first row, if not given.

    Frame numbers decide how many steps there are: those of several clips, or times, would make many
    of nothing. Raises `ValueError` for a row that comes more than a minute after the one before it,
    unless the last frame is given.
    """
    if not isinstance(detector, Rows | Mapping):
        return first or 1
    is_rows = isinstance(detector, Rows)
    frames = detector.frames if is_rows else np.array(sorted(detector), int)
    first = first or int(frames[0] if len(frames) else 1)
    most, gaps = int(60 * frames_per_second), np.diff(frames, prepend=first)
    late = [] if is_rows and detector.is_limited else np.flatnonzero(gaps > most)
    for at in late[:1]:
        row = f"row {detector.places[at]}, of " if is_rows else ""
        before = "what is before it" if at else f"frame {first}, the first"
        raise ValueError(
            f"detections: {row}frame {frames[at]}, comes {gaps[at]} frames after {before}, and a"
            f" minute has {most}; number the frames one by one, and track apart what is far apart"
        )
    return first


def observe(
    stills: Iterator[np.ndarray | None] | None, detector: Detector, first: int, coordinates: int = 4
) -> Iterator[tuple[int, np.ndarray | None, Detections | None]]:
    """Number, pixels and detections of each frame; None where no detector ran.

    Warns of detections after the last frame.
    """
    numbers, coming, number = itertools.count(first), iter(()), first - 1
    if isinstance(detector, Rows | Mapping):
        last = detector.last if isinstance(detector, Rows) else max(detector, default=0)
        numbers = range(first, last + 1)
    elif not callable(detector):
        coming = iter(detector)

    def detect(number: int, still: np.ndarray | None) -> Any:
        if isinstance(detector, Rows):
            return detector.of_frame(number)
        if isinstance(detector, Mapping):
            return detector.get(number)
        if not callable(detector):
            return next(coming, _END)
        if still is None:  # it cannot be decoded
            return None
        with saying(f"detections: raised by the detector at frame {number}"):
            return detector(still)

    frames = zip(numbers, itertools.repeat(None)) if stills is None else enumerate(stills, first)
    for number, still in frames:
        output = detect(number, still)
        if output is _END and still is None:
            return
        if output is _END:
            raise ValueError(f"detections: end before the frames do, at frame {number}")
        named = f"detections: frame {number}"
        yield number, still, None if output is None else Detections.of(output, named, coordinates)
    if isinstance(detector, Rows) and (late := detector.num_after(number)):
        warn(f"detections: {late} lie in frames after the last, {number}, and were left out")
    if next(coming, _END) is not _END or (isinstance(detector, Mapping) and number < last):
        warn(f"detections: go on after the last frame, {number}, and were left out")
