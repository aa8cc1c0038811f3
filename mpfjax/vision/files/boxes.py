"""Boxes as users and MOTChallenge files write them: (x, y) of the top-left corner, w, h."""

import codecs
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float

from mpfjax.checks import check_type, check_whole, shown, to_rows

_COLUMNS = range(7, 11)


def parse_box(text: str, argument: str = "box") -> Float[np.ndarray, "4"]:
    """Read "x,y,w,h" in pixels. Raises `ValueError` naming `argument` for any other text."""
    check_type(str, "a text x,y,w,h", **{argument: text})
    try:
        box = np.array([float(part) for part in text.split(",")])
    except ValueError:
        box = np.zeros(0)
    if box.shape != (4,) or not np.all(np.isfinite(box)):
        raise ValueError(f"{argument}: {text!r} is not four numbers x,y,w,h")
    return box


def check_boxes(
    boxes: Float[np.ndarray, "k 4"], height: int, width: int, argument: str = "boxes"
) -> None:
    """Raise `ValueError` for a box without area, or wholly outside a frame of this size.

    Also for boxes that are not four finite numbers, and a size that is not a whole number.
    """
    check_whole(height=height, width=width)
    for x, y, w, h in to_rows(4, argument, boxes).tolist():
        named = f"{argument}: {x:g},{y:g},{w:g},{h:g}"
        if not np.all(np.isfinite([x, y, w, h])):
            raise ValueError(f"{named} is not finite")
        if not (w > 0 and h > 0):
            raise ValueError(f"{named} has no area")
        # With less than a pixel inside, it may hold no pixel's centre, and so no colour to track.
        if not (x + w >= 1 and y + h >= 1 and x <= width - 1 and y <= height - 1):
            raise ValueError(f"{named} lies outside the first frame, {width} x {height}")


def centred(boxes: Float[np.ndarray, "k 4"]) -> Float[np.ndarray, "k 4"]:
    """(x, y, w, h) with (x, y) moved from the top-left corner to the centre."""
    boxes = np.asarray(boxes, float)
    return np.concatenate([boxes[:, :2] + boxes[:, 2:] / 2, boxes[:, 2:]], axis=1)


def top_left(boxes: Float[np.ndarray, "k 4"]) -> Float[np.ndarray, "k 4"]:
    """(x, y, w, h) with (x, y) moved from the centre to the top-left corner."""
    boxes = np.asarray(boxes, float)
    return np.concatenate([boxes[:, :2] - boxes[:, 2:] / 2, boxes[:, 2:]], axis=1)


def read_tracks(path: str | Path) -> Float[np.ndarray, "rows 6"]:
    """Read a MOTChallenge file into rows (frame, id, x, y, w, h), (x, y) the top-left corner.

    Frames count from 1. Every row is read, and further columns are ignored. For a ground truth,
    where flags and classes say which rows count, use `read_truth`. Raises `ValueError` for a line
    that cannot be read, with the file and the line, and for a file without any box. Warns where the
    seventh column is that of a ground truth of which some rows do not count.
    """
    check_type((str, Path), "a path", path=path)
    rows = [parse_track(path, number, line) for number, line in numbered_lines(path)]
    if not rows:
        raise ValueError(f"{path}: holds no boxes")
    flags = [row[6] for row in rows]
    if set(flags) == {0.0, 1.0}:
        warnings.warn(
            f"{path}: {flags.count(0.0)} rows are flagged 0, as a ground truth flags what does not"
            " count; read_truth leaves them out",
            RuntimeWarning,
            stacklevel=2,
        )
    return np.array([row[:6] for row in rows])


def read_detections(path: str | Path) -> Float[np.ndarray, "rows columns"]:
    """Read a MOTChallenge file of detections into rows (frame, id, x, y, w, h, score).

    The id, -1 in such files, has no meaning. For a file of six columns, without scores, the result
    has six columns too. Raises `ValueError` with the file and the line for a row that cannot be
    parsed, holds a number that is not finite, lies in a frame before 1, or has a score where other
    rows have none; and for a file without any detection.
    """
    check_type((str, Path), "a path", path=path)
    rows: list[list[float]] = []
    for number, line in numbered_lines(path):
        row = _parse_detection(path, number, line)
        if row[0] < 1:
            raise ValueError(
                f"{path}, line {number}: lies in frame {row[0]:.0f}, and frames count from 1"
            )
        if rows and len(row) != len(rows[0]):
            raise ValueError(
                f"{path}, line {number}: has a score, or none, unlike the lines before it"
            )
        rows.append(row)
    if not rows:
        raise ValueError(f"{path}: holds no detections")
    return np.array(rows)


def write_tracks(path: str | Path, rows: Float[np.ndarray, "rows 6"]) -> None:
    """Write rows (frame, id, x, y, w, h) in MOTChallenge form, in the order of the frames.

    Raises `ValueError` for rows that `read_tracks` could not read: rows that are not six finite
    numbers, or with a frame or an id that is not a whole number from 0 on.
    """
    check_type((str, Path), "a path", path=path)
    rows = to_rows(6, "rows", rows)
    for row in rows:
        if not np.all(np.isfinite(row)) or np.any(row[:2] < 0) or np.any(row[:2] % 1):
            raise ValueError(f"rows: {shown(row)} is not frame,id,x,y,w,h")
    ordered = rows[np.lexsort((rows[:, 1], rows[:, 0]))]
    Path(path).write_text(format_tracks(ordered), encoding="utf-8")


def format_tracks(rows: Float[np.ndarray, "rows 6"]) -> str:
    """The lines of rows (frame, id, x, y, w, h) in MOTChallenge form."""
    lines = [
        f"{int(frame)},{int(track)},{x:.3f},{y:.3f},{w:.3f},{h:.3f},1,-1,-1,-1\n"
        for frame, track, x, y, w, h in rows
    ]
    return "".join(lines)


def boxes_of_frame(rows: Float[np.ndarray, "rows 6"], frame: int) -> dict[int, np.ndarray]:
    """The boxes of one frame by their id."""
    return {int(row[1]): row[2:6] for row in rows if row[0] == frame}


def numbered_lines(path: str | Path) -> Iterator[tuple[int, str]]:
    """The lines of a text file that are not blank, and their numbers from 1.

    A byte order mark, which Windows puts before UTF-8 and UTF-16, is no part of the text.
    """
    content = Path(path).read_bytes()
    wide = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    text = content.decode("utf-16" if wide else "utf-8-sig", errors="replace")
    return ((number, line) for number, line in enumerate(text.split("\n"), 1) if line.strip())


def parse_track(path: str | Path, number: int, line: str) -> list[float]:
    """The numbers of a row frame,id,x,y,w,h,... of seven to ten columns; further ones may be NaN.

    Raises `ValueError` with the file and the line for any other text.
    """
    fields = line.split(",")
    try:
        values = [float(field) for field in fields[:6]]
        whole = all(value == int(value) and value >= 0 for value in values[:2])
    except (ValueError, OverflowError):
        values, whole = [], False
    if len(fields) not in _COLUMNS or not whole or not np.all(np.isfinite(values)):
        raise ValueError(
            f"{path}, line {number}: {shown(line.strip())} is not frame,id,x,y,w,h and one to four"
            " more columns"
        )
    return values + [_number(field) for field in fields[6:]]


def _number(field: str) -> float:
    try:
        return float(field)
    except ValueError:
        return np.nan


def _parse_detection(path: str | Path, number: int, line: str) -> list[float]:
    fields = line.split(",")
    try:
        values = [float(field) for field in fields[:7]]
        whole = values[0] == int(values[0])
    except (ValueError, OverflowError):
        values, whole = [], False
    if not 6 <= len(fields) <= 10 or not whole or not np.all(np.isfinite(values)):
        raise ValueError(
            f"{path}, line {number}: {shown(line.strip())} is not frame,id,x,y,w,h,score and up to"
            " three more columns"
        )
    return values
