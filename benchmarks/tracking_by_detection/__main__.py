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
threshold that parts the file's scores best in two (Otsu's), unless --min-score gives one. With
--scene football the sequences are rendered, and the detections simulated.
"""

import argparse
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from tqdm import tqdm

from benchmarks.tracking_by_detection import football
from benchmarks.tracking_by_detection.peers import Peer, peers
from mpfjax.console import (
    Clock,
    exit_status,
    finite,
    format_table,
    positive,
    seed,
    whole,
    write_json,
)
from mpfjax.metrics import multi_object_scores
from mpfjax.vision.files import boxes as box_files
from mpfjax.vision.files import frames
from mpfjax.vision.files.sequences import (
    Truth,
    detection_files,
    last_frame,
    read_sequence_info,
    read_truth,
)
from mpfjax.vision.tracking.adapters import Rows
from mpfjax.vision.tracking.track import online_rows, track
from mpfjax.vision.tracking.tracker import ObjectTracker

OURS = "mpfjax"
SCORES = ("HOTA", "MOTA", "IDF1", "id_switches")
COLUMNS = ("tracker", "sequence", "detections", *SCORES, "frames_per_second")


class Sequence(NamedTuple):
    """A folder with one of its files of detections, or a rendered scene."""

    name: str
    detections: str
    rows: np.ndarray
    truth: Truth
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
        return frames.read_frames(self.source, self.first, self.last)


class Run(NamedTuple):
    """The tracks of one run, and how fast it was."""

    rows: np.ndarray
    frames_per_second: float


def parse_arguments(arguments: list[str] | None = None) -> argparse.Namespace:
    """The arguments, each checked as far as it can be without the sequences."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.tracking_by_detection",
        description="Our tracker beside those that people use, on the same detections.",
    )
    parser.add_argument("sequences", type=Path, nargs="*", metavar="DIR", help="img/, gt.txt, det*")
    parser.add_argument("--scene", choices=("football",), help="rendered, in place of any DIR")
    parser.add_argument("--out", type=Path, default=Path("results/tracking_by_detection"))
    parser.add_argument("--seed", type=seed, default=0, help="of the rendered scene")
    parser.add_argument("--seeds", type=whole(), default=1, help="nothing is drawn: one will do")
    parser.add_argument("--frames", metavar="A:B", help="frames A to B, counted from 1, both in")
    parser.add_argument("--fps", type=positive, help="frames a second, where nothing says it")
    parser.add_argument(
        "--min-score", type=finite, metavar="S", help="the same minimal score for all"
    )
    parser.add_argument("--no-peers", action="store_true", help="our own tracker alone")
    parser.add_argument("--no-colour", action="store_true", help="ours on the detections alone")
    parser.add_argument(
        "--camera-motion", choices=("pixels", "detections"), help="where ours has it from"
    )
    options = parser.parse_args(arguments)
    if bool(options.sequences) == (options.scene is not None):
        parser.error("one of DIR and --scene is needed, and not both")
    return options


def open_sequences(options: argparse.Namespace) -> list[Sequence]:
    """Every file of detections of every folder, or a `ValueError` that names what is missing."""
    first, last = frames.parse_range(options.frames, "--frames")
    if options.scene is not None:
        return [_rendered(match, options.seed, first, last) for match in football.MATCHES]
    found = []
    for folder in options.sequences:
        if not folder.is_dir():
            raise ValueError(f"DIR: {folder} is not a folder")
        held = frames.num_images(folder)
        truth_path = _first_file(folder, "gt.txt", "gt/gt.txt")
        files = detection_files(folder)
        if 0 < held < first or truth_path is None or not files:
            raise ValueError(
                f"DIR: {folder} holds {held} images, {len(files)} files det*.txt and"
                f" {'a' if truth_path else 'no'} gt.txt; the files are needed, and frame {first}"
            )
        whole = read_truth(truth_path)
        info = read_sequence_info(folder)
        for path in files:
            rows = box_files.read_detections(path)
            count = held or last_frame(info, rows, whole.objects)
            end = max(min(last or count, count), first)
            source = folder if held else None
            rows, truth = _between(rows, first, end), whole.between(first, end)
            rate = options.fps or info.frame_rate
            where = (first, end, rate, source, info.size)
            found.append(Sequence(folder.name, path.name, rows, truth, *where))
    return found


def _rendered(match: football.Match, seed: int, first: int, last: int | None) -> Sequence:
    """A match with the simulated detections."""
    last = football.NUM_FRAMES if last is None else last
    scene = football.play(match, seed, last)
    truth = _between(scene.tracks, first, last)
    rows = football.detect(match, truth, seed)
    rate = football.FRAMES_PER_SECOND
    truth = Truth(truth, np.zeros((0, 6)))
    return Sequence(match.name, "simulated", rows, truth, first, last, rate, scene.frames)


def run(options: argparse.Namespace) -> None:
    """Run every tracker on every sequence, writing the table after each."""
    sequences = open_sequences(options)
    others = [] if options.no_peers else peers()
    results: list[dict[str, Any]] = []
    options.out.mkdir(parents=True, exist_ok=True)
    for sequence in sequences:
        for name, run in _runs(options, sequence, others):
            results.append(_result(name, sequence, run))
            write_json(options.out / "tracking_by_detection.json", {"rows": results})
    print(table(results))
    if len(sequences) > 1:
        print(means(results, len(sequences)))
    print(f"written to {options.out}")


def _runs(
    options: argparse.Namespace, sequence: Sequence, others: list[Peer]
) -> Iterator[tuple[str, Run]]:
    """The name of each tracker with its setting, and its run, made as it is asked for."""
    least = options.min_score
    if least is None and _scores(sequence.rows) is not None:
        least = otsu(sequence.rows[:, 6])
    yield OURS, _ours(options, sequence, None)
    for peer in others:
        yield f"{peer.name}, {peer.setting}", _theirs(sequence, peer, None)
    if least is not None:
        yield f"{OURS}, score >= {least:.3g}", _ours(options, sequence, least)
        for peer in others:
            if peer.setting == "defaults":
                name = f"{peer.name}, defaults, score >= {least:.3g}"
                yield name, _theirs(sequence, peer, least)


def _ours(options: argparse.Namespace, sequence: Sequence, least: float | None) -> Run:
    """One run, which has no random numbers; compiling, in the first frame, is not timed."""
    rows = Rows(sequence.rows, sequence.first, sequence.last)
    tracker = ObjectTracker(rows.most_objects(), frames_per_second=sequence.frames_per_second)
    clock, stills = Clock("read", "track"), sequence.stills()
    tracked = track(
        None if stills is None else clock.over("read", stills), rows, tracker,
        first=sequence.first, min_score=least, use_colours=not options.no_colour,
        frame_size=sequence.frame_size, camera_motion=_camera_motion(options, sequence),
    )  # fmt: skip
    kept, compiling = [], 0.0
    bar = tqdm(total=sequence.last - sequence.first + 1, desc=OURS, disable=None)
    for frame, tracks in enumerate(clock.over("track", tracked), sequence.first):
        kept.append(online_rows(frame, tracks))
        compiling = compiling or clock.seconds["track"]
        bar.update()
    bar.close()
    return Run(np.concatenate(kept), _rate(len(kept) - 1, clock.seconds["track"] - compiling))


def _camera_motion(options: argparse.Namespace, sequence: Sequence) -> str | None:
    """That of the options, where there are pixels to have it from."""
    return None if sequence.source is None else options.camera_motion


def _theirs(sequence: Sequence, peer: Peer, least: float | None) -> Run:
    """One run, which has no random numbers."""
    rows, scores = sequence.rows, _scores(sequence.rows)
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
    return Run(np.round(np.concatenate(kept), 3), _rate(len(kept), seconds))


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


def _result(name: str, sequence: Sequence, run: Run) -> dict[str, Any]:
    span = (sequence.first, sequence.last)
    truth = sequence.truth
    away = {"ignored": truth.ignored, "min_height": truth.min_height}
    scores = multi_object_scores(run.rows, truth.objects, span, **away)
    result: dict[str, Any] = {
        "tracker": name,
        "sequence": sequence.name,
        "detections": sequence.detections,
    }
    result |= {score: round(float(scores[score]), 4) for score in SCORES}
    return result | {"frames_per_second": round(run.frames_per_second, 1)}


def table(results: list[dict[str, Any]]) -> str:
    """The results as text, the best HOTA first in each cell."""
    cells = list(dict.fromkeys((row["sequence"], row["detections"]) for row in results))
    ordered = sorted(
        results, key=lambda row: (cells.index((row["sequence"], row["detections"])), -row["HOTA"])
    )
    lines = [
        [
            *(row[column] for column in COLUMNS[:3]),
            *(f"{row[column]:.3f}" for column in SCORES[:3]),
            f"{row['id_switches']:.1f}",
            f"{row['frames_per_second']:.0f}",
        ]
        for row in ordered
    ]
    header = ["tracker", "sequence", "detections", "HOTA", "MOTA", "IDF1", "switches", "frames/s"]
    return format_table(header, lines)


def means(results: list[dict[str, Any]], num_sequences: int) -> str:
    """The mean of each tracker's scores over all sequences, as text, the best HOTA first."""
    by_name: dict[str, list[dict[str, Any]]] = {}
    for row in results:
        by_name.setdefault(row["tracker"], []).append(row)
    lines = []
    for name, rows in by_name.items():
        if len(rows) == num_sequences:
            mean = {score: float(np.mean([row[score] for row in rows])) for score in SCORES}
            lines.append((mean, [name, *(f"{mean[score]:.3f}" for score in SCORES[:3])]))
            lines[-1][1].append(f"{mean['id_switches']:.1f}")
    lines.sort(key=lambda line: -line[0]["HOTA"])
    return format_table(["mean of", "HOTA", "MOTA", "IDF1", "switches"], [row for _, row in lines])


def _scores(rows: np.ndarray) -> np.ndarray | None:
    """The scores, where there are any that differ."""
    return rows[:, 6] if rows.shape[1] > 6 and np.ptp(rows[:, 6]) > 0 else None


def _between(rows: np.ndarray, first: int, last: int) -> np.ndarray:
    return rows[(rows[:, 0] >= first) & (rows[:, 0] <= last)]


def _first_file(folder: Path, *names: str) -> Path | None:
    return next((folder / name for name in names if (folder / name).is_file()), None)


def _rate(count: int, seconds: float) -> float:
    return count / seconds if seconds > 0 else 0.0


def main(arguments: list[str] | None = None) -> int:
    """Run the benchmark; bad input is one line on the error stream and exit status 2."""
    return exit_status(lambda: run(parse_arguments(arguments)), arguments)


if __name__ == "__main__":
    sys.exit(main())
