"""The command: python -m mpfjax track SOURCE --out DIR, or mpfjax track SOURCE --out DIR."""

import argparse
import importlib
import re
import warnings
from pathlib import Path

from mpfjax.console import exit_status, finite, positive, say_warnings, seed, whole

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
TRACKS = "tracks.txt"
FORMATS = {"mot": TRACKS, "coco": "tracks.json", "csv": "tracks.csv"}


def main(arguments: list[str] | None = None) -> int:
    """Run the command; bad input is one line on the error stream and exit status 2."""
    parser, track = parsers()
    options = parser.parse_args(arguments)
    # Imported only now: the help does not wait for JAX.
    loop = importlib.import_module("mpfjax.command.loop")
    loop.check_options(track, options)
    with warnings.catch_warnings():
        say_warnings(RuntimeWarning)
        return exit_status(lambda: loop.run(options), arguments)


def parsers() -> tuple[argparse.ArgumentParser, argparse.ArgumentParser]:
    """The parser of the whole command line, and the one of `track`."""
    parser = argparse.ArgumentParser(prog="mpfjax", description="Particle filters that track.")
    package = importlib.import_module(__name__.partition(".")[0])
    parser.add_argument("--version", action="version", version=f"mpfjax {package.__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    track = commands.add_parser(
        "track", help="track objects in a video", description=DESCRIPTION, epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    # A box that reaches beyond the left border is no option, though it begins with a minus sign.
    track._negative_number_matcher = re.compile(r"-[\d.]")
    _add_options(track)
    return parser, track


def _add_options(track: argparse.ArgumentParser) -> None:
    """The frames and what to track in them, how to track, and what to write."""
    option, what = track.add_argument, track.add_mutually_exclusive_group().add_argument
    source = "a video, a folder of images, or detections: a file of them, or a folder with det.txt"
    option("source", type=_existing, metavar="SOURCE", help=source)
    rows = "MOTChallenge rows, with scores if any"
    what("--detections", type=_existing, metavar="FILE", help=rows)
    what("--detect", action="store_true", help="what moves; the camera stands still")
    box = "an object in the first frame; repeat it"
    what("--box", action="append", metavar="x,y,w,h", help=box)
    option("--frames", metavar="A:B", help="frames A to B, counted from 1, both in")
    option("--classes", action="store_true", help="the eighth column of detections is their class")
    points = "detections are points, rows frame,id,x,y,score,class, with errors of this deviation"
    option("--point-deviation", type=positive, metavar="S", help=points)
    option("--min-score", type=finite, metavar="S", help="leave out weaker detections")
    rate = "frames a second, where the source does not say"
    option("--fps", type=positive, metavar="F", help=rate)
    truth = "gt.txt to score with, where none is beside img/"
    option("--truth", type=_existing, metavar="FILE", help=truth)

    option("--seed", type=seed, default=0, help="of the random numbers")
    option("--max-objects", type=whole(1, 1024), metavar="M", help="room for objects at a time")
    lost = "an object ends after so long without a detection; by default after a second"
    option("--lost-seconds", type=positive, metavar="T", help=lost)
    option("--no-colour", action="store_true", help="track the detections alone, without pixels")
    motion = "what it is found from; by default from pixels, except with --detect and --no-colour"
    option("--camera-motion", choices=("pixels", "detections"), help=motion)

    option("--out", type=Path, required=True, metavar="DIR", help="where results go")
    option("--no-video", action="store_true", help="do not draw tracking.mp4")
    form = "coco and csv write tracks.json or tracks.csv beside tracks.txt"
    option("--format", choices=tuple(FORMATS), default="mot", help=form)
    offline = "write an object's first frames too, from before it was believed in"
    option("--offline", action="store_true", help=offline)


def _existing(text: str) -> Path:
    path = Path(text)
    if not path.exists():
        raise argparse.ArgumentTypeError(f"{path}: no such file or folder")
    return path
