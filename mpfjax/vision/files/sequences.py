"""The folder of a sequence: its metadata, files of detections, and ground truth."""

import configparser
import re
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from mpfjax.checks import checked
from mpfjax.metrics.tracking_scores import IGNORED_OBJECT, IGNORED_REGION, UNSCORED_OBJECT
from mpfjax.vision.files.boxes import TRACK_COLUMNS, TRACK_FORM, read_rows, read_text

# MOTChallenge's classes: 1 are pedestrians; a track of one of these is no false positive. Rows of
# the others (vehicles, occluders) only take part when boxes are matched.
_CLASSES = range(1, 14)
_PEDESTRIAN = 1
_PERSON_ON_VEHICLE, _VEHICLE, _STATIC_PERSON, _DISTRACTOR, _REFLECTION = 2, 6, 7, 8, 12
_NOT_TO_BLAME = {_PERSON_ON_VEHICLE, _STATIC_PERSON, _DISTRACTOR, _REFLECTION}
# Their names where a labels.txt has them, from 1 on.
_LABELS = [
    *("pedestrian", "person on vehicle", "car", "bicycle", "motorbike", "non motorized vehicle"),
    *("static person", "distractor", "occluder", "occluder on the ground", "occluder full"),
    "reflection",
]
# VisDrone's categories: the first are regions without labels, the last other objects.
_CATEGORIES = range(12)
_KITTI_HEIGHT = 25.0
_FLAG, _CLASS = 6, 7
_KNOWN = {"motchallenge": _CLASSES, "visdrone": _CATEGORIES}
Format = Literal["motchallenge", "visdrone", "uavdt", "cvat"]
_INFO = "seqinfo.ini"


class Truth(NamedTuple):
    """The true boxes of a sequence, from `read_truth`, in pixels, (x, y) the top-left corner.

    - `objects`: (s, 6), rows (frame, id, x, y, w, h) of the objects to be tracked.
    - `ignored`: (r, 6), rows (frame, kind, x, y, w, h) of what is not scored, with the kinds of
      `mpfjax.metrics.tracking_scores.remove_ignored`.
    - `min_height`: an unmatched tracked box of at most this height is not scored; 0 for none.
    """

    objects: Float[np.ndarray, "s 6"]
    ignored: Float[np.ndarray, "r 6"]
    min_height: float = 0.0

    def between(self, first: int, last: float = np.inf) -> "Truth":
        """The rows of frames `first` to `last`, both included."""
        tables = self.objects, self.ignored
        objects, ignored = (rows[(first <= rows[:, 0]) & (rows[:, 0] <= last)] for rows in tables)
        return Truth(objects, ignored, self.min_height)


@checked
def read_truth(path: str | Path, *, format: Format | None = None) -> Truth:
    """Read the ground truth of a sequence, and what its benchmark removes before scoring.

    `path` is a file, or a folder with `gt.txt` or `gt/gt.txt`. Rows are frame,id,x,y,w,h,flag and
    up to three more columns, frames count from 1, and rows whose flag is 0 do not count. The
    meaning of the further columns is determined by `format`, or else by the files:

    - "motchallenge": the eighth column is a class. Only pedestrians (class 1) count; people on
      vehicles, static persons, distractors and reflections are ignored objects, in MOT20 other
      vehicles as well; the rest is unscored. It is assumed if `labels.txt` contains the benchmark's
      own classes, if the sequence is called MOT16, MOT17 or MOT20, or if there are nine columns,
      the last of which is a visibility, and the classes are its own, pedestrians among them.
    - "visdrone": ten columns, the eighth a category. Categories 1 to 10 count; 0 and 11, and rows
      whose seventh column is 0, are ignored regions. It is assumed if the ten columns are its own.
    - "uavdt": all rows count, and those of the `..._gt_ignore.txt` next to it are ignored regions.
      It is assumed for files that are called `..._gt_whole.txt`, or M0000_gt.txt with any number.
    - "cvat": classes are those of `labels.txt` next to it, and all of them count. It is assumed if
      there is such a file, and no other format is recognised.

    An `ignore.txt` next to it adds rows frame,kind,x,y,w,h of kind 1, an ignored object, or 2, an
    ignored region. The start of the sequence's name in `seqinfo.ini`, or else of the folder's,
    determines the benchmark: "MOT20..." ignores one more class, "kitti..." has a `min_height` of 25
    pixels.

    Raises `ValueError` for a line that cannot be read, naming the file and the line, and for a file
    without any row; `FileNotFoundError` if there is none. Use it with `multi_object_scores`. For
    the rows of a tracker use `read_tracks`.
    """
    path = _truth_file(Path(path))
    rows = read_rows(path, TRACK_FORM, TRACK_COLUMNS)
    folder = path.parent.parent if path.parent.name == "gt" else path.parent
    name = (read_sequence_info(folder).name or folder.resolve().name).lower()
    table = np.full((len(rows), TRACK_COLUMNS.stop - 1), np.nan)
    for here, row in zip(table, rows.values(), strict=True):
        here[: len(row)] = row
    format = _format_of(path, name, table) if format is None else format
    boxes, counts, ignored = table[:, :6], table[:, _FLAG] != 0, np.zeros((0, 6))
    classes, numbers = table[:, _CLASS], _KNOWN.get(format)
    if numbers is not None and not np.isin(classes, numbers).all():
        raise ValueError(f"{path}: column 8 is no class from {numbers[0]} to {numbers[-1]}")
    if format == "motchallenge":
        kinds = _NOT_TO_BLAME | ({_VEHICLE} if name.startswith("mot20") else set())
        counts &= classes == _PEDESTRIAN
        # In the order of the file, by which TrackEval breaks ties.
        ignored = _as_ignored(boxes[~counts], UNSCORED_OBJECT)
        ignored[np.isin(classes, sorted(kinds))[~counts], 1] = IGNORED_OBJECT
    elif format == "visdrone":
        counts &= np.isin(classes, _CATEGORIES[1:-1])
        ignored = _as_ignored(boxes[~counts], IGNORED_REGION)
    elif format == "uavdt":
        counts[:] = True
        beside = path.with_name(re.sub(r"gt(_whole)?\.txt$", "gt_ignore.txt", path.name))
        if beside != path and beside.is_file():
            regions = read_rows(beside, TRACK_FORM, range(6, TRACK_COLUMNS.stop), holds=None)
            ignored = _as_ignored([row[:6] for row in regions.values()], IGNORED_REGION)
    for number in np.array(list(rows))[counts & (boxes[:, 1] < 0)]:
        raise ValueError(f"{path}, line {number}: an object without an id, which is at least 0")
    ignored = np.concatenate([ignored, _ignore_file(path.parent / "ignore.txt")])
    return Truth(boxes[counts], ignored, _KITTI_HEIGHT if name.startswith("kitti") else 0.0)


def _truth_file(path: Path) -> Path:
    if not path.is_dir():
        return path
    for name in ("gt.txt", "gt/gt.txt", "gt_whole.txt"):
        if (path / name).is_file():
            return path / name
    raise FileNotFoundError(f"{path}: holds neither gt.txt nor gt/gt.txt")


def _format_of(path: Path, name: str, table: Float[np.ndarray, "r 10"]) -> Format:
    """What the files and their columns say that they are."""
    if re.fullmatch(r".*gt_whole|M\d+_gt", path.stem):
        return "uavdt"
    labels = path.with_name("labels.txt")
    if labels.is_file():
        lines = [line.strip().lower() for line in read_text(labels).splitlines() if line.strip()]
        return "motchallenge" if lines[: len(_LABELS)] == _LABELS else "cvat"
    flags, classes, truncations, occlusions = table[:, _FLAG:].T
    has_classes = np.isin(classes, _CLASSES).all() and np.any(classes == _PEDESTRIAN)
    if has_classes and re.match(r"mot(16|17|20)", name):
        return "motchallenge"
    if not np.isin(flags, [0, 1]).all():
        return "cvat"
    if np.isnan(occlusions).all() and has_classes:
        return "motchallenge" if ((truncations >= 0) & (truncations <= 1)).all() else "cvat"
    few = np.isin(truncations, range(2)) & np.isin(occlusions, range(3))
    return "visdrone" if (few & np.isin(classes, _CATEGORIES)).all() else "cvat"


def _as_ignored(boxes: Any, kind: int) -> Float[np.ndarray, "r 6"]:
    """Rows frame,id,x,y,w,h as rows frame,kind,x,y,w,h."""
    ignored = np.array(boxes, float).reshape(-1, 6)
    ignored[:, 1] = kind
    return ignored


def _ignore_file(path: Path) -> Float[np.ndarray, "r 6"]:
    """The rows of an ignore.txt; none where there is no such file."""
    form = "frame,kind,x,y,w,h with the kind 1 or 2"
    rows = read_rows(path, form, range(6, 7), holds=None) if path.is_file() else {}
    return np.array(list(rows.values())).reshape(-1, 6)


class SequenceInfo(NamedTuple):
    """The contents of a MOTChallenge `seqinfo.ini`; None for missing entries.

    - `name`: of the sequence; `frame_rate`: frames a second; `length`: the number of frames.
    - `size`: height and width of a frame, in pixels.
    """

    name: str | None = None
    frame_rate: float | None = None
    length: int | None = None
    size: tuple[int, int] | None = None


def read_sequence_info(*folders: Path) -> SequenceInfo:
    """Read the `seqinfo.ini` in the first of these folders that has one.

    Keys may have any case. Raises `ValueError` with the file and the key for what is no number.
    """
    path = next((folder / _INFO for folder in folders if (folder / _INFO).is_file()), None)
    if path is None:
        return SequenceInfo()
    parser = configparser.ConfigParser(
        interpolation=None, strict=False, allow_no_value=True, inline_comment_prefixes=("#", ";")
    )
    parser.optionxform = lambda optionstr: re.sub(r"[\W_]", "", optionstr.lower())
    # Keys before the first section, and indented ones, are keys too.
    lines = ["[Sequence]", *(line.strip() for line in read_text(path).splitlines())]
    keys = ("framerate", "seqlength", "imheight", "imwidth")
    try:
        parser.read_string("\n".join(lines))
        values = {key: value for name in parser.sections() for key, value in parser.items(name)}
        rate, length, height, width = (float(values.get(key) or 0) for key in keys)
    except (configparser.Error, ValueError) as error:
        raise ValueError(f"{path}: {error}") from error
    return SequenceInfo(
        name=values.get("name") or None,
        frame_rate=rate if 0 < rate < np.inf else None,
        length=int(length) if 0 < length < np.inf else None,
        size=(int(height), int(width)) if 0 < height * width < np.inf else None,
    )


def detection_files(folder: Path) -> list[Path]:
    """The files of detections of a sequence: det*.txt in its folder, and in `det` there."""
    return sorted(folder.glob("det*.txt")) + sorted(folder.glob("det/det*.txt"))


def last_frame(info: SequenceInfo, *rows: np.ndarray) -> int:
    """The number of the last frame where there are no images: as given, or the last of any rows."""
    if info.length is not None:
        return info.length
    return int(max((table[:, 0].max() for table in rows if len(table)), default=0))
