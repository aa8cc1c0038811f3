"""Trackers of other libraries, each as a function from a frame's detections to its tracks.

`trackers` (SORT, ByteTrack, OC-SORT, BoT-SORT, C-BIoU) and `norfair`, each with its defaults and
with what its own documentation advises for pedestrians: the configurations that the comparison
page of `trackers` gives for MOT17, and those of norfair's MOTChallenge demonstration. All see
boxes and scores alone, without camera motion.
"""

import sys
import warnings
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np

# Boxes (x, y, w, h) and scores of one frame, to rows (id, x, y, w, h).
Step = Callable[[np.ndarray, np.ndarray], np.ndarray]


class Peer(NamedTuple):
    """A tracker of another library with one of its settings."""

    name: str
    setting: str
    make: Callable[[float | None], Step]  # given the frames per second, where they are known


# By name: what their documentation advises.
TRACKERS: dict[str, dict[str, Any]] = {
    "SORT": {
        "lost_track_buffer": 10, "track_activation_threshold": 0.75,
        "minimum_consecutive_frames": 2, "minimum_iou_threshold": 0.3,
    },
    "ByteTrack": {
        "lost_track_buffer": 10, "track_activation_threshold": 0.7,
        "minimum_consecutive_frames": 1, "minimum_iou_threshold": 0.3,
        "high_conf_det_threshold": 0.5,
    },
    "OC-SORT": {
        "lost_track_buffer": 30, "minimum_iou_threshold": 0.3, "minimum_consecutive_frames": 3,
        "direction_consistency_weight": 0.2, "high_conf_det_threshold": 0.4, "delta_t": 1,
    },
    "BoT-SORT": {
        "lost_track_buffer": 30, "minimum_consecutive_frames": 2,
        "minimum_iou_threshold_first_assoc": 0.2, "minimum_iou_threshold_second_assoc": 0.5,
        "minimum_iou_threshold_unconfirmed_assoc": 0.2, "high_conf_det_threshold": 0.5,
        "track_activation_threshold": 0.6,
    },
    "C-BIoU": {
        "lost_track_buffer": 30, "minimum_consecutive_frames": 2,
        "minimum_iou_threshold_first_assoc": 0.2, "minimum_iou_threshold_second_assoc": 0.5,
        "minimum_iou_threshold_unconfirmed_assoc": 0.3, "high_conf_det_threshold": 0.6,
        "track_activation_threshold": 0.7, "buffer_ratio_first": 0.3, "buffer_ratio_second": 0.5,
    },
}  # fmt: skip
ALWAYS = {"BoT-SORT": {"enable_cmc": False}}  # no camera motion
# norfair has no default distance; that of its demonstrations on boxes, and of MOTChallenge's.
NORFAIR: dict[str, dict[str, Any]] = {
    "defaults": {"distance_function": "iou", "distance_threshold": 0.7},
    "advised": {"distance_function": "iou", "distance_threshold": 0.9, "detection_threshold": 0.5,
                "pointwise_hit_counter_max": 3, "hit_counter_max": 8},
}  # fmt: skip


def installed() -> list[Peer]:
    """Those that are installed; what is missing is said on the error stream."""
    found: list[Peer] = []
    for bring, hint in (
        (_of_trackers, "pip install trackers filterpy trackeval"),
        (_of_norfair, "pip install --no-deps norfair, and filterpy"),
    ):
        try:
            found += bring()
        except ImportError as error:
            print(f"peers are missing ({error}): {hint}", file=sys.stderr)
    return found


def _of_trackers() -> list[Peer]:
    import supervision  # pyright: ignore[reportMissingImports]
    import trackers  # pyright: ignore[reportMissingImports]

    found = []
    for name, advised in TRACKERS.items():
        # Older versions have the first two alone.
        kind = getattr(trackers, f"{name.replace('-', '')}Tracker", None)
        if kind is not None:
            for setting, options in (("defaults", {}), ("advised", advised)):
                options = ALWAYS.get(name, {}) | options
                make = partial(_through_trackers, kind, options, supervision)
                found.append(Peer(name, setting, make))
    return found


def _through_trackers(
    kind: Any, options: dict[str, Any], supervision: Any, frames_per_second: float | None
) -> Step:
    rate = {} if frames_per_second is None else {"frame_rate": frames_per_second}
    tracker = kind(**options | rate)

    def step(boxes: np.ndarray, scores: np.ndarray) -> np.ndarray:
        corners = np.concatenate([boxes[:, :2], boxes[:, :2] + boxes[:, 2:]], axis=1)
        found = supervision.Detections(
            xyxy=corners.reshape(-1, 4).astype(np.float32),
            confidence=scores.astype(np.float32),
            class_id=np.zeros(len(boxes), int),
        )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            tracked = tracker.update(found)
        ids = np.asarray(tracked.tracker_id if tracked.tracker_id is not None else [], int)
        kept = np.flatnonzero(ids >= 0)
        sides = np.asarray(tracked.xyxy, float)[kept]
        # Ids of files count from 1.
        return np.column_stack([ids[kept] + 1, sides[:, :2], sides[:, 2:] - sides[:, :2]])

    return step


def _of_norfair() -> list[Peer]:
    import norfair  # pyright: ignore[reportMissingImports]

    def make(_: float | None, options: dict[str, Any]) -> Step:
        tracker = norfair.Tracker(**options)

        def step(boxes: np.ndarray, scores: np.ndarray) -> np.ndarray:
            corners = np.stack([boxes[:, :2], boxes[:, :2] + boxes[:, 2:]], axis=1)
            found = [
                norfair.Detection(points, scores=np.full(2, score))
                for points, score in zip(corners, scores, strict=True)
            ]
            tracked = [(one.id, one.estimate) for one in tracker.update(detections=found)]
            rows = [[id, *low, *(high - low)] for id, (low, high) in tracked]
            return np.array(rows, float).reshape(-1, 5)

        return step

    return [
        Peer("norfair", setting, partial(make, options=options))
        for setting, options in NORFAIR.items()
    ]
