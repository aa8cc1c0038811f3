"""Where the frames come from, and which objects are started and scored."""

import argparse
from collections.abc import Callable, Iterable
from typing import NamedTuple

import jax
import numpy as np

from benchmarks.coverage import covers
from benchmarks.scenes import football_scene
from mpfjax.console import refuse_overwriting
from mpfjax.vision import read_truth
from mpfjax.vision.boxes.recipes import MAX_COMPONENTS
from mpfjax.vision.files import boxes as box_files
from mpfjax.vision.files import frames


class Source(NamedTuple):
    """Where the frames come from, and what is known of the objects in them."""

    name: str
    read: Callable[[], Iterable[np.ndarray]]
    first: int  # the number of the first frame
    num_frames: int | None  # None where only reading on will tell
    boxes: np.ndarray  # (k, 4), where the objects start
    truth: np.ndarray | None  # rows of the objects to score against
    all_labelled: bool  # whether the truth knows every object that was started
    others: np.ndarray | None = None  # rows of those that were not started


def open_source(options: argparse.Namespace) -> Source:
    """The frames and the objects, or a `ValueError` that names the argument."""
    first, last = frames.parse_range(options.frames, "--frames")
    if options.sequence is None and options.video is None:
        return _rendered(options, first, last)
    path = options.sequence or options.video
    name = "--sequence" if options.sequence else "--video"
    if options.sequence is not None and not path.is_dir():
        raise ValueError(f"--sequence: {path} is not a folder")
    if options.video is not None and not path.is_file():
        raise ValueError(f"--video: {path} is not a file")
    refuse_overwriting(options.out, ["tracking.mp4", "tracking.gif"], {name: path})
    still = next(frames.read_frames(path, first, first), None)
    if still is None:
        raise ValueError(f"{name}: {path} has no frame {first}")
    count = None
    if options.sequence is not None:
        count = min(last or 10**9, frames.num_images(path)) - first + 1
    elif last is not None:
        count = last - first + 1
    truth_path = path / "gt.txt"
    rows = read_truth(truth_path).objects if truth_path.is_file() else None
    read = lambda: frames.read_frames(path, first, last)  # noqa: E731
    return _with_objects(options, str(path), read, first, last, count, rows, still)


def _rendered(options: argparse.Namespace, first: int, last: int | None) -> Source:
    num_frames = last or max(first + 119, 120)
    key = jax.random.key(options.seed)
    scene = football_scene(key, num_frames, still_camera=options.detect)
    stills = scene.frames[first - 1 :]
    if options.ids is None:
        options.ids = [id for id, kit in scene.kits.items() if kit == 0]
    return _with_objects(
        options, "rendered scene", lambda: stills, first, last, len(stills), scene.tracks, stills[0]
    )


def _with_objects(options, name, read, first, last, count, rows, still) -> Source:
    """Settle which objects are started where, and which are scored."""
    if rows is not None:
        rows = rows[(rows[:, 0] >= first) & (rows[:, 0] <= (last or np.inf))]
    if options.detect:
        return Source(name, read, first, count, np.zeros((0, 4)), rows, rows is not None)
    started = {} if rows is None else box_files.boxes_of_frame(rows, first)
    if options.box is not None:
        boxes = np.stack([box_files.parse_box(text, "--box") for text in options.box])
        ids = [id for id, box in started.items() if covers(boxes, box[None]).any()]
        argument = "--box"
    else:
        ids, argument = _chosen_ids(options, started, rows, first), "--ids"
        boxes = np.stack([started[id] for id in ids])
    if len(boxes) > MAX_COMPONENTS:
        raise ValueError(f"{argument}: {len(boxes)} objects are more than {MAX_COMPONENTS}")
    box_files.check_boxes(boxes, still.shape[0], still.shape[1], argument)
    truth = others = None
    if rows is not None and ids:
        is_started = np.isin(rows[:, 1], ids)
        truth, others = rows[is_started], rows[~is_started]
    return Source(name, read, first, count, boxes, truth, len(ids) == len(boxes), others)


def _chosen_ids(options, started: dict, rows: np.ndarray | None, first: int) -> list[int]:
    if rows is None:
        raise ValueError("--box: without a gt.txt every object needs its box in the first frame")
    ids = sorted(started) if options.ids is None else list(dict.fromkeys(options.ids))
    missing = [id for id in ids if id not in started]
    if missing or not ids:
        raise ValueError(f"--ids: gt.txt has no box of {missing or 'any object'} in frame {first}")
    return ids
