"""How fast the colours of many boxes are counted in one frame, beside a loop over OpenCV.

    python -m benchmarks.histograms

Both count the same pixels of the same frame, in three channels of 30 bins, for boxes of about
40 x 40 pixels, and must agree to the pixel before they are timed. Ours builds one integral
histogram for all boxes, in time that hardly depends on how many there are; OpenCV's `calcHist` is
called once a box and channel. They take turns. Into --out DIR goes histograms.json.
"""

import argparse
import platform
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import mpfjax
from mpfjax.console import exit_status, format_table, whole, write_json
from mpfjax.operations.compiling import cpu_options
from mpfjax.vision import RGBColours
from mpfjax.vision.colour.histograms import integral_histogram

COLOURS = RGBColours(30)
MEAN_SIDE, SPREAD_OF_SIDES = 40.0, 5.0


def main(arguments: list[str] | None = None) -> int:
    """Time both, print a table, and write the results."""
    options = parse(arguments)
    return exit_status(lambda: run(options), arguments)


def parse(arguments: list[str] | None) -> argparse.Namespace:
    """The options, or a message that names the one that cannot be run."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.histograms")
    parser.add_argument("--boxes", type=whole(), nargs="+", default=[300, 2100, 100_000])
    parser.add_argument("--size", type=whole(), nargs=2, default=[360, 288], metavar=("W", "H"))
    parser.add_argument("--repeats", type=whole(), default=15, help="times that each is timed")
    parser.add_argument("--out", default="results/histograms", metavar="DIR")
    return parser.parse_args(arguments)


def run(options: argparse.Namespace) -> None:
    """Each number of boxes in turn; raises `ValueError` where the counts differ."""
    width, height = options.size
    generator = np.random.default_rng(0)
    frame = generator.integers(0, 256, (height, width, 3), dtype=np.uint8)
    results = []
    for number in options.boxes:
        boxes = random_boxes(generator, number, width, height)
        results.append({"boxes": number, **timed(frame, boxes, options.repeats)})
    rows = [
        [
            str(found["boxes"]),
            *(f"{1000 * np.median(found[name]):.3g}" for name in ("integral", "opencv")),
            f"{np.median(found['opencv']) / np.median(found['integral']):.2f}",
        ]
        for found in results
    ]
    print(format_table(["boxes", "mpfjax [ms a frame]", "OpenCV [ms]", "ratio"], rows))
    out = Path(options.out)
    out.mkdir(parents=True, exist_ok=True)
    write_json(out / "histograms.json", {"settings": settings_of(options), "results": results})
    print(f"results: {out}/")


def random_boxes(generator: np.random.Generator, number: int, width: int, height: int) -> Any:
    """Boxes (x, y, w, h) about their centres, anywhere in the frame."""
    centres = generator.uniform([0, 0], [width, height], (number, 2))
    sides = generator.uniform(MEAN_SIDE - SPREAD_OF_SIDES, MEAN_SIDE + SPREAD_OF_SIDES, (number, 2))
    return np.concatenate([centres, sides], axis=1).astype(np.float32)


def timed(frame: np.ndarray, boxes: np.ndarray, repeats: int) -> dict[str, list[float]]:
    """Seconds of each run of both ways, in turns, once they agree."""
    ways = {"integral": by_integral(frame, boxes), "opencv": by_opencv(frame, boxes)}
    counts = {name: count() for name, count in ways.items()}
    if not np.array_equal(counts["integral"], counts["opencv"]):
        raise ValueError(f"boxes: the counts of {len(boxes)} differ from OpenCV's")
    elapsed: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(repeats):
        for name, count in ways.items():
            start = time.perf_counter()
            count()
            elapsed[name].append(time.perf_counter() - start)
    return elapsed


def by_integral(frame: np.ndarray, boxes: np.ndarray) -> Callable[[], np.ndarray]:
    """Integral histogram and counts in one program, (boxes, channels, bins)."""

    def count(frame: jax.Array, boxes: jax.Array) -> jax.Array:
        return integral_histogram(frame, COLOURS).counts(boxes)[:, 0]

    program = jax.jit(count, compiler_options=cpu_options())
    arrays = jax.block_until_ready((jnp.asarray(frame), jnp.asarray(boxes)))
    return lambda: np.asarray(program(*arrays))


def by_opencv(frame: np.ndarray, boxes: np.ndarray) -> Callable[[], np.ndarray]:
    """A loop over boxes and channels, on the pixels whose centres a box covers."""
    try:
        import cv2
    except ImportError as error:
        raise ImportError("OpenCV is needed here: pip install opencv-python-headless") from error
    low = np.ceil(boxes[:, :2] - boxes[:, 2:] / 2 - np.float32(0.5)).astype(int)
    high = np.ceil(boxes[:, :2] + boxes[:, 2:] / 2 - np.float32(0.5)).astype(int)
    size = frame.shape[1::-1]
    corners = np.concatenate([np.clip(low, 0, size), np.clip(high, 0, size)], axis=1).tolist()
    channels, bins = range(COLOURS.num_channels), [COLOURS.num_bins]

    def count() -> np.ndarray:
        counts = []
        for left, top, right, bottom in corners:
            pixels = np.ascontiguousarray(frame[top:bottom, left:right])
            counts.append([cv2.calcHist([pixels], [k], None, bins, [0, 256]) for k in channels])
        return np.asarray(counts).reshape(len(boxes), COLOURS.num_channels, COLOURS.num_bins)

    return count


def settings_of(options: argparse.Namespace) -> dict[str, Any]:
    """What a second run needs to be the same, and the machine."""
    return {
        "boxes": options.boxes,
        "size": options.size,
        "repeats": options.repeats,
        "jax": jax.__version__,
        "mpfjax": mpfjax.__version__,
        "machine": platform.machine(),
    }


if __name__ == "__main__":
    sys.exit(main())
