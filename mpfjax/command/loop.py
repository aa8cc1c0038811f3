"""One run of the command: read, detect, track and write, frame by frame."""

import collections
import contextlib
import itertools
import sys
import time
from argparse import Namespace
from collections.abc import Callable, Generator, Iterable, Iterator
from typing import Any

import jax
import numpy as np
from tqdm import tqdm

from mpfjax.command import FORMATS, TRACKS
from mpfjax.command.source import NO_SCORES, SCORES, SUMMARY, VIDEO, Source, open_source, read_boxes
from mpfjax.command.source import check_options as check_options
from mpfjax.console import peak_memory
from mpfjax.metrics import multi_object_scores
from mpfjax.running.storage import write_json
from mpfjax.vision.boxes.recipes import follow_boxes
from mpfjax.vision.files import boxes as box_files
from mpfjax.vision.files import drawing, frames
from mpfjax.vision.files.sequences import Truth
from mpfjax.vision.tracking.adapters import LEAST_ROOM, Rows
from mpfjax.vision.tracking.opencv import BackgroundSubtraction, OpticalFlow, has_opencv, opencv
from mpfjax.vision.tracking.state import Tracks
from mpfjax.vision.tracking.track import offline_rows, online_rows, read_ahead, track
from mpfjax.vision.tracking.tracker import ObjectTracker

# What makes tracks of stills that are seen once, one after the other, or without any.
Start = Callable[[Iterable[np.ndarray] | None], Generator[Tracks, None, None]]


def run(options: Namespace) -> None:
    """Track, and write all results so far, also where the run ends before the frames do."""
    source, tracks = open_source(options), []
    one = (source.path, source.first, source.first)
    start = _start(options, source, next(frames.read_frames(*one)) if source.has_pixels else None)
    options.out.mkdir(parents=True, exist_ok=True)
    begin = time.perf_counter()
    try:
        _track(options, source, start, tracks)
    finally:
        # Also after an interruption, or where the next frame cannot be read.
        if tracks:
            _write(options, source, tracks, time.perf_counter() - begin)


def _start(options: Namespace, source: Source, still: np.ndarray | None) -> Start:
    """The requested tracker; raises for any fault in the arguments."""
    if options.box is not None:
        if still is None:
            raise ValueError(f"--box: frame {source.first}, in which they are, cannot be decoded")
        boxes, key = read_boxes(options.box, still), jax.random.key(options.seed)
        return lambda stills: follow_boxes(stills or (), boxes, key=key, first=source.first)
    rows, deviation = None, options.point_deviation
    if source.rows is not None:
        rows = Rows(source.rows, coordinates=4 if deviation is None else 2)
    tracker = ObjectTracker(
        options.max_objects or (LEAST_ROOM if rows is None else rows.most_objects()),
        frames_per_second=source.frames_per_second,
        lost_seconds=options.lost_seconds,
        point_deviation=deviation,
    )
    detections = BackgroundSubtraction().detect if options.detect else rows
    if options.camera_motion == "pixels":
        OpticalFlow()  # an error before anything is written, where OpenCV is missing
    settings = {
        "first": source.first, "min_score": options.min_score, "frame_size": source.frame_size,
        "times": source.times if source.has_pixels and options.fps is None else None,
        "use_colours": not options.no_colour, "ahead": source.has_pixels,
        "camera_motion": "detections" if options.detect else options.camera_motion,
    }  # fmt: skip
    # Up to the last frame, also where its detections end before.
    no_pixels = itertools.repeat(None, source.num_frames or 0)
    return lambda stills: track(stills or no_pixels, detections, tracker, **settings)


def _track(options: Namespace, source: Source, start: Start, tracks: list[Tracks]) -> None:
    """The loop over frames; where a video is drawn, the tracks are made ahead of it."""
    untracked: collections.deque[np.ndarray | None] = collections.deque()
    has_video = source.has_pixels and not options.no_video

    def record(stills: Iterator[Any]) -> Iterator[Any]:
        for still in stills:
            untracked.append(still)
            yield still

    def with_stills(tracked: Iterator[Tracks]) -> Iterator[tuple[np.ndarray | None, Tracks]]:
        for each in tracked:
            yield untracked.popleft() if source.has_pixels else None, each

    def written(tracked: Iterator[Any]) -> Iterator[np.ndarray | None]:
        """The frames of the video, None where there is no picture; each leaves its lines first."""
        for still, each in tracked:
            if not tracks:
                # Until there is something to write, an older run's files stay as they are.
                (options.out / SUMMARY).unlink(missing_ok=True)
            rows = _rows([each], offline=False)
            # At once, so that a run that is killed leaves them too.
            with open(options.out / TRACKS, "a" if tracks else "w", encoding="utf-8") as file:
                file.write(box_files.format_tracks(rows))
            tracks.append(each)
            bar.update()
            yield drawing.with_tracks(still, rows) if has_video and still is not None else None

    bar = tqdm(total=source.num_frames, desc="Tracking", unit="frame", disable=None)
    with contextlib.ExitStack() as opened, bar:
        stills = None
        if source.has_pixels:
            read = frames.read_frames(source.path, source.first, source.last, times=source.times)
            stills = record(opened.enter_context(read_ahead(read)))
            # Two threads take twice the processor's time for pictures as small as those of optical
            # flow, and none less by the clock; what detects is best divided among processors.
            if not options.detect and has_opencv():
                opencv().setNumThreads(1)
        # Closed before the thread that reads ends: it may wait for a frame.
        tracked = with_stills(opened.enter_context(contextlib.closing(start(stills))))
        if has_video:
            tracked = opened.enter_context(read_ahead(tracked))
            rate = source.frames_per_second or 10.0
            frames.write_video(options.out / VIDEO, written(tracked), rate)
        else:
            collections.deque(written(tracked), maxlen=0)


def _rows(tracks: list[Tracks], offline: bool) -> np.ndarray:
    """The rows of tracks.txt, with scores and classes; those of points with sides of 0."""
    if offline:
        rows = offline_rows(tracks, described=True)
    else:
        rows = np.concatenate([online_rows(each, described=True) for each in tracks])
    return rows if rows.shape[1] == 8 else np.insert(rows, [4, 4], 0.0, axis=1)


def _write(options: Namespace, source: Source, tracks: list[Tracks], seconds: float) -> None:
    """The tracks as a whole, and summary.json."""
    rows, n = _rows(tracks, options.offline), len(tracks)
    for name in {TRACKS, FORMATS[options.format]}:
        box_files.write_tracks(options.out / name, rows)
    summary = {
        "frames": n,
        "objects": len(np.unique(rows[:, 1])),
        "frames_without_room": sum(bool(each.full) for each in tracks),
        "seconds": round(seconds, 3),
        "frames_per_second": round(n / seconds, 2),
        "peak_memory_mb": round(peak_memory(), 1),
    }
    summary |= scores_of(rows[:, :6], source.truth, source.first, source.first + n - 1)
    write_json(options.out / SUMMARY, summary)
    print(", ".join(f"{value:g} {name}" for name, value in summary.items()))
    print(f"written to {options.out}")


def scores_of(rows: np.ndarray, truth: Truth | None, first: int, last: int) -> dict[str, float]:
    """HOTA, MOTA and IDF1 of rows in these frames, where there is a truth."""
    truth = None if truth is None else truth.between(first, last)
    if truth is None or not len(truth.objects):
        return {}
    excluded = {"ignored": truth.ignored, "min_height": truth.min_height}
    try:
        scores = multi_object_scores(rows, truth.objects, **excluded)
    except (ImportError, ValueError) as error:
        print(f"{NO_SCORES}: {error}", file=sys.stderr)
        return {}
    return {name: round(scores[name], 4) for name in SCORES}
