"""The truth of a run, and the scores against it."""

import os
import sys
import warnings
from pathlib import Path

import numpy as np

from mpfjax.metrics import multi_object_scores
from mpfjax.metrics.tracking_scores import matches
from mpfjax.vision.files.sequences import Truth, read_truth

SCORES = ("HOTA", "MOTA", "IDF1")
_NO_SCORES = "no HOTA, MOTA and IDF1"
_INNER = ("img", "img1")


def find_truth(source: Path, given: Path | None, first: int, last: int | None) -> Truth | None:
    """The truth that was given, or that of a folder of images, in these frames; None without one.

    A video has no folder, and so no truth unless it is given. Warns of a truth beside the images
    that cannot be read; raises `ValueError` for a given one.
    """
    if given is None and not source.is_dir():
        return None
    folder = Path(os.path.abspath(source))
    try:
        truth = read_truth(given or (folder.parent if folder.name in _INNER else folder))
    except (ValueError, OSError) as error:
        if given is not None:
            raise
        if not isinstance(error, FileNotFoundError):
            warnings.warn(f"{_NO_SCORES}: {error}", RuntimeWarning, stacklevel=2)
        return None
    truth = truth.between(first, last or np.inf)
    if given is not None and not len(truth.objects):
        raise ValueError(f"--truth: {given} has no box in these frames")
    return truth if len(truth.objects) else None


def scores_of(
    rows: np.ndarray, truth: Truth | None, first: int, last: int, drawn: np.ndarray | None
) -> dict[str, float]:
    """HOTA, MOTA and IDF1 of rows in these frames, where there is a truth.

    Where boxes were drawn, only the objects in these boxes are scored.
    """
    if truth is None or not np.any(truth.objects[:, 0] <= last):
        return {}
    if drawn is not None:
        start = truth.objects[truth.objects[:, 0] == first]
        boxes, objects = matches(drawn, start[:, 2:])
        if len(boxes) < len(drawn):
            print(
                f"scored: {len(boxes)} of {len(drawn)} boxes, those around an object of the truth",
                file=sys.stderr,
            )
        if not len(boxes):
            return {}
        rows = rows[np.isin(rows[:, 1], boxes + 1)]
        wanted = np.isin(truth.objects[:, 1], start[objects, 1])
        truth = truth._replace(objects=truth.objects[wanted])
    try:
        scores = multi_object_scores(
            rows,
            truth.objects,
            (first, last),
            ignored=truth.ignored,
            min_height=truth.min_height,
        )
    except (ImportError, ValueError) as error:
        print(f"{_NO_SCORES}: {error}", file=sys.stderr)
        return {}
    return {name: round(scores[name], 4) for name in SCORES}
