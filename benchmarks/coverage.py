"""How well tracks cover objects: coverage, strays, and changes of identity; no command.

Boxes are (x, y, w, h) with (x, y) the top-left corner, in rows (frame, id, x, y, w, h) as in
MOTChallenge files. A track covers an object in a frame if the centre of its box lies within
|dx| < 0.75 w and |dy| < 0.5 h of the centre of the object's box.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

REACH = (0.75, 0.5)


class Coverage(NamedTuple):
    """The scores of `coverage`.

    - `all_covered`: the share of frames in which every object is covered by some track.
    - `on_object`: the share of all boxes of tracks that cover some object.
    - `id_swaps`: how often an object's identity passes from one track to another.
    - `on_other`: the share of all boxes of tracks that cover none of the objects but one of
      `others`, where those are given. The remaining boxes cover nothing.
    """

    all_covered: float
    on_object: float
    id_swaps: int
    on_other: float = 0.0


def coverage(
    tracks: Float[np.ndarray, "r 6"],
    objects: Float[np.ndarray, "s 6"],
    others: Float[np.ndarray, "o 6"] | None = None,
) -> Coverage:
    """Score tracks against the true boxes, over the frames in which there is an object.

    In each frame only the objects with a box there count. Every object is assigned to a track, and
    keeps it while the track covers it. Otherwise it is assigned to the nearest covering track that
    no other object keeps, and if it had another track before, a swap is counted. `others` are true
    boxes of objects that are not to be tracked. Boxes on these count apart from boxes on nothing.
    Raises `ValueError` without true boxes.
    """
    others = np.zeros((0, 6)) if others is None else others
    if len(objects) == 0:
        raise ValueError("objects: there are no true boxes to score against")
    complete: list[bool] = []
    on_object: list[bool] = []
    on_other: list[bool] = []
    swaps = 0
    identity: dict[int, int] = {}
    for frame in np.unique(objects[:, 0]):
        truth, boxes = objects[objects[:, 0] == frame], tracks[tracks[:, 0] == frame]
        hits = covers(boxes[:, 2:], truth[:, 2:])
        complete.append(bool(hits.any(axis=0).all()))
        on_object += [bool(row.any()) for row in hits]
        strays = covers(boxes[:, 2:], others[others[:, 0] == frame, 2:])
        on_other += [
            bool(other.any() and not hit.any()) for other, hit in zip(strays, hits, strict=True)
        ]
        swaps += _reassign(identity, boxes, truth, hits)
    return Coverage(
        all_covered=float(np.mean(complete)),
        on_object=float(np.mean(on_object)) if on_object else 0.0,
        id_swaps=swaps,
        on_other=float(np.mean(on_other)) if on_other else 0.0,
    )


def covers(
    boxes: Float[np.ndarray, "r 4"], objects: Float[np.ndarray, "s 4"]
) -> Bool[np.ndarray, "r s"]:
    """Whether each box covers each object: |dx| < 0.75 w and |dy| < 0.5 h of the object's box."""
    return np.all(_offsets(boxes, objects) < np.array(REACH), axis=-1)


def _offsets(boxes: np.ndarray, objects: np.ndarray) -> np.ndarray:
    """|dx| / w and |dy| / h between centres, w and h the object's."""
    centres, truth = (part[:, :2] + part[:, 2:] / 2 for part in (boxes, objects))
    return np.abs(centres[:, None] - truth[None]) / objects[None, :, 2:]


def _reassign(
    identity: dict[int, int], boxes: np.ndarray, truth: np.ndarray, hits: np.ndarray
) -> int:
    """Update which track each object is assigned to, and count the swaps."""
    tracks, ids = boxes[:, 1].astype(int), truth[:, 1].astype(int)
    pairs = [
        (i, j)
        for j, id in enumerate(ids)
        for i in np.flatnonzero(tracks == identity.get(id))
        if hits[i, j]
    ]
    rows: set[int] = {int(i) for i, _ in pairs}
    columns = {j for _, j in pairs}
    distance = np.sum((_offsets(boxes[:, 2:], truth[:, 2:]) / np.array(REACH)) ** 2, axis=-1)
    swaps = 0
    for i, j in sorted(np.argwhere(hits).tolist(), key=lambda pair: distance[tuple(pair)]):
        if i in rows or j in columns:
            continue
        swaps += int(ids[j]) in identity
        identity[int(ids[j])] = int(tracks[i])
        rows.add(i)
        columns.add(j)
    return swaps
