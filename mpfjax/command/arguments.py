"""The arguments of the command."""

import argparse
import importlib
import re
from pathlib import Path

from mpfjax.console import finite, positive, seed, whole

DESCRIPTION = """\
Track objects in a video or a folder of images. What to track comes from one of three: detections
in a file, whatever moves while the camera stands still, or boxes drawn in the first frame. A file
of detections alone, or a folder with such a file and no images, is tracked without pixels.
"""
EXAMPLES = """\
examples:
  mpfjax track match.mp4 --detections match.txt --out tracks
  mpfjax track match.txt --fps 25 --out tracks
  mpfjax track street/ --detect --out tracks
  mpfjax track street/ --box 120,80,30,70 --box 200,90,28,66 --out tracks
"""

SOURCE = "a video, a folder of images, or detections: a file of them, or a folder with det.txt"
TRACKS = "tracks.txt"
FORMATS = {"mot": TRACKS, "coco": "tracks.json", "csv": "tracks.csv"}


def parsers() -> tuple[argparse.ArgumentParser, argparse.ArgumentParser]:
    """The parser of the whole command line, and the one of `track`."""
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
    # A box that reaches beyond the left border is no option, though it begins with a minus sign.
    track._negative_number_matcher = re.compile(r"-[\d.]")
    _add_input(track)
    _add_tracking(track)
    _add_output(track)
    return parser, track


def _add_input(track: argparse.ArgumentParser) -> None:
    """The frames, and what to track in them."""
    track.add_argument("source", type=_existing, metavar="SOURCE", help=SOURCE)
    what = track.add_mutually_exclusive_group()
    what.add_argument(
        "--detections", type=_existing, metavar="FILE", help="MOTChallenge rows, with scores if any"
    )
    what.add_argument("--detect", action="store_true", help="what moves; the camera stands still")
    what.add_argument(
        "--box", action="append", metavar="x,y,w,h", help="an object in the first frame; repeat it"
    )
    track.add_argument("--frames", metavar="A:B", help="frames A to B, counted from 1, both in")
    track.add_argument(
        "--classes", action="store_true", help="the eighth column of detections is their class"
    )
    track.add_argument(
        "--point-deviation",
        type=positive,
        metavar="S",
        help="detections are points, rows frame,id,x,y,score,class, with errors of this deviation",
    )
    track.add_argument("--min-score", type=finite, metavar="S", help="leave out weaker detections")
    track.add_argument(
        "--fps", type=positive, metavar="F", help="frames a second, where the source does not say"
    )
    truth = "gt.txt to score with, where none is beside img/"
    track.add_argument("--truth", type=_existing, metavar="FILE", help=truth)


def _add_tracking(track: argparse.ArgumentParser) -> None:
    """How to track."""
    track.add_argument("--seed", type=seed, default=0, help="of the random numbers")
    track.add_argument(
        "--max-objects", type=whole(1, 1024), metavar="M", help="room for objects at a time"
    )
    track.add_argument(
        "--lost-seconds",
        type=positive,
        metavar="T",
        help="an object ends after so long without a detection; by default after a second",
    )
    track.add_argument(
        "--no-colour", action="store_true", help="track the detections alone, without pixels"
    )
    track.add_argument(
        "--camera-motion",
        choices=("pixels", "detections"),
        help="what it is found from; by default from pixels, except with --detect and --no-colour",
    )


def _add_output(track: argparse.ArgumentParser) -> None:
    """What to write."""
    track.add_argument("--out", type=Path, required=True, metavar="DIR", help="where results go")
    track.add_argument("--no-video", action="store_true", help="do not draw tracking.mp4")
    track.add_argument(
        "--format",
        choices=tuple(FORMATS),
        default="mot",
        help="coco and csv write tracks.json or tracks.csv beside tracks.txt",
    )
    track.add_argument(
        "--offline",
        action="store_true",
        help="write an object's first frames too, from before it was believed in",
    )


def _existing(text: str) -> Path:
    path = Path(text)
    if not path.exists():
        raise argparse.ArgumentTypeError(f"{path}: no such file or folder")
    return path
