"""One run of the command: read, detect, track and write, frame by frame."""

import argparse
import collections
import contextlib
import sys
from collections.abc import Callable, Generator, Iterable, Iterator
from typing import Any

import jax
import numpy as np
from tqdm import tqdm

from mpfjax.command.arguments import FORMATS, TRACKS
from mpfjax.command.source import (
    NO_SCORES,
    SCORES,
    SUMMARY,
    VIDEO,
    Source,
    open_source,
    read_boxes,
)
from mpfjax.command.source import check_options as check_options
from mpfjax.console import Clock, peak_memory
from mpfjax.metrics import multi_object_scores
from mpfjax.running.storage import write_json
from mpfjax.vision.boxes.following import follow_boxes
from mpfjax.vision.files import boxes as box_files
from mpfjax.vision.files import drawing, frames
from mpfjax.vision.files.sequences import Truth
from mpfjax.vision.files.threads import read_ahead
from mpfjax.vision.tracking.adapters import LEAST_ROOM, Rows
from mpfjax.vision.tracking.background import BackgroundSubtraction
from mpfjax.vision.tracking.optical_flow import OpticalFlow, has_opencv, opencv
from mpfjax.vision.tracking.state import Tracks
from mpfjax.vision.tracking.track import offline_rows, online_rows, track
from mpfjax.vision.tracking.tracker import ObjectTracker


class Results:
    """The output of a run: rows as they come, the video, and the summary at the end."""

    def __init__(self, options: argparse.Namespace, source: Source) -> None:
        self.options, self.source = options, source
        # Of the threads that read and look at frames, that track, and that write.
        self.ahead, self.clock = Clock("read", "detect"), Clock("track")
        self.last = Clock("write", "wait")
        self.rows: list[np.ndarray] = []
        self.offline_tracks: list[Tracks] = []  # for --offline alone
        self.times: list[float] = []  # of the frames of a video
        self.num_frames = 0
        self.without_room = 0  # frames with more objects than there is room for
        self.left_out = 0  # detections that could not be tracked

    def add(self, tracks: Tracks) -> np.ndarray:
        """Keep a frame's tracks, and return its rows."""
        rows = _with_sizes(online_rows(tracks, described=True))
        self.rows.append(rows)
        if self.options.offline:
            self.offline_tracks.append(tracks)
        self.num_frames += 1
        self.without_room += bool(tracks.full)
        self.left_out += tracks.left_out
        return rows

    def all_rows(self) -> np.ndarray:
        """The rows of tracks.txt, with scores and classes."""
        if self.options.offline:
            return _with_sizes(offline_rows(self.offline_tracks, described=True))
        return np.concatenate([np.zeros((0, 8)), *self.rows])

    def summary(self) -> dict[str, Any]:
        """The content of summary.json."""
        rows, n = self.all_rows(), self.num_frames
        seconds = self.ahead.seconds | self.clock.seconds | {"write": self.last.seconds["write"]}
        summary = {
            "frames": n,
            "objects": len(np.unique(rows[:, 1])),
            "frames_without_room": self.without_room,
            "detections_left_out": self.left_out,
            "seconds": {part: round(duration, 3) for part, duration in seconds.items()},
            "frames_per_second": round(n / max(self.clock.seconds["track"], 1e-9), 2),
            "peak_memory_mb": round(peak_memory(), 1),
        }
        first = self.source.first
        return summary | scores_of(rows[:, :6], self.source.truth, first, first + n - 1)


def _with_sizes(rows: np.ndarray) -> np.ndarray:
    """Rows of boxes as they are; those of points with a width and a height of 0."""
    return rows if rows.shape[1] == 8 else np.insert(rows, [4, 4], 0.0, axis=1)


def scores_of(rows: np.ndarray, truth: Truth | None, first: int, last: int) -> dict[str, float]:
    """HOTA, MOTA and IDF1 of rows in these frames, where there is a truth."""
    if truth is None or not np.any(truth.objects[:, 0] <= last):
        return {}
    try:
        scores = multi_object_scores(
            rows,
            truth.objects,
            (first, last),
            ignored=truth.ignored,
            min_height=truth.min_height,
        )
    except (ImportError, ValueError) as error:
        print(f"{NO_SCORES}: {error}", file=sys.stderr)
        return {}
    return {name: round(scores[name], 4) for name in SCORES}


def run(options: argparse.Namespace) -> None:
    """Track, and write all results so far, also where the run ends before the frames do."""
    source = open_source(options)
    results = Results(options, source)
    one = (source.path, source.first, source.first)
    start = _start(results, next(frames.read_frames(*one)) if source.has_pixels else None)
    options.out.mkdir(parents=True, exist_ok=True)
    try:
        _track(results, start)
    finally:
        # Also after an interruption, or where the next frame cannot be read.
        if results.num_frames:
            for name in {TRACKS, FORMATS[options.format]}:
                box_files.write_tracks(options.out / name, results.all_rows())
            summary = results.summary()
            write_json(options.out / SUMMARY, summary)
            print(_line(summary))
            print(f"written to {options.out}")


# What makes tracks of stills that are seen once, one after the other, or without any.
Start = Callable[[Iterable[np.ndarray] | None], Generator[Tracks, None, None]]


def _start(results: Results, still: np.ndarray | None) -> Start:
    """The requested tracker; raises for any fault in the arguments."""
    options, source = results.options, results.source
    key = jax.random.key(options.seed)
    if options.box is not None:
        if still is None:
            raise ValueError(f"--box: frame {source.first}, in which they are, cannot be decoded")
        boxes = read_boxes(options, still)
        return lambda stills: follow_boxes(stills or (), boxes, key=key, first=source.first)
    rows, deviation = None, options.point_deviation
    if source.rows is not None:
        rows = Rows(source.rows, last=source.last, coordinates=4 if deviation is None else 2)
    room = LEAST_ROOM if rows is None else rows.most_objects()
    tracker = ObjectTracker(
        options.max_objects or room,
        frames_per_second=source.frames_per_second,
        lost_seconds=options.lost_seconds,
        point_deviation=deviation,
    )
    detector = BackgroundSubtraction() if options.detect else None
    if options.camera_motion == "pixels":
        OpticalFlow()  # an error before anything is written, where OpenCV is missing

    def tracks(stills: Iterable[np.ndarray] | None) -> Generator[Tracks, None, None]:
        return track(
            stills,
            rows if detector is None else results.ahead.of("detect")(detector.detect),
            tracker,
            key=key,
            first=source.first,
            times=results.times if source.has_pixels and options.fps is None else None,
            min_score=options.min_score,
            use_colours=not options.no_colour,
            frame_size=source.frame_size,
            camera_motion="detections" if options.detect else options.camera_motion,
            ahead=source.has_pixels,
        )

    return tracks


def _track(results: Results, start: Start) -> None:
    """The loop over frames; where a video is drawn, the tracks are made ahead of it."""
    options, source = results.options, results.source
    untracked: collections.deque[np.ndarray | None] = collections.deque()
    has_video = source.has_pixels and not options.no_video

    def record(stills: Iterator[Any]) -> Iterator[Any]:
        for still in results.ahead.over("read", stills):
            untracked.append(still)
            yield still

    def with_rows(tracks: Iterator[Tracks]) -> Iterator[tuple[np.ndarray | None, np.ndarray]]:
        for each in results.clock.over("track", tracks):
            yield untracked.popleft() if source.has_pixels else None, results.add(each)

    def written(tracked: Iterator[Any]) -> Iterator[np.ndarray | None]:
        """The frames of the video, None where there is no picture; each leaves its lines first."""
        for number, (still, rows) in enumerate(results.last.over("wait", tracked)):
            if number == 0:
                # Until there is something to write, an older run's files stay as they are.
                (options.out / SUMMARY).unlink(missing_ok=True)
            # At once, so that a run that is killed leaves them too.
            with open(options.out / TRACKS, "a" if number else "w", encoding="utf-8") as file:
                file.write(box_files.format_tracks(rows))
            bar.update()
            yield drawing.with_tracks(still, rows) if has_video and still is not None else None

    bar = tqdm(total=source.num_frames, desc="Tracking", unit="frame", disable=None)
    with contextlib.ExitStack() as opened, bar:
        stills = None
        if source.has_pixels:
            path, times = source.path, results.times
            read = frames.read_frames(path, source.first, source.last, times=times)
            stills = record(opened.enter_context(read_ahead(read)))
            # Two threads take twice the processor's time for pictures as small as those of optical
            # flow, and none less by the clock; what detects is best divided among processors.
            if not options.detect and has_opencv():
                opencv().setNumThreads(1)
        # Closed before the thread that reads ends: it may wait for a frame.
        tracked = with_rows(opened.enter_context(contextlib.closing(start(stills))))
        if has_video:
            tracked = opened.enter_context(read_ahead(tracked))
        with results.last.of("write"):
            if has_video:
                rate = source.frames_per_second or 10.0
                frames.write_video(options.out / VIDEO, written(tracked), rate)
            else:
                collections.deque(written(tracked), maxlen=0)


def _line(summary: dict[str, Any]) -> str:
    """The numbers of the summary that are worth a look."""
    names = {"frames_per_second": "frames a second", "peak_memory_mb": "MB at most"}
    columns = ["frames", "objects", *names, *SCORES]
    parts = (f"{summary[name]:g} {names.get(name, name)}" for name in columns if name in summary)
    return ", ".join(parts)
