"""Rendered scenes with true boxes: football, and objects led away by a distracter. No command."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from benchmarks.scenes.distracter import NoPath as NoPath
from benchmarks.scenes.distracter import distracter_scene as distracter_scene
from benchmarks.scenes.football import football_scene as football_scene


def boxes_over_time(
    rows: Float[np.ndarray, "rows 6"], ids: Sequence[int], first: int, num_frames: int
) -> Float[np.ndarray, "t objects 4"]:
    """The true boxes of these objects in frames from `first` on; NaN where one has none."""
    boxes = np.full((num_frames, len(ids), 4), np.nan)
    for frame, id, *box in rows:
        if int(id) in ids and 0 <= int(frame) - first < num_frames:
            boxes[int(frame) - first, list(ids).index(int(id))] = box
    return boxes


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
