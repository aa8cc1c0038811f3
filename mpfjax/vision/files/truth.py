"""The ground truth of a sequence: the objects to be tracked, and what is not scored."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from mpfjax.checks import check_type, shown
from mpfjax.metrics.tracking_scores import IGNORED_OBJECT, IGNORED_REGION, UNSCORED_OBJECT
from mpfjax.vision.files.boxes import numbered_lines, parse_track
from mpfjax.vision.files.sequences import read_sequence_info

# MOTChallenge's classes: 1 are pedestrians; a track of one of these is no false positive. Rows of
# the others (vehicles, occluders) only take part when boxes are matched.
_CLASSES = range(1, 14)
_PEDESTRIAN = 1
_PERSON_ON_VEHICLE, _VEHICLE, _STATIC_PERSON, _DISTRACTOR, _REFLECTION = 2, 6, 7, 8, 12
_NOT_TO_BLAME = {_PERSON_ON_VEHICLE, _STATIC_PERSON, _DISTRACTOR, _REFLECTION}
_KITTI_HEIGHT = 25.0
_FLAG, _CLASS = 6, 7


class Truth(NamedTuple):
    """The true boxes of a sequence, from `read_truth`, in pixels, (x, y) the top-left corner.

    - `objects`: (s, 6), rows (frame, id, x, y, w, h) of the objects to be tracked.
    - `ignored`: (r, 6), rows (frame, kind, x, y, w, h) of what is not scored, with the kinds of
      `mpfjax.metrics.remove_ignored`.
    - `min_height`: a tracked box of at most this height that matches nothing is not scored; 0 for
      none.
    """

    objects: Float[np.ndarray, "s 6"]
    ignored: Float[np.ndarray, "r 6"]
    min_height: float = 0.0

    def between(self, first: int, last: float = np.inf) -> "Truth":
        """The rows of frames `first` to `last`, both included."""
        objects, ignored = (
            rows[(first <= rows[:, 0]) & (rows[:, 0] <= last)]
            for rows in (self.objects, self.ignored)
        )
        return Truth(objects, ignored, self.min_height)


def read_truth(path: str | Path) -> Truth:
    """Read the ground truth of a sequence, and what its benchmark removes before scoring.

    `path` is a MOTChallenge file, or a folder with `gt.txt` or `gt/gt.txt`. Rows are
    frame,id,x,y,w,h,flag and up to three more columns. Those whose flag is 0 do not count. Where
    the eighth column holds MOTChallenge's classes, whole numbers from 1 to 13 in every row, only
    pedestrians (class 1) count; people on vehicles, static persons, distractors and reflections are
    ignored objects, in MOT20 other vehicles as well; the rest is unscored. If there is not a single
    pedestrian, the classes are not MOTChallenge's, and all rows with a flag count.

    An `ignore.txt` beside it adds rows frame,kind,x,y,w,h of kind 1, an ignored object, or 2, an
    ignored region. The start of the sequence's name in `seqinfo.ini`, or else of the folder's,
    tells the benchmark: "MOT20..." ignores one more class, "kitti..." has a `min_height` of 25
    pixels.

    Raises `ValueError` for a line that cannot be read, naming the file and the line, and for a file
    without any row; `FileNotFoundError` where there is none. Use it with `multi_object_scores`. For
    the rows of a tracker use `read_tracks`.
    """
    check_type((str, Path), "a path", path=path)
    path = _truth_file(Path(path))
    rows = [parse_track(path, number, line) for number, line in numbered_lines(path)]
    if not rows:
        raise ValueError(f"{path}: holds no boxes")
    boxes = np.array([row[:6] for row in rows])
    counted = np.array([row[_FLAG] != 0 for row in rows])
    ignored = boxes[:0]
    name = _name_of(path).lower()
    classes = _classes(rows)
    if classes is not None:
        kinds = _NOT_TO_BLAME | ({_VEHICLE} if name.startswith("mot20") else set())
        not_to_blame = np.isin(classes, sorted(kinds))
        counted &= classes == _PEDESTRIAN
        # In the order of the file, by which TrackEval breaks ties.
        ignored = boxes[~counted]
        ignored[:, 1] = np.where(not_to_blame, IGNORED_OBJECT, UNSCORED_OBJECT)[~counted]
    ignored = np.concatenate([ignored, _ignore_file(path.parent / "ignore.txt")])
    min_height = _KITTI_HEIGHT if name.startswith("kitti") else 0.0
    return Truth(boxes[counted], ignored, min_height)


def _truth_file(path: Path) -> Path:
    if not path.is_dir():
        return path
    for place in (path, path / "gt"):
        if (place / "gt.txt").is_file():
            return place / "gt.txt"
    raise FileNotFoundError(f"{path}: holds neither gt.txt nor gt/gt.txt")


def _classes(rows: list[list[float]]) -> np.ndarray | None:
    """The class of every row; None where the eighth column is missing or means something else."""
    if any(len(row) <= _CLASS for row in rows):
        return None
    classes = np.array([row[_CLASS] for row in rows])
    if not np.isin(classes, _CLASSES).all() or not np.any(classes == _PEDESTRIAN):
        return None
    return classes


def _ignore_file(path: Path) -> Float[np.ndarray, "r 6"]:
    """The rows of an ignore.txt; none where there is no such file."""
    if not path.is_file():
        return np.zeros((0, 6))
    rows = []
    for number, line in numbered_lines(path):
        fields = line.split(",")
        try:
            row = [float(field) for field in fields]
        except ValueError:
            row = []
        known = len(row) == 6 and row[1] in (IGNORED_OBJECT, IGNORED_REGION)
        if not known or not np.all(np.isfinite(row)) or row[0] % 1:
            raise ValueError(
                f"{path}, line {number}: {shown(line.strip())} is not frame,kind,x,y,w,h with the"
                " kind 1 or 2"
            )
        rows.append(row)
    return np.array(rows).reshape(-1, 6)


def _name_of(truth: Path) -> str:
    """The name in the `seqinfo.ini` of the sequence, or that of its folder."""
    folder = truth.parent.parent if truth.parent.name == "gt" else truth.parent
    return read_sequence_info(folder).name or folder.resolve().name
