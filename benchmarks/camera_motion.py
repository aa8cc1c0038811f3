"""How well the camera's motion is found from pixels, what that costs, and what it does to tracks.

    python -m benchmarks.camera_motion [DIR ...]

The football scene has a camera that pans; where fixed points of its pitch are in each frame is
known. `moved` is how far those in the picture move in a frame, and `error` how far off they are by
the motion that `OpticalFlow` finds, both root mean squares in pixels. `known` is the share of
frames with a motion, and `CPU ms` the processor's time for a frame, on one thread of OpenCV. A DIR
holds img/ and gt.txt. Its true motion is not known: `moved` is the motion of the picture's centre
that was found, which is an error where the camera stands still.

Then the tracker runs with the motion from pixels and from the detections alone, on detections that
are simulated as for `benchmarks.tracking_by_detection --scene football`. Scores are means over
--seeds draws of these. Into --out DIR goes camera_motion.json.
"""

import argparse
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.tracking_by_detection import football
from mpfjax.console import exit_status, format_table, whole, write_json
from mpfjax.metrics import multi_object_scores
from mpfjax.vision import OpticalFlow, read_frames, read_truth, track
from mpfjax.vision.tracking.track import online_rows

SCORES = ("HOTA", "MOTA", "IDF1", "id_switches")


class Recording(NamedTuple):
    """Frames with the true boxes, and the true motion of fixed points where it is known."""

    name: str
    frames: Callable[[], Iterator[np.ndarray]]
    truth: np.ndarray
    num_frames: int
    size: tuple[int, int]  # width and height
    landmarks: np.ndarray | None


def recordings(folders: list[Path], seed: int, most: int) -> Iterator[Recording]:
    """The rendered matches, and the folders."""
    for match in football.MATCHES:
        length = min(most, football.NUM_FRAMES)
        scene = football.play(match, seed, length)
        size = match.width, match.height
        yield Recording(
            match.name, scene.frames.__iter__, scene.tracks, length, size, scene.landmarks
        )
    for folder in folders:
        truth = read_truth(folder).objects
        frames = [frame for frame, _ in zip(read_frames(folder), range(most), strict=False)]
        height, width, _ = frames[0].shape
        truth = truth[truth[:, 0] <= len(frames)]
        yield Recording(folder.name, frames.__iter__, truth, len(frames), (width, height), None)


def accuracy(recording: Recording) -> dict[str, Any]:
    """A row of the first table."""
    import cv2

    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    flow, moved, errors, known, seconds = OpticalFlow(), [], [], [], []
    centre = np.array([recording.size]) / 2
    for t, frame in enumerate(recording.frames()):
        boxes = recording.truth[recording.truth[:, 0] == t + 1, 2:6]
        start = time.process_time()
        motion = flow(frame, boxes)
        seconds.append(time.process_time() - start)
        if t == 0:
            continue
        known.append(bool(motion.known))
        a, b = motion.turn
        matrix = np.array([[a, -b], [b, a]])
        if recording.landmarks is None:
            moved.append(centre @ matrix.T + motion.shift - centre)
            continue
        before, after = recording.landmarks[t - 1 : t + 1]
        seen = ((before >= 0) & (before < recording.size)).all(axis=1)
        moved.append((after - before)[seen])
        if known[-1]:
            errors.append((before @ matrix.T + motion.shift - after)[seen])
    cv2.setNumThreads(threads)
    return {
        "recording": recording.name,
        "moved": _root_mean_square(moved),
        "error": _root_mean_square(errors) if errors else None,
        "known": float(np.mean(known)),
        "cpu_ms": float(1e3 * np.median(seconds[1:])),
    }


def _root_mean_square(gaps: list[np.ndarray]) -> float:
    return float(np.sqrt(np.mean(np.sum(np.concatenate(gaps) ** 2, axis=1))))


def scores(recording: Recording, motion: str, seeds: range) -> dict[str, Any]:
    """A row of the second table: the tracker's mean scores."""
    match = football.Match(recording.name, 0, recording.size[1], recording.size[0])
    found = []
    for seed in seeds:
        rows = football.detect(match, recording.truth, seed)
        tracked = track(recording.frames(), rows, camera_motion=motion)
        kept = np.concatenate([online_rows(t, tracks) for t, tracks in enumerate(tracked, 1)])
        found.append(multi_object_scores(kept, recording.truth, (1, recording.num_frames)))
    means = {name: float(np.mean([one[name] for one in found])) for name in SCORES}
    return {"recording": recording.name, "motion": motion} | means


def run(options: argparse.Namespace) -> None:
    """Both tables, written after each recording."""
    options.out.mkdir(parents=True, exist_ok=True)
    found: list[dict[str, Any]] = []
    tracked: list[dict[str, Any]] = []
    for recording in recordings(options.folders, options.seed, options.frames):
        found.append(accuracy(recording))
        for motion in ("detections", "pixels"):
            seeds = range(options.seed, options.seed + options.seeds)
            tracked.append(scores(recording, motion, seeds))
        write_json(options.out / "camera_motion.json", {"found": found, "tracked": tracked})
    print(
        format_table(
            ["recording", "moved", "error", "known", "CPU ms"],
            [
                [
                    row["recording"],
                    f"{row['moved']:.3f}",
                    "" if row["error"] is None else f"{row['error']:.3f}",
                    f"{row['known']:.2f}",
                    f"{row['cpu_ms']:.1f}",
                ]
                for row in found
            ],
        )
    )
    print(
        format_table(
            ["recording", "motion from", "HOTA", "MOTA", "IDF1", "switches"],
            [
                [
                    row["recording"],
                    row["motion"],
                    *(f"{row[name]:.3f}" for name in SCORES[:3]),
                    f"{row['id_switches']:.1f}",
                ]
                for row in tracked
            ],
        )
    )
    print(f"written to {options.out}")


def parse_arguments(arguments: list[str] | None = None) -> argparse.Namespace:
    """The arguments."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.camera_motion",
        description="The camera's motion from pixels: its error, its cost, and its use.",
    )
    parser.add_argument("folders", type=Path, nargs="*", metavar="DIR", help="img/ and gt.txt")
    parser.add_argument("--out", type=Path, default=Path("results/camera_motion"))
    parser.add_argument("--seed", type=whole(0), default=0)
    parser.add_argument("--seeds", type=whole(), default=3, help="draws of the detections")
    parser.add_argument("--frames", type=whole(2), default=300, help="the most of a recording")
    return parser.parse_args(arguments)


def main(arguments: list[str] | None = None) -> int:
    """Run the benchmark; bad input is one line on the error stream and exit status 2."""
    return exit_status(lambda: run(parse_arguments(arguments)), arguments)


if __name__ == "__main__":
    sys.exit(main())
