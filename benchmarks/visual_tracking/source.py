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
    truth: np.ndarray | None  # rows of the objects to score against
    boxes: np.ndarray = np.zeros((0, 4))  # where the objects start
    all_labelled: bool = True  # whether the truth knows every object that was started
    others: np.ndarray | None = None  # rows of those that were not started


def open_source(
    sequence: Path | None, video: Path | None, span: tuple[int, int | None], seed: int,
    box: Sequence[str], ids: Sequence[int] | None, detect: bool,
) -> Source:  # fmt: skip
    """A folder, a video file, or the rendered scene, in which all of one team are started.

    Raises `ValueError`, with the name of the option, where it has no such frame or object.
    """
    (first, last), path = span, sequence or video
    if path is None:
        if box:
            raise ValueError(
                "--box: without --video FILE or --sequence DIR there is no frame to draw it in;"
                " add one, or leave --box out for the rendered scene"
            )
        num_frames = last or max(first + 119, 120)
        scene = football_scene(jax.random.key(seed), num_frames, still_camera=detect)
        stills, rows = scene.frames[first - 1 :], scene.tracks
        ids = [id for id, kit in scene.kits.items() if kit == 0] if ids is None else ids
        source = Source("rendered scene", lambda: stills, first, len(stills), rows)
    else:
        name = "--video" if sequence is None else "--sequence"
        if not (path.is_file() if sequence is None else path.is_dir()):
            raise ValueError(f"{name}: {path} is not a {'file' if sequence is None else 'folder'}")
        if next(frames.read_frames(path, first, first), None) is None:
            raise ValueError(f"{name}: {path} has no frame {first}")
        count = None if last is None else last - first + 1
        if path.is_dir():
            count = min(last or 10**9, frames.num_images(path)) - first + 1
        truth = path / "gt.txt"
        rows = read_truth(truth).objects if truth.is_file() else None
        read = lambda: frames.read_frames(path, first, last)  # noqa: E731
        source = Source(str(path), read, first, count, rows)
    if rows is not None:
        end = np.inf if source.num_frames is None else first + source.num_frames
        source = source._replace(truth=rows[(rows[:, 0] >= first) & (rows[:, 0] < end)])
    return source if detect else _with_objects(source, box, ids)


def _with_objects(source: Source, box: Sequence[str], ids: Sequence[int] | None) -> Source:
    """Settle which objects are started where, and which are scored."""
    rows, first = source.truth, source.first
    started = {int(row[1]): row[2:6] for row in ([] if rows is None else rows) if row[0] == first}
    if box:
        boxes = np.stack([box_files.parse_box(text) for text in box])
        ids = [id for id, own in started.items() if covers(boxes, own[None]).any()]
    elif rows is None:
        raise ValueError("--box: without a gt.txt every object needs its box in the first frame")
    else:
        ids = sorted(started) if ids is None else list(dict.fromkeys(ids))
        missing = [id for id in ids if id not in started]
        if missing or not ids:
            missed = missing or "any object"
            raise ValueError(f"--ids: gt.txt has no box of {missed} in frame {first}")
        boxes = np.stack([started[id] for id in ids])
    argument = "--box" if box else "--ids"
    if len(boxes) > MAX_COMPONENTS:
        raise ValueError(f"{argument}: {len(boxes)} objects are more than {MAX_COMPONENTS}")
    height, width, _ = next(iter(source.read())).shape
    box_files.check_boxes(boxes, height, width, argument)
    truth = others = None
    if rows is not None and ids:
        is_started = np.isin(rows[:, 1], ids)
        truth, others = rows[is_started], rows[~is_started]
    all_labelled = len(ids) == len(boxes)
    return source._replace(boxes=boxes, truth=truth, all_labelled=all_labelled, others=others)
