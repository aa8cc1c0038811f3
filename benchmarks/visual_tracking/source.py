"""Where the frames come from, and which objects are started and scored."""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from benchmarks.coverage import covers
from benchmarks.scenes import football_scene
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


class Asked(NamedTuple):
    """What the options say of the objects."""

    box: Sequence[str]
    ids: Sequence[int] | None
    detect: bool


def read_source(path: Path, name: str, span: tuple[int, int | None], asked: Asked) -> Source:
    """A folder or a video file, or a `ValueError` that names the argument."""
    first, last = span
    still = next(frames.read_frames(path, first, first), None)
    if still is None:
        raise ValueError(f"{name}: {path} has no frame {first}")
    count = None if last is None else last - first + 1
    if path.is_dir():
        count = min(last or 10**9, frames.num_images(path)) - first + 1
    truth = path / "gt.txt"
    rows = read_truth(truth).objects if truth.is_file() else None
    read = lambda: frames.read_frames(path, first, last)  # noqa: E731
    return _with_objects(Source(str(path), read, first, count, _NONE, rows, True), still, asked)


def rendered_source(span: tuple[int, int | None], seed: int, asked: Asked) -> Source:
    """The football scene, in which all of one team are started."""
    first, last = span
    num_frames = last or max(first + 119, 120)
    scene = football_scene(jax.random.key(seed), num_frames, still_camera=asked.detect)
    stills = scene.frames[first - 1 :]
    if asked.ids is None:
        asked = asked._replace(ids=[id for id, kit in scene.kits.items() if kit == 0])
    whole = Source(
        "rendered scene", lambda: stills, first, len(stills), _NONE, scene.tracks, True
    )  # fmt: skip
    return _with_objects(whole, stills[0], asked)


_NONE = np.zeros((0, 4))


def _with_objects(source: Source, still: np.ndarray, asked: Asked) -> Source:
    """Settle which objects are started where, and which are scored."""
    rows, first = source.truth, source.first
    if rows is not None:
        last = np.inf if source.num_frames is None else first + source.num_frames - 1
        rows = rows[(rows[:, 0] >= first) & (rows[:, 0] <= last)]
    if asked.detect:
        return source._replace(truth=rows, all_labelled=rows is not None)
    started = {} if rows is None else box_files.boxes_of_frame(rows, first)
    if asked.box:
        boxes = np.stack([box_files.parse_box(text, "--box") for text in asked.box])
        ids = [id for id, box in started.items() if covers(boxes, box[None]).any()]
        argument = "--box"
    else:
        ids, argument = _chosen_ids(asked, started, rows, first), "--ids"
        boxes = np.stack([started[id] for id in ids])
    if len(boxes) > MAX_COMPONENTS:
        raise ValueError(f"{argument}: {len(boxes)} objects are more than {MAX_COMPONENTS}")
    box_files.check_boxes(boxes, still.shape[0], still.shape[1], argument)
    truth = others = None
    if rows is not None and ids:
        is_started = np.isin(rows[:, 1], ids)
        truth, others = rows[is_started], rows[~is_started]
    all_labelled = len(ids) == len(boxes)
    return source._replace(boxes=boxes, truth=truth, all_labelled=all_labelled, others=others)


def _chosen_ids(asked: Asked, started: dict, rows: np.ndarray | None, first: int) -> list[int]:
    if rows is None:
        raise ValueError("--box: without a gt.txt every object needs its box in the first frame")
    ids = sorted(started) if asked.ids is None else list(dict.fromkeys(asked.ids))
    missing = [id for id in ids if id not in started]
    if missing or not ids:
        raise ValueError(f"--ids: gt.txt has no box of {missing or 'any object'} in frame {first}")
    return ids
