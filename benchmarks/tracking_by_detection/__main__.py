"""Our tracker beside those that people use, on the same detections and scored alike.

    python -m benchmarks.tracking_by_detection DIR [DIR ...]
    python -m benchmarks.tracking_by_detection --scene football

Each DIR is a sequence: img/ (or img1/), gt.txt (or gt/gt.txt) and one or more files of detections,
det*.txt (or det/det.txt). Without images ours see the detections alone, as the others always do. An
ignore.txt is taken as `read_truth` does, and of several sequences the means are printed. On each
file run `mpfjax.vision.track`, which draws nothing at random, and the peers that are installed:
the SORT-like trackers of the packages `trackers` and `norfair`, with their defaults, with what
their documentation advises, and then all of them, ours
as well, with the same minimal score, that below which weaker detections are left out. It is the
threshold that parts the file's scores best in two (Otsu's). With --scene football the sequences are
rendered, and the detections simulated. One run's scores scatter: --jitters takes the means of runs
in which the detections' places and sizes are off by 1% of a box.
"""

import itertools
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from tqdm import tqdm

from benchmarks.harness import Clock, Folders, Natural, Seed, command, data, table
from benchmarks.tracking_by_detection import football
from benchmarks.tracking_by_detection.peers import Peer, installed
from mpfjax import vision
from mpfjax.metrics import multi_object_scores
from mpfjax.vision.files import frames as files
from mpfjax.vision.files import sequences
from mpfjax.vision.tracking.adapters import Rows
from mpfjax.vision.tracking.track import online_rows

Motion = Literal["pixels", "detections"]  # what the camera's motion is found from
OURS = "mpfjax"
SCORES, SPEED = ("HOTA", "MOTA", "IDF1", "id_switches"), "frames_per_second"
OF_SCORES = {name: f"{{{name}:.3f}}" for name in SCORES[:3]} | {"switches": "{id_switches:.1f}"}
COLUMNS = {name: f"{{{name}}}" for name in ("tracker", "sequence", "detections")} | OF_SCORES
COLUMNS |= {"frames/s": "{frames_per_second:.0f}"}


class Sequence(NamedTuple):
    """A folder with one of its files of detections, or a rendered scene."""

    name: str
    detections: str
    rows: np.ndarray
    truth: sequences.Truth
    first: int
    last: int
    frames_per_second: float | None
    source: Path | np.ndarray | None
    frame_size: tuple[int, int] | None = None

    def stills(self) -> Iterator[np.ndarray] | None:
        """The frames, or None where there are detections alone."""
        if self.source is None:
            return None
        if isinstance(self.source, np.ndarray):
            return iter(self.source[self.first - 1 : self.last])
        return files.read_frames(self.source, self.first, self.last)

    @property
    def scores(self) -> np.ndarray | None:
        """The scores of the detections, where there are any that differ."""
        has_scores = self.rows.shape[1] > 6 and np.ptp(self.rows[:, 6]) > 0
        return self.rows[:, 6] if has_scores else None


class Run(NamedTuple):
    """The tracks of one run, and how fast it was."""

    rows: np.ndarray
    frames_per_second: float


@command(scene="football", frames="1:6", peers=False)
def main(
    folders: Folders = (),
    *,
    scene: Annotated[str, ("football",)] | None = None,
    seed: Seed = 0,
    frames: str | None = None,
    peers: bool = True,
    camera_motion: Motion | None = None,
    jitters: Natural = 0,
    defaults: bool = False,
    out: Path = Path("results/tracking_by_detection"),
) -> None:
    """Run every tracker on every sequence, writing the table after each.

    - `folders`: img/, gt.txt, det*.
    - `scene`: rendered, in place of any folder.
    - `seed`: of the rendered scene, and of the jitters.
    - `frames`: A:B, frames A to B, counted from 1, both in.
    - `peers`: or our own tracker alone.
    - `camera_motion`: where ours has it from.
    - `jitters`: runs with boxes that are off by 1%, in place of one with them as they are.
    - `defaults`: peers at their defaults, and all scores.
    """
    if bool(folders) == (scene is not None):
        raise ValueError("one of DIR and --scene is needed, and not both")
    span = files.parse_range(frames)
    if scene is None:
        found = [each for folder in folders for each in opened(folder, *span)]
    else:
        found = [rendered(match, seed, *span) for match in football.MATCHES]
    others, rows = installed() if peers else [], []
    for sequence in found:
        own, numbers = [], [seed + 1 + number for number in range(jitters)]
        for each in [jittered(sequence, number) for number in numbers] or [sequence]:
            for name, run in runs_of(each, camera_motion, others, defaults):
                own.append(result(name, each, run))
                data(out / "tracking_by_detection.json", rows=rows + own)
        head = {"sequence": sequence.name, "detections": sequence.detections}
        rows += [head | row for row in means(own, max(jitters, 1))]
        data(out / "tracking_by_detection.json", rows=rows)
    print(table(COLUMNS, rows))
    if len(found) > 1:
        print(table({"mean of": "{tracker}"} | OF_SCORES, means(rows, len(found))))
    print(f"written to {out}")


def opened(folder: Path, first: int, last: int | None) -> list[Sequence]:
    """Every file of detections of a folder, or a `ValueError` that names what is missing."""
    if not folder.is_dir():
        raise ValueError(f"DIR: {folder} is not a folder")
    held, paths = files.num_images(folder), sequences.detection_files(folder)
    truths = [folder / name for name in ("gt.txt", "gt/gt.txt") if (folder / name).is_file()]
    if 0 < held < first or not truths or not paths:
        raise ValueError(
            f"DIR: {folder} holds {held} images, {len(paths)} files det*.txt and"
            f" {'a' if truths else 'no'} gt.txt; the files are needed, and frame {first}"
        )
    whole, info = vision.read_truth(truths[0]), sequences.read_sequence_info(folder)
    found = []
    for path in paths:
        rows = vision.read_detections(path)
        count = held or sequences.last_frame(info, rows, whole.objects)
        end = max(min(last or count, count), first)
        known = between(rows, first, end), whole.between(first, end), first, end
        known += info.frame_rate, folder if held else None, info.size
        found.append(Sequence(folder.name, path.name, *known))
    return found


def rendered(match: football.Match, seed: int, first: int, last: int | None) -> Sequence:
    """A match with the simulated detections."""
    last = last or football.NUM_FRAMES
    scene = football.play(match, seed, last)
    boxes = between(scene.tracks, first, last)
    rows, truth = football.detect(match, boxes, seed), sequences.Truth(boxes, np.zeros((0, 6)))
    rate = football.FRAMES_PER_SECOND
    return Sequence(match.name, "simulated", rows, truth, first, last, rate, scene.frames)


def jittered(sequence: Sequence, seed: int) -> Sequence:
    """With centres off by 1% of the sides, and sides by 1%."""
    rows = sequence.rows.copy()
    off = 0.01 * np.random.default_rng(seed).standard_normal((len(rows), 4))
    sides = rows[:, 4:6] * np.exp(off[:, 2:])
    rows[:, 2:4] += rows[:, 4:6] * (0.5 + off[:, :2]) - sides / 2
    rows[:, 4:6] = sides
    return sequence._replace(rows=rows)


def runs_of(
    sequence: Sequence, camera_motion: Motion | None, others: list[Peer], defaults: bool
) -> Iterator[tuple[str, Run]]:
    """The name of each tracker with its setting, and its run, made as it is asked for."""
    yield OURS, ours(sequence, None, camera_motion)
    for peer in others:
        if peer.setting == "defaults" or not defaults:
            yield f"{peer.name}, {peer.setting}", theirs(sequence, peer, None)
    if sequence.scores is not None and not defaults:
        least = otsu(sequence.scores)
        end = f"score >= {least:.3g}"
        yield f"{OURS}, {end}", ours(sequence, least, camera_motion)
        for peer in others:
            if peer.setting == "defaults":
                yield f"{peer.name}, defaults, {end}", theirs(sequence, peer, least)


def ours(sequence: Sequence, least: float | None, camera_motion: Motion | None) -> Run:
    """One run; the camera's motion is that of the options where there are pixels."""
    rows, length = Rows(sequence.rows), sequence.last - sequence.first + 1
    tracker = vision.ObjectTracker(
        rows.most_objects(), frames_per_second=sequence.frames_per_second
    )
    clock, stills = Clock("read", "track"), sequence.stills()
    tracked = vision.track(
        itertools.repeat(None, length) if stills is None else clock.over("read", stills),
        rows, tracker,
        first=sequence.first, min_score=least,
        frame_size=sequence.frame_size, camera_motion=None if stills is None else camera_motion,
    )  # fmt: skip
    kept, compiling = [], 0.0
    steps = tqdm(
        clock.over("track", tracked), total=length, desc=OURS, disable=None,
    )  # fmt: skip
    for tracks in steps:
        kept.append(online_rows(tracks))
        compiling = compiling or clock.seconds["track"]
    seconds = max(clock.seconds["track"] - compiling, 1e-9)
    return Run(np.concatenate(kept), (len(kept) - 1) / seconds)


def theirs(sequence: Sequence, peer: Peer, least: float | None) -> Run:
    """One run, which has no random numbers."""
    rows, scores = sequence.rows, sequence.scores
    scores = np.ones(len(rows)) if scores is None else scores
    if least is not None:
        rows, scores = rows[scores >= least], scores[scores >= least]
    # Thresholds that a documentation advises are for scores up to one.
    if peer.setting == "advised" and scores.max(initial=0.0) > 1:
        scores = scores / scores.max()
    step = peer.make(sequence.frames_per_second if peer.setting == "advised" else None)
    kept, seconds = [], 0.0
    for frame in range(sequence.first, sequence.last + 1):
        here = rows[:, 0] == frame
        boxes, strengths = rows[here, 2:6], scores[here]
        start = time.perf_counter()
        tracked = step(boxes, strengths)
        seconds += time.perf_counter() - start
        kept.append(np.column_stack([np.full(len(tracked), frame), tracked]))
    return Run(np.round(np.concatenate(kept), 3), len(kept) / seconds)


def otsu(scores: np.ndarray) -> float:
    """The threshold that parts scores in two classes with the most variance between them.

    Otsu (1979), over the scores themselves in place of a histogram's bins.
    """
    ordered = np.sort(scores)
    n = len(ordered)
    below = np.arange(1, n)
    sums = np.cumsum(ordered)
    means = sums[:-1] / below, (sums[-1] - sums[:-1]) / (n - below)
    between = below * (n - below) * (means[1] - means[0]) ** 2
    return float(ordered[1:][np.argmax(between)]) if n > 1 else float(ordered[0])


def result(name: str, sequence: Sequence, run: Run) -> dict[str, Any]:
    """A row of the table."""
    truth = sequence.truth.between(sequence.first, sequence.last)
    away = {"ignored": truth.ignored, "min_height": truth.min_height}
    scores = multi_object_scores(run.rows, truth.objects, **away)
    head = {"tracker": name, "sequence": sequence.name, "detections": sequence.detections}
    kept = {score: round(float(scores[score]), 4) for score in SCORES}
    return head | kept | {SPEED: round(run.frames_per_second, 1)}


def means(rows: list[dict[str, Any]], number: int) -> list[dict[str, Any]]:
    """The mean scores of each tracker that has so many rows, the best HOTA first."""
    by_name: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        by_name.setdefault(row["tracker"], []).append(row)
    found = [
        {"tracker": name} | {key: np.mean([row[key] for row in own]) for key in (*SCORES, SPEED)}
        for name, own in by_name.items()
        if len(own) == number
    ]
    return sorted(found, key=lambda row: -row["HOTA"])


def between(rows: np.ndarray, first: int, last: int) -> np.ndarray:
    """The rows of these frames."""
    return rows[(rows[:, 0] >= first) & (rows[:, 0] <= last)]


if __name__ == "__main__":
    raise SystemExit(main())
