"""Tracking without a drawn box: detections, and the trackers that are born of them."""

import time
from collections.abc import Callable, Iterator
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from tqdm import tqdm

from benchmarks.visual_tracking.source import Source
from mpfjax.vision import (
    BackgroundSubtraction,
    Detections,
    ObjectTracker,
    Tracks,
    make_tracker,
    offline_rows,
)
from mpfjax.vision.boxes.snapshots import Snapshot

MAX_DETECTIONS = 32


class Detected(NamedTuple):
    """The boxes (k, 4) of every frame, top-left corner first, and the seconds that each took."""

    boxes: list[np.ndarray]
    seconds: list[float]


def detect_all(source: Source) -> Detected:
    """What moves in each frame; the background is learned on the way. Reading is timed too."""
    detector = BackgroundSubtraction()
    boxes, seconds = [], []
    start = time.perf_counter()
    for still in tqdm(source.read(), total=source.num_frames, desc="Detection", disable=None):
        boxes.append(detector.detect(still))
        seconds.append(time.perf_counter() - start)
        start = time.perf_counter()
    return Detected(boxes, seconds)


def make_trackers() -> dict[str, ObjectTracker]:
    """The same tracker with resampling and with Gaussian regeneration."""
    return {name: make_tracker(name) for name in ("mpf", "gm_mpf")}


def track_detected(
    tracker: ObjectTracker, keys: Array, source: Source, detected: Detected
) -> tuple[Callable, Callable]:
    """What yields the frames of a tracker's runs, and what makes tracks of them.

    The seconds of a frame are those of reading, detecting and tracking.
    """
    kept: list[Tracks] = []

    def frames_of_run(bar: tqdm) -> Iterator[tuple[Snapshot, float]]:
        states = jax.tree.map(lambda leaf: jnp.stack([leaf] * len(keys)), tracker.init())
        for t, (still, boxes) in enumerate(zip(source.read(), detected.boxes, strict=True)):
            start = time.perf_counter()
            found = Detections.from_boxes(boxes, MAX_DETECTIONS)
            states, tracks, snapshot = _advance(
                tracker, keys, jnp.asarray(t), states, jnp.asarray(still), found
            )
            kept.append(jax.tree.map(np.asarray, tracks))
            snapshot = jax.tree.map(np.asarray, snapshot)
            bar.update()
            yield snapshot, time.perf_counter() - start + detected.seconds[t]

    def rows_of_run(snapshots: list[Snapshot]) -> list[np.ndarray]:
        tracked = kept[: len(snapshots)]
        return [
            offline_rows((_of_run(tracks, run) for tracks in tracked), source.first)
            for run in range(len(keys))
        ]

    return frames_of_run, rows_of_run


def _of_run(tracks: Tracks, run: int) -> Tracks:
    return jax.tree.map(lambda leaf: leaf[run], tracks)


@eqx.filter_jit
def _advance(tracker, keys, t, states, frame, found):
    def step(key, state):
        state, tracks = tracker.step(jax.random.fold_in(key, t), state, frame, found)
        labels = jnp.where(state.occupied, state.component_indicators, -1)
        points = state.particles.boxes[:, :2]
        return state, tracks, Snapshot(tracks.boxes, tracks.shown, points, labels)

    # The frame is not mapped over, so that its histogram is built once for all runs.
    return jax.vmap(step)(keys, states)
