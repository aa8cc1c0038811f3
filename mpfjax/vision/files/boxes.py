"""Boxes in the form of MOTChallenge files: (x, y) of the top-left corner, w, h."""

import codecs
import json
import re
from pathlib import Path

import numpy as np
from jaxtyping import Float

from mpfjax.arrays import to_rows
from mpfjax.checks import shown

_COMMENTS = ("#", "%", "//")
# The names that a header may give to the columns, in lower case and without "_".
_FRAME, _BOX = "(f|t|frame(id|index|idx|number|no)?)", "(bb|bbox|box)?"
_SCORE = "((conf|score|prob|consider).*|flag|mark|valid|active|(not)?ignored?|outofview)"
_HEADER = re.compile(
    rf"{_FRAME},(\w*id|identity|track|target|object),{_BOX}(x|left|x[01]|xmin|xtl|topleftx)"
    rf",{_BOX}(y|top|y[01]|ymin|ytl|toplefty),{_BOX}(w|width),{_BOX}(h|height)(,{_SCORE}(,.*)?)?"
)
_LIKE_A_HEADER = re.compile(f"{_FRAME}(,[^,]*){{5}}")
TRACK_FORM = "frame,id,x,y,w,h and one to four more columns, frames from 1 on"
TRACK_COLUMNS = range(7, 11)


def parse_box(text: str) -> Float[np.ndarray, "4"]:
    """Read the option --box, "x,y,w,h" in pixels. Raises `ValueError` for any other text."""
    box = np.array([_number(part) for part in text.split(",")])
    if box.shape != (4,) or not np.all(np.isfinite(box)):
        raise ValueError(f"--box: {text!r} is not four numbers x,y,w,h")
    return box


def check_boxes(
    boxes: Float[np.ndarray, "k 4"], height: int, width: int, argument: str = "boxes"
) -> Float[np.ndarray, "k 4"]:
    """The boxes as rows of numbers, at least one.

    Raises `ValueError` for none, for a box without area or wholly outside a frame of this size, and
    for what is not four finite numbers.
    """
    rows = to_rows(4, argument, boxes)
    low, sides = rows[:, :2], rows[:, 2:]
    # With less than a pixel inside, it may hold no pixel's centre, and so no colour to track.
    inside = (low + sides >= 1) & (low <= [width - 1, height - 1])
    fits = (inside & (sides > 0)).all(axis=1) & np.isfinite(rows).all(axis=1)
    if not len(rows) or not fits.all():
        wrong = shown(rows[~fits].tolist())
        raise ValueError(f"{argument}: {wrong} have no area in the first frame, {width} x {height}")
    return rows


def to_centre(boxes: Float[np.ndarray, "k 4"]) -> Float[np.ndarray, "k 4"]:
    """(x, y, w, h) with (x, y) moved from the top-left corner to the centre."""
    boxes = np.asarray(boxes, float)
    return np.concatenate([boxes[:, :2] + boxes[:, 2:] / 2, boxes[:, 2:]], axis=1)


def top_left(boxes: Float[np.ndarray, "k n"]) -> Float[np.ndarray, "k n"]:
    """(x, y, w, h) with (x, y) moved from the centre to the top-left corner; points as they are."""
    boxes = np.asarray(boxes, float)
    if boxes.shape[1] == 2:
        return boxes
    return np.concatenate([boxes[:, :2] - boxes[:, 2:] / 2, boxes[:, 2:]], axis=1)


def read_tracks(path: str | Path) -> Float[np.ndarray, "rows 6"]:
    """Read a MOTChallenge file into rows (frame, id, x, y, w, h), (x, y) the top-left corner.

    Frames count from 1. Every row is read, and further columns are ignored. Columns may also be
    separated by tabs, semicolons or blanks; comments, and a header that names these columns, are
    skipped. For a ground truth, in which flags and classes determine which rows count, use
    `read_truth`. Raises `ValueError` for a line that cannot be read, with the file and the line,
    and for a file without any box.
    """
    rows = read_rows(path, TRACK_FORM, TRACK_COLUMNS, least_id=0)
    return np.array([row[:6] for row in rows.values()])


def read_detections(
    path: str | Path, *, with_classes: bool = False, points: bool = False
) -> Float[np.ndarray, "rows columns"]:
    """Read a MOTChallenge file of detections into rows (frame, id, x, y, w, h, score).

    The id, -1 in such files, has no meaning. For a file of six columns, without scores, the result
    has six columns too. With `with_classes` the eighth column is the class, an integer, 0 for none,
    and the result has eight. With `points` the rows are (frame, id, x, y), and a score and a class
    if there are more columns. Separators, comments and headers are as in `read_tracks`. Raises
    `ValueError` with the file and the line for a row that cannot be parsed, has a number that is
    not finite, is in a frame before 1, has a score if other rows have none, or an invalid class;
    and for a file without any detection.
    """
    width, columns = 7, range(6, 11)
    form = "frame,id,x,y,w,h,score and up to three more columns, as the lines before it"
    if with_classes:
        width, columns, form = 8, range(8, 11), "frame,id,x,y,w,h,score,class, from 0 on"
    if points:
        width, columns, form = 6, range(4, 7), "frame,id,x,y,score,class, as the lines before it"
    lines = read_rows(path, form, columns, holds="detections")
    rows = [row[:width] for row in lines.values()]
    for number, row in zip(lines, rows, strict=True):
        is_class = all(each >= 0 and each % 1 == 0 for each in row[5 if points else 7 :])
        if len(row) != len(rows[0]) or not np.all(np.isfinite(row)) or not is_class:
            raise ValueError(f"{path}, line {number}: {shown(row)} is not {form}")
    return np.array(rows)


def write_tracks(path: str | Path, rows: Float[np.ndarray, "rows columns"]) -> None:
    """Write rows (frame, id, x, y, w, h), and a score and a class if there are eight columns.

    They are written in the order of the frames, and the ending of `path` determines the format:
    `.json` is COCO's, with a `track_id` for each annotation; `.csv` has a header; any other is
    MOTChallenge's. Raises `ValueError` for rows that `read_tracks` could not read: rows that are
    not six or eight finite numbers, or with a frame, an id or a class that is not an integer, from
    1, 0 and 0 on.
    """
    width = 8 if np.shape(rows)[-1:] == (8,) else 6
    rows, whole = to_rows(width, "rows", rows), [0, 1, 7] if width == 8 else [0, 1]
    for row in rows:
        counts = row[whole] - np.eye(len(whole))[0]
        if not np.isfinite(row).all() or (counts < 0).any() or (counts % 1).any():
            raise ValueError(f"rows: {shown(row)} is not frame,id,x,y,w,h, or with score,class")
    ordered = rows[np.lexsort((rows[:, 1], rows[:, 0]))]
    form = {".json": _as_coco, ".csv": _as_csv}.get(Path(path).suffix.lower(), format_tracks)
    Path(path).write_text(form(ordered), encoding="utf-8")


def format_tracks(rows: Float[np.ndarray, "rows columns"]) -> str:
    """The lines of rows (frame, id, x, y, w, h), or with score and class, in MOTChallenge form."""
    lines = []
    for frame, track, *box, score, kind in _with_score_and_class(rows):
        places = ",".join(f"{each:.3f}" for each in box)
        lines.append(f"{int(frame)},{int(track)},{places},{score:g},{int(kind) or -1},-1,-1\n")
    return "".join(lines)


def _with_score_and_class(rows: np.ndarray) -> np.ndarray:
    """With a score of 1 and no class, where there are none."""
    return np.hstack([rows, np.tile([1.0, 0.0], (len(rows), 1))])[:, :8]


def _as_csv(rows: np.ndarray) -> str:
    lines = ["frame,id,x,y,w,h,score,class"]
    for frame, track, *numbers, kind in _with_score_and_class(rows).tolist():
        values = ",".join(f"{each:.7g}" for each in numbers)
        lines.append(f"{int(frame)},{int(track)},{values},{int(kind)}")
    return "\n".join([*lines, ""])


def _as_coco(rows: np.ndarray) -> str:
    """One annotation for each row; categories are the classes, of which 0 is that of all others."""
    rows = _with_score_and_class(rows)
    annotations = [
        {
            "id": number, "image_id": int(frame), "category_id": int(kind), "track_id": int(track),
            "bbox": [x, y, w, h], "area": w * h, "iscrowd": 0, "score": score,
        }
        for number, (frame, track, x, y, w, h, score, kind) in enumerate(rows.tolist(), 1)
    ]  # fmt: skip
    frames, kinds = (sorted(set(rows[:, column].astype(int).tolist())) for column in (0, 7))
    images = [{"id": frame, "file_name": f"{frame:06d}.jpg"} for frame in frames]
    categories = [{"id": kind, "name": f"class {kind}" if kind else "object"} for kind in kinds]
    return json.dumps({"images": images, "annotations": annotations, "categories": categories})


def read_rows(
    path: str | Path,
    form: str,
    columns: range,
    *,
    least_id: float = -np.inf,
    holds: str | None = "boxes",
) -> dict[int, list[float]]:
    """The rows of a text file by the numbers of their lines, from 1.

    Columns are parted by commas, semicolons, tabs or blanks. The first six, of which the first is
    a frame from 1 on and the second an id, are finite; further ones may be NaN, also where they are
    no numbers. Blank lines, comments after "#", "%" or "//", and a header that names the columns of
    MOTChallenge are left out. Raises `ValueError` with the file and the line for any other text,
    also for a header of other columns, where `form` says what was expected; and for a file without
    any row, unless `holds`, the name of what it should hold, is None.
    """
    rows: dict[int, list[float]] = {}
    for number, line in enumerate(read_text(path).splitlines(), 1):
        text = line.strip()
        commented = text.startswith(_COMMENTS)
        fields = _fields(text.lstrip("#%/ ") if commented else text.partition("#")[0])
        values = [_number(field) for field in fields]
        names = ",".join(re.sub(r"[\W_]", "", field.lower()) for field in fields)
        is_comment = commented and (rows or not _LIKE_A_HEADER.match(names))
        if is_comment or not fields or (not rows and _HEADER.fullmatch(names)):
            continue
        is_row = len(fields) in columns and np.all(np.isfinite(values[:6]))
        if not is_row or values[0] < 1 or values[0] % 1 or values[1] < least_id:
            raise ValueError(f"{path}, line {number}: {shown(text)} is not {form}")
        rows[number] = values
    if not rows and holds is not None:
        raise ValueError(f"{path}: holds no {holds}")
    return rows


def read_text(path: str | Path) -> str:
    """The text of a file, without the byte order mark that Windows puts before it."""
    content = Path(path).read_bytes()
    wide = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    return content.decode("utf-16" if wide else "utf-8-sig", errors="replace")


def _fields(text: str) -> list[str]:
    """The columns of a line; a separator at its end begins none."""
    mark = next((mark for mark in ",;\t" if mark in text), None)
    fields = [field.strip().strip("\"'") for field in text.split(mark)]
    return fields[:-1] if fields and not fields[-1] else fields


def _number(field: str) -> float:
    try:
        return float(field)
    except ValueError:
        return np.nan
