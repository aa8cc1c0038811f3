"""How fast the object tracker is and what memory it takes: at 1080p, in small frames, without any.

    python -m benchmarks.tracking_speed

24 objects of 100 x 250 pixels walk in a rendered video of 1920 x 1080, and in the same video at
384 x 288. Without pixels there are also 60 and 150, which are smaller. Each way of tracking them is
a process of its own, so that its peak memory is its own; they take turns, so that what else the
machine does is shared by all. Making the frames is not timed, as reading them is
not; nothing is written. The first round compiles and is not counted. `frames/s` is that of the best
round. Into --out DIR goes tracking_speed.json.
"""

import itertools
import warnings
from collections.abc import Sequence
from contextlib import ExitStack
from functools import cache
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from benchmarks.harness import Count, command, data, settings_of, table
from benchmarks.peers.worker import process
from mpfjax.console import Clock, peak_memory
from mpfjax.vision import BackgroundSubtraction, ObjectTracker, track
from mpfjax.vision.tracking.adapters import LEAST_ROOM

FEW, MORE, CROWD = (3, 8), (6, 10), (10, 15)  # rows and columns of objects
BOX = 100 / 240, 250 / 360  # as shares of an object's field
LARGE, SMALL = (1080, 1920), (288, 384)
ERROR = 0.02  # of a detection, in boxes
COLUMNS = {
    "": "{way}", "detect [ms]": "{detect_ms:.2f}", "track [ms]": "{track_ms:.2f}",
    "frames/s": "{frames_per_second:.0f}",
    "x small": "{times_small:.2f}", "objects": "{objects}", "MB": "{peak_memory_mb:.0f}",
}  # fmt: skip


class Way(NamedTuple):
    """One way of tracking: in frames of a size, or None, with detections given or not."""

    name: str
    size: tuple[int, int] | None
    detect: bool = False
    fields: tuple[int, int] = FEW
    motion: Literal["detections", "pixels"] = "detections"  # what the camera's motion is found from

    @property
    def room(self) -> int:
        """Room for objects, as `mpfjax track` has it for a file with so many a frame, or none."""
        return LEAST_ROOM if self.detect else 8 * -(-3 * int(np.prod(self.fields)) // 16)


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


@command(frames=1, rounds=1)
def main(
    *, frames: Count = 20, rounds: Count = 30, out: Path = Path("results/tracking_speed")
) -> None:
    """Round after round of each way; then the table.

    - `frames`: in a round.
    - `rounds`: of each way, in turns.
    """
    settings, found = settings_of(locals()), in_turns(WAYS, frames, rounds)
    rows = [summary(way, found[way], found[WAYS[1]]) for way in WAYS]
    print(table(COLUMNS, rows))
    data(out / "tracking_speed.json", settings=settings, rows=rows)
    print(f"results: {out}/")


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
        colours = generator.choice([10, 40, 200, 240], (len(self.centres), 6, 3))
        self.clothes = colours.astype(np.uint8)

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
        self.clock, self.background = Clock("read", "detect", "track"), BackgroundSubtraction()
        street = Street(*(way.size or LARGE), way.fields)
        frames = None
        if way.size is not None:
            frames = self.clock.over("read", map(street.frame, itertools.count()))
        if way.detect:
            detections: Any = self._detect
        else:
            detections = self.clock.over("read", map(street.detected, itertools.count()))
        tracker = ObjectTracker(way.room)
        tracked = track(frames, detections, tracker, camera_motion=way.motion)
        self.tracked = self.clock.over("track", tracked)

    def _detect(self, frame: np.ndarray) -> np.ndarray:
        with self.clock.of("detect"):
            return self.background.detect(frame)

    def round(self, num_frames: int) -> dict[str, Any]:
        """Milliseconds a frame over so many more frames, and how many objects are shown."""
        before = dict(self.clock.seconds)
        for _ in range(num_frames):
            tracks = next(self.tracked)
        spent = {part: 1e3 * (self.clock.seconds[part] - before[part]) for part in before}
        return {
            "detect_ms": spent["detect"] / num_frames, "track_ms": spent["track"] / num_frames,
            "objects": int(tracks.shown.sum()), "peak_memory_mb": peak_memory(),
        }  # fmt: skip


begun = cache(Timed)  # the tracker of a process


def round_of(way: Way, num_frames: int) -> dict[str, Any]:
    """What a process does."""
    # Background subtraction finds parts of objects as well, more than there is room for.
    warnings.simplefilter("ignore", RuntimeWarning)
    return begun(way).round(num_frames)


def in_turns(
    ways: Sequence[Way], num_frames: int, num_rounds: int
) -> dict[Way, list[dict[str, Any]]]:
    """What each round of each way took, the first of them left out."""
    rounds: dict[Way, list[dict[str, Any]]] = {way: [] for way in ways}
    with ExitStack() as stack:
        pools = {way: stack.enter_context(process()) for way in ways}
        for number in range(1 + num_rounds):
            for way, pool in pools.items():
                try:
                    found = pool.submit(round_of, way, num_frames).result()
                except Exception as error:
                    raise ValueError(f"{way.name}: {error}") from error
                if number > 0:
                    rounds[way].append(found)
    return rounds


def summary(
    way: Way, rounds: list[dict[str, Any]], rounds_of_small: list[dict[str, Any]]
) -> dict[str, Any]:
    """The best round, the memory, and the time as a multiple of that in small frames."""
    best = min(rounds, key=milliseconds)
    return {
        "way": way.name,
        "detect_ms": round(best["detect_ms"], 3),
        "track_ms": round(best["track_ms"], 3),
        "frames_per_second": round(1e3 / milliseconds(best), 1),
        "times_small": round(milliseconds(best) / min(map(milliseconds, rounds_of_small)), 3),
        "objects": rounds[-1]["objects"],
        "peak_memory_mb": round(max(found["peak_memory_mb"] for found in rounds), 1),
    }


def milliseconds(found: dict[str, Any]) -> float:
    """Of a frame in a round."""
    return found["detect_ms"] + found["track_ms"]


if __name__ == "__main__":
    raise SystemExit(main())
