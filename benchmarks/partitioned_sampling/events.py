"""Where one object of a sequence is hidden by another and comes out elsewhere: by the boxes alone.

The rule: in six successive frames or more, the box of another object that reaches farther down
the image, and so is nearer to the camera, covers at least half of the object's box; the object
has a box in the frame before and in the frame after; and between those two its centre moves by
at least half the width that it went in with. It says nothing of looks, and no filter has run.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from mpfjax.vision import read_truth

LEAST_FRAMES, LEAST_COVER, LEAST_WAY = 6, 0.5, 0.5
AROUND = 10  # frames that are shown before and after
MOST_OBJECTS = 4  # of a joint filter, as in the paper's largest


class Event(NamedTuple):
    """A part of a sequence in which the first of its objects is hidden and comes back.

    `hidden`: the first and the last frame of it, None where nobody has said.
    """

    ids: tuple[int, ...]
    frames: tuple[int, int | None]
    hidden: tuple[int, int] | None = None


def find_events(folder: Path) -> list[Event]:
    """Every event of a sequence in the order of objects and frames.

    Its objects are the hidden one, those that hide it, and, up to four, the others with a box in
    every frame, in the order of their ids. It starts ten frames before, or when all who hide it
    are there, and ends ten frames after, or with the object; who comes only to hide it is none of
    its objects. Raises `ValueError` for a sequence without any.
    """
    if not folder.is_dir():
        raise ValueError(f"--sequence: {folder} is not a folder")
    ids, boxes = tracks(read_truth(folder / "gt.txt").objects)
    events = [event for j in range(len(ids)) for event in _events_of(j, ids, boxes)]
    if not events:
        raise ValueError(
            f"--sequence: in {folder.name} no object is covered for {LEAST_FRAMES} frames and comes"
            " out elsewhere; give --ids and --frames"
        )
    return events


def tracks(
    rows: Float[np.ndarray, "rows 6"],
) -> tuple[list[int], Float[np.ndarray, "frames objects 4"]]:
    """The ids, and each object's box in frames 0, 1, ..., NaN where it has none."""
    ids = sorted({int(row[1]) for row in rows})
    boxes = np.full((int(rows[:, 0].max()) + 1, len(ids), 4), np.nan)
    for frame, id, *box in rows:
        boxes[int(frame), ids.index(int(id))] = box
    return ids, boxes


def cover(
    box: Float[np.ndarray, "frames 4"], others: Float[np.ndarray, "frames objects 4"]
) -> Float[np.ndarray, "frames objects"]:
    """The share of a box that each other box before it covers, 0 where one is missing."""
    box = box[:, None]
    low = np.maximum(box[..., :2], others[..., :2])
    high = np.minimum(box[..., :2] + box[..., 2:], others[..., :2] + others[..., 2:])
    share = np.clip(high - low, 0, None).prod(axis=-1) / box[..., 2:].prod(axis=-1)
    is_before = others[..., 1] + others[..., 3] > box[..., 1] + box[..., 3]
    return np.where(is_before & np.isfinite(share), share, 0.0)


def _events_of(j: int, ids: list[int], boxes: np.ndarray) -> list[Event]:
    covers = cover(boxes[:, j], boxes)
    is_hidden = covers.max(axis=1) >= LEAST_COVER
    there = np.asarray(np.isfinite(boxes).all(axis=-1))
    edges = np.flatnonzero(np.diff(np.concatenate([[False], is_hidden, [False]]).astype(int)))
    events = []
    for first, end in edges.reshape(-1, 2):
        before, after = first - 1, end
        if end - first < LEAST_FRAMES or after >= len(boxes):
            continue
        if not (there[before, j] and there[after, j]):
            continue
        way = boxes[after, j, :2] - boxes[before, j, :2]
        way = way + (boxes[after, j, 2:] - boxes[before, j, 2:]) / 2
        if np.linalg.norm(way) < LEAST_WAY * boxes[before, j, 2]:
            continue
        hiding = covers[first:end].argmax(axis=1)
        hidden_by = list(dict.fromkeys(hiding[covers[first:end].max(axis=1) >= LEAST_COVER]))
        start = int(max(first - AROUND, 1))
        stop = int(min(end - 1 + AROUND, len(boxes) - 1))
        while not there[start, [j, *hidden_by]].all() and start < before:
            start += 1
        while not there[stop, j]:
            stop -= 1
        chosen = [k for k in [j, *hidden_by] if there[start, k]]
        whole = [k for k in range(len(ids)) if there[start : stop + 1, k].all()]
        chosen += [k for k in whole if k not in chosen]
        chosen = [ids[k] for k in chosen[:MOST_OBJECTS]]
        events.append(Event(tuple(chosen), (start, stop), (int(first), int(end) - 1)))
    return events
