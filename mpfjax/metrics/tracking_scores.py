"""The scores by which trackers are compared: HOTA, MOTA and IDF1, computed by TrackEval."""

import numpy as np
from jaxtyping import Float
from scipy.optimize import linear_sum_assignment

from mpfjax.arrays import to_rows
from mpfjax.checks import NotNegative, checked, optional

# The kinds of objects and regions that are not scored, in the second column of their rows.
IGNORED_OBJECT, IGNORED_REGION, UNSCORED_OBJECT = 1, 2, 3
_ROUNDING = float(np.finfo(float).eps)
_SETTINGS = {"THRESHOLD": 0.5, "PRINT_CONFIG": False}


@checked
def multi_object_scores(
    tracks: Float[np.ndarray, "r 6"],
    truth: Float[np.ndarray, "s 6"],
    *,
    ignored: Float[np.ndarray, "i 6"] | None = None,
    min_height: NotNegative = 0.0,
) -> dict[str, float]:
    """Score tracks against the true boxes as TrackEval does, by the overlap of boxes (IoU).

    Both are rows (frame, id, x, y, w, h) as in MOTChallenge files, (x, y) the top-left corner, in
    pixels. Every frame in which either has a box counts. `ignored` and `min_height` are the
    arguments of `remove_ignored`, which is called first; `read_truth` of `mpfjax.vision` reads both
    and `truth`, and its `between` selects frames. The scores:

    - "HOTA", "DetA" and "AssA", Luiten et al. (2021), each the mean over IoU thresholds of 0.05 to
      0.95;
    - "MOTA", "MOTP" (the mean IoU of the matches), "id_switches", "false_positives" and "misses",
      Bernardin and Stiefelhagen (2008), at an IoU of 0.5;
    - "IDF1", Ristani et al. (2016), at an IoU of 0.5.

    Without tracks every object is a miss and every ratio 0. A box without area overlaps nothing.
    Raises `ValueError` for rows that are not six finite numbers, for an id with two boxes in one
    frame, without true boxes to score against, and as `remove_ignored` does; `ImportError` without
    the extra "trackeval". Use it to compare with published trackers.
    """
    tracks, truth = _checked(tracks, "tracks"), _checked(truth, "truth")
    if len(truth) == 0:
        raise ValueError("truth: there are no true boxes to score against")
    ignored = np.zeros((0, 6)) if ignored is None else ignored
    tracks = remove_ignored(tracks, truth, ignored, min_height)
    metrics = optional("trackeval", "trackeval").metrics
    sequence = _sequence(tracks, truth)
    hota = metrics.HOTA().eval_sequence(sequence)
    clear = metrics.CLEAR(_SETTINGS).eval_sequence(sequence)
    identity = metrics.Identity(_SETTINGS).eval_sequence(sequence)
    scores = {name: np.mean(hota[name]) for name in ("HOTA", "DetA", "AssA")}
    scores |= {name: clear[name] for name in ("MOTA", "MOTP")}
    scores |= {
        "IDF1": identity["IDF1"], "id_switches": clear["IDSW"],
        "false_positives": clear["CLR_FP"], "misses": clear["CLR_FN"],
    }  # fmt: skip
    return {name: float(score) for name, score in scores.items()}


@checked
def remove_ignored(
    tracks: Float[np.ndarray, "r 6"],
    truth: Float[np.ndarray, "s 6"],
    ignored: Float[np.ndarray, "i 6"],
    min_height: NotNegative = 0.0,
) -> Float[np.ndarray, "k 6"]:
    """The tracked boxes that count, selected as by MOTChallenge and KITTI before scoring.

    In each frame, tracked boxes are matched one-to-one with all labelled boxes, at the largest sum
    of overlaps (IoU) of at least a half. Then these tracked boxes are removed:

    - those matched to an ignored object;
    - unmatched boxes of which more than half is in one ignored region, and, with a positive
      `min_height`, unmatched boxes whose height in pixels is at most this.

    `tracks` and `truth` are rows (frame, id, x, y, w, h), and `ignored` rows (frame, kind, x, y, w,
    h). Kind 1 is an ignored object, such as a rider if pedestrians are tracked; kind 2 a region
    without labels; kind 3 an object that is not scored: a tracked box may match it, and is not
    removed.

    Raises `ValueError` for rows that are not six finite numbers, for another kind, and for a
    negative height. Use it before scores of another library; `multi_object_scores` calls it.
    """
    tracks, truth = _checked(tracks, "tracks"), _checked(truth, "truth")
    ignored = _rows(ignored, "ignored")
    for kind in np.setdiff1d(ignored[:, 1], (IGNORED_OBJECT, IGNORED_REGION, UNSCORED_OBJECT)):
        raise ValueError(f"ignored: {kind:g} is none of the kinds 1, 2 and 3")
    if len(ignored) == 0 and min_height == 0:
        return tracks
    regions = ignored[:, 1] == IGNORED_REGION
    labelled = np.concatenate([np.insert(truth[:, [0, *range(2, 6)]], 1, 0, 1), ignored[~regions]])
    is_scored = np.ones(len(tracks), bool)
    for frame in np.unique(tracks[:, 0]):
        here = np.flatnonzero(tracks[:, 0] == frame)
        objects = labelled[labelled[:, 0] == frame]
        fields = ignored[regions & (ignored[:, 0] == frame), 2:]
        matched, owners = matches(tracks[here, 2:], objects[:, 2:])
        is_scored[here[matched[objects[owners, 1] == IGNORED_OBJECT]]] = False
        left = np.delete(here, matched)
        boxes = tracks[left, 2:]
        shared, areas, _ = _areas(boxes, fields)
        shares = np.where(areas > 0, shared / np.where(areas > 0, areas, 1.0), 0.0)
        inside = np.any(shares > 0.5 + _ROUNDING, axis=1)
        low = (min_height > 0) & (boxes[:, 3] <= min_height + _ROUNDING)
        is_scored[left[inside | low]] = False
    return tracks[is_scored]


def matches(boxes: np.ndarray, objects: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The rows of boxes and of objects, matched one to one, that overlap (IoU) by half or more."""
    shares = overlap(boxes, objects)
    shares[shares < 0.5 - _ROUNDING] = 0
    # TrackEval's own solver, with the objects first as there: of equal sums it finds the same.
    owners, matched = linear_sum_assignment(-shares.T)
    real = shares[matched, owners] > 0
    return matched[real], owners[real]


def overlap(
    boxes: Float[np.ndarray, "r 4"], objects: Float[np.ndarray, "s 4"]
) -> Float[np.ndarray, "r s"]:
    """Intersection over union of boxes (x, y, w, h); 0 where either has no area."""
    shared, areas, others = _areas(boxes, objects)
    union = areas + others - shared
    return np.where(shared > 0, shared / np.where(shared > 0, union, 1.0), 0.0)


def _areas(boxes: np.ndarray, others: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The area of each box in each of the others, (r, s), and those of both, (r, 1) and (1, s)."""
    boxes, others = boxes[:, None], others[None]
    near = np.maximum(boxes[..., :2], others[..., :2])
    far = np.minimum(boxes[..., :2] + boxes[..., 2:], others[..., :2] + others[..., 2:])
    sides = far - near, boxes[..., 2:], others[..., 2:]
    shared, areas, of_others = (np.prod(np.maximum(side, 0.0), axis=-1) for side in sides)
    return shared, areas, of_others


def _rows(rows: np.ndarray, argument: str) -> np.ndarray:
    rows = to_rows(6, argument, rows)
    if not np.all(np.isfinite(rows)):
        raise ValueError(f"{argument}: holds numbers that are not finite")
    return rows


def _checked(rows: np.ndarray, argument: str) -> np.ndarray:
    rows = _rows(rows, argument)
    keys, counts = np.unique(rows[:, :2], axis=0, return_counts=True)
    for frame, id in keys[counts > 1].tolist():
        raise ValueError(f"{argument}: id {id:g} has more than one box in frame {frame:g}")
    return rows


def _sequence(tracks: np.ndarray, truth: np.ndarray) -> dict[str, object]:
    """One sequence in the form that TrackEval's metrics read: ids from 0, lists over frames."""
    frames = np.union1d(tracks[:, 0], truth[:, 0])
    sequence: dict[str, object] = {"num_timesteps": len(frames)}
    boxes = []
    for name, rows in (("gt", truth), ("tracker", tracks)):
        names, ids = np.unique(rows[:, 1], return_inverse=True)
        in_frames = [rows[:, 0] == frame for frame in frames]
        boxes.append([rows[here, 2:] for here in in_frames])
        sequence[f"{name}_ids"] = [ids[here] for here in in_frames]
        sequence[f"num_{name}_ids"] = len(names)
        sequence[f"num_{name}_dets"] = len(rows)
    sequence["similarity_scores"] = [overlap(*pair) for pair in zip(*boxes, strict=True)]
    return sequence
