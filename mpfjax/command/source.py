"""What the arguments of the command name: the frames, and what is known of them."""

import os
import warnings
from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mpfjax.command import FORMATS, TRACKS
from mpfjax.console import check_outputs
from mpfjax.vision.files import boxes as box_files
from mpfjax.vision.files import frames, sequences
from mpfjax.vision.tracking.adapters import Rows, first_step

VIDEO, SUMMARY = "tracking.mp4", "summary.json"
SCORES = ("HOTA", "MOTA", "IDF1")
NO_SCORES = "no HOTA, MOTA and IDF1"
_TEXT = (".txt", ".csv")
_NOT_WITH = {
    "box": "max-objects min-score no-colour camera-motion offline lost-seconds classes"
    " point-deviation truth",
    "detect": "min-score classes point-deviation",
    "point-deviation": "truth",
}


class Source(NamedTuple):
    """The frames to track in, and their metadata."""

    path: Path
    has_pixels: bool
    rows: np.ndarray | None  # detections; None where they are yet to be found
    first: int  # the number of the first frame
    last: int | None  # None where it is unknown until all frames are read
    num_frames: int | None
    frames_per_second: float | None
    frame_size: tuple[int, int] | None  # None where it is unknown before the frames are read
    truth: sequences.Truth | None
    times: list[float]  # of the frames of a video that have been read, in seconds


def check_options(track: ArgumentParser, options: Namespace) -> None:
    """An error of `track` for options that do not go together."""
    by_pixels, has_pixels = options.camera_motion == "pixels", _has_pixels(options.source)
    of_pixels = {"detect": options.detect, "box": options.box, "camera-motion pixels": by_pixels}
    for name, value in of_pixels.items():
        if value and not has_pixels:
            track.error(f"argument --{name}: {options.source} has no pixels")
    if has_pixels and not (options.detections or options.detect or options.box):
        track.error("one of the arguments --detections --detect --box is required")
    if options.detect and by_pixels:
        track.error("argument --camera-motion pixels: not allowed with --detect")
    present = {name.replace("_", "-") for name, value in vars(options).items() if value}
    for option, others in _NOT_WITH.items():
        for name in others.split():
            if {name, option} <= present:
                track.error(f"argument --{name}: not allowed with --{option}")


def open_source(options: Namespace) -> Source:
    """The source of the frames; a `ValueError` for one that cannot be read."""
    first, last = frames.parse_range(options.frames)
    path, has_pixels = options.source, _has_pixels(options.source)
    detections = options.detections if has_pixels else _detections_alone(options)
    outputs = [TRACKS, SUMMARY, FORMATS[options.format]]
    outputs += [VIDEO] if has_pixels and not options.no_video else []
    inputs = {"SOURCE": path, "--detections": detections, "--truth": options.truth}
    check_outputs(options.out, outputs, inputs)
    rows, points = None, options.point_deviation is not None
    if detections is not None:
        kinds = {"with_classes": options.classes, "points": points}
        rows = box_files.read_detections(detections, **kinds)
    folder, info = path, sequences.SequenceInfo()
    if not has_pixels:
        folder = path if path.is_dir() else _sequence_of(path) or path
        info = sequences.read_sequence_info(folder)
    unscored, end = points or options.box is not None, last
    truth = None if unscored else find_truth(folder, options.truth, first, last)
    if rows is not None and not has_pixels:
        rows_of_files = [rows[:, :6], *([] if truth is None else [truth.objects])]
        length = sequences.last_frame(info, *rows_of_files)
        if last is None and info.length is None:
            begin = first if options.frames else None
            rate = options.fps or info.frame_rate or 25
            of_rows = Rows(np.concatenate(rows_of_files), coordinates=2 if points else 4)
            first = first_step(of_rows, begin, rate)
        last = end = min(last or length, length)
        if last < first:
            raise ValueError(f"SOURCE: {path} holds {length} frames, and no frame {first}")
    elif path.is_dir():
        length = frames.num_images(path)
        end = min(last or length, length)
    num_frames = None if end is None else end - first + 1
    if rows is not None and options.frames is not None and last is not None:
        rows = rows[rows[:, 0] <= last]
    rate = options.fps or (frames.frame_rate(path) if has_pixels else info.frame_rate)
    return Source(path, has_pixels, rows, first, last, num_frames, rate, info.size, truth, [])


def find_truth(
    source: Path, path: Path | None, first: int, last: int | None
) -> sequences.Truth | None:
    """The ground truth at `path`, or in a folder of images, in these frames; None without one.

    A video has no folder, and so no ground truth without a `path`. Warns of a file in the folder
    that cannot be read; raises `ValueError` for a file at `path`.
    """
    if path is None and not source.is_dir():
        return None
    folder = Path(os.path.abspath(source))
    folder = folder.parent if folder.name in frames.INNER else folder
    try:
        truth = sequences.read_truth(path or folder)
    except (ValueError, OSError) as error:
        if path is not None:
            raise
        if not isinstance(error, FileNotFoundError):
            warnings.warn(f"{NO_SCORES}: {error}", RuntimeWarning, stacklevel=2)
        return None
    truth = truth.between(first, last or np.inf)
    if path is not None and not len(truth.objects):
        raise ValueError(f"--truth: {path} has no box in these frames")
    return truth if len(truth.objects) else None


def _has_pixels(path: Path) -> bool:
    """Whether there are frames, and not detections alone."""
    if path.is_dir():
        return frames.num_images(path) > 0 or not sequences.detection_files(path)
    return path.suffix.lower() not in _TEXT


def _sequence_of(detections: Path) -> Path | None:
    """The folder of the sequence to which a file of detections belongs, by its path, or None."""
    file = detections.absolute()
    folders = (path for path in file.parents[:2] if file in sequences.detection_files(path))
    return next(folders, None)


def _detections_alone(options: Namespace) -> Path:
    """The file of detections where there are no pixels: that of the folder, or the source."""
    path = options.source
    if options.detections is not None or path.is_file():
        return options.detections or path
    files = sequences.detection_files(path)
    files = [file for file in files if file.name == "det.txt"] or files
    if len(files) > 1:
        raise ValueError(f"SOURCE: {path} holds {len(files)} files of detections; name one of them")
    return files[0]


def read_boxes(texts: list[str], still: np.ndarray) -> np.ndarray:
    """The drawn boxes, each of which has to lie in the first frame."""
    boxes = np.stack([box_files.parse_box(text) for text in texts])
    height, width, _ = still.shape
    return box_files.check_boxes(boxes, height, width, "--box")
