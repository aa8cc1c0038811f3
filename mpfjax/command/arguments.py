"""What the command is asked to do, and where the frames come from."""

import argparse
import importlib
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mpfjax.command.scoring import find_truth
from mpfjax.console import finite, positive, refuse_overwriting, seed, whole
from mpfjax.vision import boxes as box_files
from mpfjax.vision import frames
from mpfjax.vision.truth import Truth

DESCRIPTION = """\
Track objects in a video or a folder of images. What to track comes from one of three: detections
in a file, whatever moves before a still camera, or boxes drawn in the first frame.
"""
EXAMPLES = """\
examples:
  mpfjax track match.mp4 --detections match.txt --out tracks
  mpfjax track street/ --detect --out tracks
  mpfjax track street/ --box 120,80,30,70 --box 200,90,28,66 --out tracks
"""

TRACKS, VIDEO, SUMMARY = OUTPUTS = ("tracks.txt", "tracking.mp4", "summary.json")


class Source(NamedTuple):
    """The frames to track in, and what is known of them beforehand."""

    path: Path
    first: int  # the number of the first frame
    last: int | None  # None where only reading on will tell
    num_frames: int | None
    frames_per_second: float | None
    truth: Truth | None


def parse_arguments(arguments: list[str] | None = None) -> argparse.Namespace:
    """The arguments, each checked as far as it can be without the frames."""
    parser = argparse.ArgumentParser(prog="mpfjax", description="Particle filters that track.")
    package = importlib.import_module(__name__.partition(".")[0])
    parser.add_argument("--version", action="version", version=f"mpfjax {package.__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    track = commands.add_parser(
        "track",
        help="track objects in a video",
        description=DESCRIPTION,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    track.add_argument("source", type=Path, metavar="SOURCE", help="a video, or a folder of images")
    track.add_argument("--out", type=Path, required=True, metavar="DIR", help="where results go")
    what = track.add_mutually_exclusive_group(required=True)
    what.add_argument(
        "--detections", type=Path, metavar="FILE", help="MOTChallenge rows, with scores if any"
    )
    what.add_argument("--detect", action="store_true", help="what moves before a still camera")
    what.add_argument(
        "--box", action="append", metavar="x,y,w,h", help="an object in the first frame; repeat it"
    )
    track.add_argument("--frames", metavar="A:B", help="frames A to B, counted from 1, both in")
    track.add_argument("--seed", type=seed, default=0, help="of the random numbers")
    track.add_argument(
        "--filter", choices=("gm_mpf", "mpf"), help="Gaussian mixture (default) or resampling"
    )
    track.add_argument("--min-score", type=finite, metavar="S", help="leave out weaker detections")
    track.add_argument(
        "--max-objects", type=whole(1, 1024), metavar="M", help="room for objects at a time"
    )
    track.add_argument(
        "--fps", type=positive, metavar="F", help="frames a second, where the source does not say"
    )
    track.add_argument(
        "--no-colour", action="store_true", help="track the detections alone, without pixels"
    )
    track.add_argument(
        "--truth", type=Path, metavar="FILE", help="gt.txt to score with, where none is beside img/"
    )
    track.add_argument("--no-video", action="store_true", help="do not draw tracking.mp4")
    track.add_argument(
        "--offline",
        action="store_true",
        help="write an object's first frames too, from before it was believed in",
    )
    options = parser.parse_args(arguments)
    if options.box is not None:
        for name in ("filter", "max_objects", "min_score", "no_colour", "offline"):
            if getattr(options, name):
                track.error(f"argument --{name.replace('_', '-')}: not allowed with --box")
    if options.detect and options.min_score is not None:
        track.error("argument --min-score: not allowed with --detect, which gives no scores")
    return options


def open_source(options: argparse.Namespace) -> Source:
    """Where the frames are, or a `ValueError` that names what is wrong."""
    first, last = frames.parse_range(options.frames, "--frames")
    path = options.source
    if not path.exists():
        raise ValueError(f"SOURCE: {path} is neither a video nor a folder of images")
    written = [name for name in OUTPUTS if not (options.no_video and name == VIDEO)]
    refuse_overwriting(
        options.out,
        written,
        {"SOURCE": path, "--detections": options.detections, "--truth": options.truth},
    )
    num_frames = None
    if path.is_dir():
        held = frames.num_images(path)
        if held < first:
            raise ValueError(f"SOURCE: {path} holds {held} images, and no frame {first}")
        num_frames = min(last or held, held) - first + 1
    elif last is not None:
        num_frames = last - first + 1
    rate = options.fps or frames.frame_rate(path)
    truth = find_truth(path, options.truth, first, last)
    return Source(path, first, last, num_frames, rate, truth)


def read_detections(options: argparse.Namespace, source: Source) -> np.ndarray:
    """The rows of the file of detections, without those after the frames that were asked for."""
    if not options.detections.is_file():
        raise ValueError(f"--detections: {options.detections} is not a file")
    rows = box_files.read_detections(options.detections)
    if options.min_score is not None and rows.shape[1] < 7:
        raise ValueError(f"--min-score: {options.detections} has no scores")
    return rows if source.last is None else rows[rows[:, 0] <= source.last]


def read_boxes(options: argparse.Namespace, still: np.ndarray) -> np.ndarray:
    """The drawn boxes, each of which has to lie in the first frame."""
    boxes = np.stack([box_files.parse_box(text, "--box") for text in options.box])
    height, width, _ = still.shape
    box_files.check_boxes(boxes, height, width, "--box")
    return boxes
