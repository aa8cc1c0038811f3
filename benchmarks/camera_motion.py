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

import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.harness import AtLeast2, Count, Folders, Natural, command, data, table
from benchmarks.tracking_by_detection import football
from benchmarks.tracking_by_detection.__main__ import OF_SCORES, SCORES, Motion
from mpfjax.metrics import multi_object_scores
from mpfjax.vision import OpticalFlow, read_frames, read_truth, track
from mpfjax.vision.tracking.track import online_rows

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


@command(frames=4, seeds=1)
def main(
    folders: Folders = (),
    *,
    seed: Natural = 0,
    seeds: Count = 3,
    frames: AtLeast2 = 300,
    out: Path = Path("results/camera_motion"),
) -> None:
    """Both tables, written after each recording.

    - `folders`: img/ and gt.txt.
    - `seeds`: draws of the detections.
    - `frames`: the most of a recording.
    """
    found: list[dict[str, Any]] = []
    tracked: list[dict[str, Any]] = []
    for recording in recordings(folders, seed, frames):
        found.append(accuracy(recording))
        own = range(seed, seed + seeds)
        tracked += [scores(recording, "detections", own), scores(recording, "pixels", own)]
        data(out / "camera_motion.json", found=found, tracked=tracked)
    print(table(OF_MOTION, found))
    print(table({"recording": "{recording}", "motion from": "{motion}"} | OF_SCORES, tracked))
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
    """A row of the first table."""
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


def scores(recording: Recording, motion: Motion, seeds: range) -> dict[str, Any]:
    """A row of the second table: the tracker's mean scores."""
    found = []
    for seed in seeds:
        match = football.Match(recording.name, 0, *recording.size[::-1])
        rows = football.detect(match, recording.truth, seed)
        tracked = track(iter(recording.frames), rows, camera_motion=motion)
        kept = np.concatenate([online_rows(t, tracks) for t, tracks in enumerate(tracked, 1)])
        found.append(multi_object_scores(kept, recording.truth, (1, len(recording.frames))))
    means = {name: float(np.mean([one[name] for one in found])) for name in SCORES}
    return {"recording": recording.name, "motion": motion} | means


if __name__ == "__main__":
    raise SystemExit(main())
