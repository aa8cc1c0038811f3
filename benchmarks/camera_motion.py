"""How well the camera's motion is found from pixels, and what that costs.

    python -m benchmarks.camera_motion [DIR ...]

The football scene has a camera that pans; where fixed points of its pitch are in each frame is
known. `moved` is how far those in the picture move in a frame, and `error` how far off they are by
the motion that `OpticalFlow` finds, both root mean squares in pixels. `known` is the share of
frames with a motion, and `CPU ms` the processor's time for a frame, on one thread of OpenCV. A DIR
holds img/ and gt.txt. Its true motion is not known: `moved` is the motion of the picture's centre
that was found, which is an error where the camera stands still.

What it does to tracks say the scores of `python -m benchmarks.tracking_by_detection --scene
football` with --camera-motion pixels and detections. Into --out DIR goes camera_motion.json.
"""

import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.harness import AtLeast2, Folders, Natural, command, data, table
from benchmarks.tracking_by_detection import football
from mpfjax.vision import OpticalFlow, read_frames, read_truth

OF_MOTION = {
    "recording": "{recording}", "moved": "{moved:.3f}", "error": "{error:.3f}",
    "known": "{known:.2f}", "CPU ms": "{cpu_ms:.1f}",
}  # fmt: skip


class Recording(NamedTuple):
    """Frames with the true boxes, and the true motion of fixed points where it is known."""

    name: str
    frames: Sequence[np.ndarray] | np.ndarray
    truth: np.ndarray
    landmarks: np.ndarray | None

    @property
    def size(self) -> tuple[int, int]:
        """Width and height."""
        height, width, _ = self.frames[0].shape
        return width, height


@command(frames=4)
def main(
    folders: Folders = (),
    *,
    seed: Natural = 0,
    frames: AtLeast2 = 300,
    out: Path = Path("results/camera_motion"),
) -> None:
    """The table, written after each recording.

    - `folders`: img/ and gt.txt.
    - `frames`: the most of a recording.
    """
    found: list[dict[str, Any]] = []
    for recording in recordings(folders, seed, frames):
        found.append(accuracy(recording))
        data(out / "camera_motion.json", found=found)
    print(table(OF_MOTION, found))
    print(f"written to {out}")


def recordings(folders: Sequence[Path], seed: int, most: int) -> Iterator[Recording]:
    """The rendered matches, and the folders."""
    for match in football.MATCHES:
        scene = football.play(match, seed, min(most, football.NUM_FRAMES))
        yield Recording(match.name, scene.frames, scene.tracks, scene.landmarks)
    for folder in folders:
        truth = read_truth(folder).objects
        frames = [frame for frame, _ in zip(read_frames(folder), range(most), strict=False)]
        yield Recording(folder.name, frames, truth[truth[:, 0] <= len(frames)], None)


def accuracy(recording: Recording) -> dict[str, Any]:
    """A row of the table."""
    import cv2

    cv2.setNumThreads(1)
    flow, moved, errors, known, seconds = OpticalFlow(), [], [], [], []
    centre = np.array([recording.size]) / 2
    for t, frame in enumerate(recording.frames):
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
    return {
        "recording": recording.name, "moved": root_mean_square(moved),
        "error": root_mean_square(errors) if errors else None,
        "known": np.mean(known), "cpu_ms": 1e3 * np.median(seconds[1:]),
    }  # fmt: skip


def root_mean_square(gaps: list[np.ndarray]) -> float:
    """Of the lengths of all gaps."""
    return float(np.sqrt(np.mean(np.sum(np.concatenate(gaps) ** 2, axis=1))))


if __name__ == "__main__":
    raise SystemExit(main())
