"""How fast the object tracker is and what memory it takes: at 1080p, and without pixels.

    python -m benchmarks.tracking_speed

24 objects of 100 x 250 pixels walk in a rendered video of 1920 x 1080. Without pixels there are
also 60 and 150, which are smaller. Each way of tracking them is a process of its own, so that its
peak memory is its own; they take turns, so that what else the machine does is shared by all. Making
the frames is not timed, as reading them is not; nothing is written. The first round is not counted.
`ratio` is the time over that of 24 objects without pixels, `frames/s` that of the best round. Into
--out DIR goes tracking_speed.json.
"""

import itertools
from collections.abc import Sequence
from contextlib import ExitStack
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.harness import Clock, Count, command, data, settings_of, table
from benchmarks.peers.worker import process
from mpfjax.console import peak_memory
from mpfjax.vision import ObjectTracker, track

FEW, MORE, CROWD = (3, 8), (6, 10), (10, 15)  # rows and columns of objects
BOX = 100 / 240, 250 / 360  # as shares of an object's field
HEIGHT, WIDTH = 1080, 1920
ERROR = 0.02  # of a detection, in boxes
COLUMNS = {
    "": "{way}", "ms": "{track_ms:.2f}", "ratio": "{ratio:.2f}",
    "frames/s": "{frames_per_second:.0f}", "objects": "{objects}", "MB": "{peak_memory_mb:.0f}",
}  # fmt: skip


class Way(NamedTuple):
    """One way of tracking: with pixels or without, so many objects."""

    name: str
    has_pixels: bool = False
    fields: tuple[int, int] = FEW

    @property
    def room(self) -> int:
        """Room for objects, as `mpfjax track` has it for a file with so many a frame."""
        return 8 * -(-3 * int(np.prod(self.fields)) // 16)


WAYS = (
    Way("no pixels"),
    Way("1920 x 1080", has_pixels=True),
    Way("no pixels, 60 objects", fields=MORE),
    Way("no pixels, 150 objects", fields=CROWD),
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
    rows = [summary(way, found[way], found[WAYS[0]]) for way in WAYS]
    print(table(COLUMNS, rows))
    data(out / "tracking_speed.json", settings=settings, rows=rows)
    print(f"results: {out}/")


class Street:
    """A video of so many objects, each of which walks to and fro in a field of its own."""

    def __init__(self, fields: tuple[int, int]) -> None:
        generator = np.random.default_rng(0)
        rows, columns = fields
        field = np.array([WIDTH / columns, HEIGHT / rows])
        where = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).reshape(-1, 2)
        self.centres = (where + 0.5) * field
        self.box = np.round(np.array(BOX) * field)
        self.reach = 0.5 * (field - self.box) * [0.9, 0.5]
        self.phases = generator.uniform(0, 2 * np.pi, (len(self.centres), 2))
        blocks = generator.integers(90, 130, (HEIGHT // 12 + 1, WIDTH // 12 + 1, 3))
        self.background = blocks.repeat(12, 0).repeat(12, 1)[:HEIGHT, :WIDTH].astype(np.uint8)
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
        self.clock, street, frames = Clock("read", "track"), Street(way.fields), None
        if way.has_pixels:
            frames = self.clock.over("read", map(street.frame, itertools.count()))
        detections = self.clock.over("read", map(street.detected, itertools.count()))
        tracked = track(frames, detections, ObjectTracker(way.room), camera_motion="detections")
        self.tracked = self.clock.over("track", tracked)

    def round(self, num_frames: int) -> dict[str, Any]:
        """Milliseconds a frame over so many more frames, and how many objects are shown."""
        before = self.clock.seconds["track"]
        for _ in range(num_frames):
            tracks = next(self.tracked)
        milliseconds = 1e3 * (self.clock.seconds["track"] - before) / num_frames
        return {
            "track_ms": milliseconds, "objects": int(tracks.shown.sum()),
            "peak_memory_mb": peak_memory(),
        }  # fmt: skip


begun = cache(Timed)  # the tracker of a process


def round_of(way: Way, num_frames: int) -> dict[str, Any]:
    """What a process does."""
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
    way: Way, rounds: list[dict[str, Any]], rounds_of_first: list[dict[str, Any]]
) -> dict[str, Any]:
    """The best round, the memory, and the time as a multiple of that of the first way."""
    best, best_of_first = (
        min(each["track_ms"] for each in found) for found in (rounds, rounds_of_first)
    )
    return {
        "way": way.name,
        "track_ms": round(best, 3),
        "ratio": round(best / best_of_first, 3),
        "frames_per_second": round(1e3 / best, 1),
        "objects": rounds[-1]["objects"],
        "peak_memory_mb": round(max(found["peak_memory_mb"] for found in rounds), 1),
    }


if __name__ == "__main__":
    raise SystemExit(main())
