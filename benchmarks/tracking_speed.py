"""How fast the object tracker is and what memory it takes: at 1080p, in small frames, without any.

    python -m benchmarks.tracking_speed

24 objects of 100 x 250 pixels walk before a still camera in a rendered video of 1920 x 1080, and in
the same video at 384 x 288. Without pixels there are also 60 and 150, which are smaller. Each way
of tracking them is a process of its own, so that its peak memory is its own; they take turns, so
that what else the machine does is shared by all. Making the frames is not timed, as reading them is
not; nothing is written. The first round compiles and is not counted. `frames/s` is that of the best
round. Into --out DIR goes tracking_speed.json.
"""

import argparse
import multiprocessing
import os
import platform
import sys
import warnings
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

import mpfjax
from mpfjax.console import Clock, exit_status, format_table, peak_memory, whole, write_json
from mpfjax.vision.tracking.adapters import LEAST_ROOM
from mpfjax.vision.tracking.background import BackgroundSubtraction
from mpfjax.vision.tracking.track import track
from mpfjax.vision.tracking.tracker import ObjectTracker

FEW, MORE, CROWD = (3, 8), (6, 10), (10, 15)  # rows and columns of objects
BOX = 100 / 240, 250 / 360  # as shares of an object's field
LARGE, SMALL = (1080, 1920), (288, 384)
ERROR = 0.02  # of a detection, in boxes


class Way(NamedTuple):
    """One way of tracking: in frames of a size, or None, with detections given or not."""

    name: str
    size: tuple[int, int] | None
    detect: bool = False
    fields: tuple[int, int] = FEW
    motion: str = "detections"  # what the camera's motion is found from

    @property
    def num_objects(self) -> int:
        """As many as there are fields."""
        return self.fields[0] * self.fields[1]

    @property
    def room(self) -> int:
        """Room for objects, as `mpfjax track` has it for a file with so many a frame, or none."""
        return LEAST_ROOM if self.detect else 8 * -(-3 * self.num_objects // 16)


WAYS = (
    Way("1920 x 1080", LARGE),
    Way("384 x 288", SMALL),
    Way("1920 x 1080, --detect", LARGE, detect=True),
    Way("no pixels", None),
    Way("no pixels, 60 objects", None, fields=MORE),
    Way("no pixels, 150 objects", None, fields=CROWD),
    Way("1920 x 1080, camera motion from pixels", LARGE, motion="pixels"),
    Way("384 x 288, camera motion from pixels", SMALL, motion="pixels"),
)


class Street:
    """A video of so many objects, each of which walks to and fro in a field of its own."""

    def __init__(self, height: int, width: int, fields: tuple[int, int] = FEW) -> None:
        generator = np.random.default_rng(0)
        rows, columns = fields
        field = np.array([width / columns, height / rows])
        where = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).reshape(-1, 2)
        self.centres = (where + 0.5) * field
        self.box = np.round(np.array(BOX) * field)
        self.reach = 0.5 * (field - self.box) * [0.9, 0.5]
        self.phases = generator.uniform(0, 2 * np.pi, (len(self.centres), 2))
        blocks = generator.integers(90, 130, (height // 12 + 1, width // 12 + 1, 3))
        self.background = blocks.repeat(12, 0).repeat(12, 1)[:height, :width].astype(np.uint8)
        # Dark or bright clothes before a middling background, from head to foot.
        self.clothes = generator.choice([10, 40, 200, 240], (len(self.centres), 6, 3)).astype(
            np.uint8
        )

    def boxes(self, t: int) -> np.ndarray:
        """(x, y, w, h) of each object, whole pixels."""
        centres = self.centres + self.reach * np.sin(0.1 * t + self.phases)
        corners = np.round(centres - self.box / 2)
        return np.concatenate([corners, np.tile(self.box, (len(self.centres), 1))], axis=1)

    def detected(self, t: int) -> tuple[np.ndarray, np.ndarray]:
        """Boxes with errors, and scores."""
        noise = np.random.default_rng(t).normal(0, ERROR, (len(self.centres), 4))
        return self.boxes(t) + noise * np.tile(self.box, 2), np.full(len(self.centres), 0.9)

    def frame(self, t: int) -> np.ndarray:
        """The picture; in the first, nobody is there yet."""
        frame = self.background.copy()
        for (x, y, w, h), clothes in zip(self.boxes(t).astype(int), self.clothes, strict=True):
            if t > 0:
                bands = clothes[np.arange(h) * len(clothes) // h]
                frame[y : y + h, x : x + w] = bands[:, None]
        return frame


class Timed:
    """A tracker at work on a street that has no end, and what it took."""

    def __init__(self, way: Way) -> None:
        self.clock = Clock("read", "detect", "track")
        street = Street(*(way.size or LARGE), way.fields)
        frames = None
        if way.size is not None:
            frames = self.clock.over("read", map(street.frame, _count()))
        if way.detect:
            detections: Any = self._detecting(BackgroundSubtraction())
        else:
            detections = self.clock.over("read", map(street.detected, _count()))
        tracker = ObjectTracker(way.room)
        tracked = track(frames, detections, tracker, camera_motion=way.motion)
        self.tracked = self.clock.over("track", tracked)

    def _detecting(self, background: BackgroundSubtraction) -> Callable[[np.ndarray], np.ndarray]:
        def detect(frame: np.ndarray) -> np.ndarray:
            with self.clock.of("detect"):
                return background.detect(frame)

        return detect

    def round(self, num_frames: int) -> dict[str, Any]:
        """Milliseconds a frame over so many more frames, and how many objects are shown."""
        before = dict(self.clock.seconds)
        for _ in range(num_frames):
            tracks = next(self.tracked)
        spent = {part: 1e3 * (self.clock.seconds[part] - before[part]) for part in before}
        return {
            "detect_ms": spent["detect"] / num_frames,
            "track_ms": spent["track"] / num_frames,
            "objects": int(tracks.shown.sum()),
            "peak_memory_mb": peak_memory(),
        }


def _count() -> Iterator[int]:
    t = 0
    while True:
        yield t
        t += 1


def serve(way: Way, pipe: Connection) -> None:
    """A process's end: a round for each number of frames that is asked for, until None."""
    # Background subtraction finds parts of objects as well, more than there is room for.
    warnings.simplefilter("ignore", RuntimeWarning)
    timed = Timed(way)
    while (num_frames := pipe.recv()) is not None:
        pipe.send(timed.round(num_frames))


def main(arguments: list[str] | None = None) -> int:
    """Time every way, print a table, and write the results."""
    options = parse(arguments)
    return exit_status(lambda: run(options), arguments)


def parse(arguments: list[str] | None) -> argparse.Namespace:
    """The options, or a message that names the one that cannot be run."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.tracking_speed")
    parser.add_argument("--frames", type=whole(), default=20, help="frames in a round")
    parser.add_argument("--rounds", type=whole(), default=30, help="rounds of each way, in turns")
    parser.add_argument("--out", default="results/tracking_speed", metavar="DIR")
    return parser.parse_args(arguments)


def run(options: argparse.Namespace) -> None:
    """Round after round of each way; then the table."""
    rounds = in_turns(WAYS, options.frames, options.rounds)
    results = [summary(way, rounds[way], rounds[WAYS[1]]) for way in WAYS]
    print(table(results))
    out = Path(options.out)
    out.mkdir(parents=True, exist_ok=True)
    write_json(out / "tracking_speed.json", {"settings": settings_of(options), "rows": results})
    print(f"results: {out}/")


def in_turns(
    ways: tuple[Way, ...], num_frames: int, num_rounds: int
) -> dict[Way, list[dict[str, Any]]]:
    """What each round of each way took, the first of them left out."""
    context = multiprocessing.get_context("spawn")
    pipes: dict[Way, Any] = {}
    processes = []
    for way in ways:
        pipes[way], end = context.Pipe()
        processes.append(context.Process(target=serve, args=(way, end), daemon=True))
        processes[-1].start()
        end.close()  # or nobody would hear of it where the process ends
    rounds: dict[Way, list[dict[str, Any]]] = {way: [] for way in ways}
    try:
        for number in range(1 + num_rounds):
            for way, pipe in pipes.items():
                pipe.send(num_frames)
                found = _answer(pipe, way)
                if number > 0:
                    rounds[way].append(found)
        for pipe in pipes.values():
            pipe.send(None)
    finally:
        for process in processes:
            process.join(timeout=10)
            process.kill()
    return rounds


def _answer(pipe: Connection, way: Way) -> dict[str, Any]:
    try:
        return pipe.recv()
    except (EOFError, ConnectionError) as error:
        raise ValueError(f"{way.name}: its process ended before its time") from error


def summary(
    way: Way, rounds: list[dict[str, Any]], rounds_of_small: list[dict[str, Any]]
) -> dict[str, Any]:
    """The best round, the memory, and the time as a multiple of that in small frames."""
    best = min(rounds, key=_milliseconds)
    ratio = _milliseconds(best) / min(map(_milliseconds, rounds_of_small))
    return {
        "way": way.name,
        "detect_ms": round(best["detect_ms"], 3),
        "track_ms": round(best["track_ms"], 3),
        "frames_per_second": round(1e3 / _milliseconds(best), 1),
        "median_frames_per_second": round(1e3 / np.median([*map(_milliseconds, rounds)]), 1),
        "times_small": round(ratio, 3),
        "objects": rounds[-1]["objects"],
        "peak_memory_mb": round(max(found["peak_memory_mb"] for found in rounds), 1),
    }


def _milliseconds(found: dict[str, Any]) -> float:
    return found["detect_ms"] + found["track_ms"]


def table(results: list[dict[str, Any]]) -> str:
    """The results as text."""
    header = ["", "detect [ms]", "track [ms]", "frames/s", "median", "x small", "objects", "MB"]
    return format_table(
        header,
        [
            [
                row["way"],
                f"{row['detect_ms']:.2f}",
                f"{row['track_ms']:.2f}",
                f"{row['frames_per_second']:.0f}",
                f"{row['median_frames_per_second']:.0f}",
                f"{row['times_small']:.2f}",
                str(row["objects"]),
                f"{row['peak_memory_mb']:.0f}",
            ]
            for row in results
        ],
    )


def settings_of(options: argparse.Namespace) -> dict[str, Any]:
    """What a second run needs to be the same, and the machine."""
    return {
        "frames": options.frames,
        "rounds": options.rounds,
        "jax": jax.__version__,
        "mpfjax": mpfjax.__version__,
        "machine": platform.machine(),
        "processors": os.cpu_count(),
    }


if __name__ == "__main__":
    sys.exit(main())
