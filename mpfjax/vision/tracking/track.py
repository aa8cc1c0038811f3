"""The loop over frames: from video and detections, or detections alone, to tracks."""

import contextlib
import contextvars
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from jaxtyping import Array, Float, Key, UInt8

from mpfjax.checks import Count, Finite, checked, one_of, warn
from mpfjax.vision.files.boxes import top_left
from mpfjax.vision.files.frames import of_one_kind, read_frames
from mpfjax.vision.tracking.adapters import LEAST_ROOM, Rows, as_detector, first_step, observe
from mpfjax.vision.tracking.detections import BOXES, FrameDetections
from mpfjax.vision.tracking.gaussian import CameraMotion
from mpfjax.vision.tracking.opencv import OpticalFlow, has_opencv
from mpfjax.vision.tracking.state import Tracks
from mpfjax.vision.tracking.step import advance
from mpfjax.vision.tracking.tracker import ObjectTracker, with_colours

# So many frames wait between threads, enough to even out frames of different cost; one of 4K has
# 25 MB.
_WAITING = 4
_STRONGEST = "; the strongest are kept (here and wherever else it is so)"


@checked
def track(
    frames: Iterable[UInt8[np.ndarray, "..."] | None] | str | Path | None,
    detections: Any,
    tracker: ObjectTracker | None = None,
    *,
    key: Key[Array, ""] | None = None,
    first: Count | None = None,
    times: Iterable[float] | None = None,
    min_score: Finite | None = None,
    max_detections: Count | None = None,
    use_colours: bool = True,
    frame_size: tuple[int, int] | None = None,
    camera_motion: Annotated[str, one_of(("pixels", "detections"))] | None = None,
    ahead: bool = False,
) -> Generator[Tracks, None, None]:
    """Track the detections of a video: yields the `Tracks` of each frame as it is processed.

    The tracks of a frame depend on this frame and earlier ones only. Any detector can be used:

        track(frames, lambda frame: network(frame))        # boxes, scores and classes
        track(frames, read_detections("det.txt"))          # rows of a MOTChallenge file
        track(frames, BackgroundSubtraction().detect)      # a static camera
        track(None, rows)                                  # without pixels, for speed

    - `frames`: RGB images of eight bits, or grey ones, all of one size, in any iterable, or the
      path of a video or of a folder of images, from frame `first` on; None if there are only
      detections. A frame that is None, as returned by `read_frames` for a damaged one, is
      predicted.
    - `detections`: a function from a frame to its boxes (x, y, w, h), top-left corner first, in
      pixels, or to a tuple of boxes and scores (None for none), or of boxes, scores and classes; or
      an iterable of these, one item for each frame, or a mapping from frame numbers to them; or an
      array of rows (frame, id, x, y, w, h, score) whose frames count from 1, or the path of a
      MOTChallenge file of these. None instead of boxes, and a frame that a mapping does not
      contain, mean that the detector did not run, which is not "no objects". For a tracker of
      points they are (x, y), and rows (frame, id, x, y, score). `Detections` may contain vectors,
      such as embeddings, which distinguish similar objects in motion.
    - `tracker`: None is `ObjectTracker()`, with more room if a frame has more rows.
    - `key`: ignored, because nothing is random.
    - `first`: the number of the first frame, by which rows are selected. None is 1, and without
      `frames` the number of the first row.
    - `times`: of the frames in seconds, increasing, if these are not equally spaced; a video that
      is specified by its path has its own. None uses `frames_per_second` of the tracker.
    - `min_score`: detections with a lower score are ignored; None ignores none.
    - `max_detections`: the maximum number of detections in a frame, of which the strongest are
      used. None is twice the tracker's `max_objects`.
    - `use_colours`: with False the tracker does not use pixels, and only the detector does.
    - `frame_size`: height and width, for detections without frames, to determine which boxes and
      objects are outside; None if there is no border.
    - `camera_motion`: "pixels" estimates the motion of the camera by `OpticalFlow`, and the
      remainder from the detections; "detections" uses only them. None is "pixels" if the tracker
      uses pixels and OpenCV is installed.
    - `ahead`: read, detect and process pixels in a separate thread, up to four frames ahead of the
      tracks; `close()`, or the last track, ends the thread. Use it for recordings, which then take
      less time; with a camera, tracks would be late.

    Coordinates may be large, as on maps. Boxes that are not finite, have no area or are outside the
    frame are ignored, and the first causes a warning. There are warnings for detections in frames
    after the last, and for more detections or objects than there is room for. Raises `ValueError`
    with the name of the argument for values that cannot be used, at the frame in which they occur,
    for a row more than a minute after the previous one if there are no `frames`, and `ImportError`
    for "pixels" without OpenCV. An exception of the detector is passed on, with the number of the
    frame. Use it for recorded videos and for cameras.
    """
    kind = BOXES if tracker is None else tracker.kind
    detector = as_detector(detections, kind.coordinates)
    if frames is None and (callable(detector) or camera_motion == "pixels"):
        raise ValueError("frames: None; a detector, and camera_motion 'pixels', need them")
    if tracker is None:
        of_rows = isinstance(detector, Rows)
        tracker = ObjectTracker(detector.most_objects() if of_rows else LEAST_ROOM)
    first = (first_step(detector, first, tracker.rate) if frames is None else first) or 1
    if isinstance(frames, str | Path):
        own_times: list[float] = []
        frames = read_frames(frames, first, times=own_times)
        times = own_times if times is None else times
    times = iter(() if times is None else times)
    stills = None if frames is None else of_one_kind(frames, first)
    if camera_motion is None and stills is not None and use_colours and has_opencv():
        camera_motion = "pixels"
    flow = OpticalFlow() if camera_motion == "pixels" else None
    room = 2 * tracker.max_objects if max_detections is None else max_detections

    def inputs() -> Iterator[_Inputs]:
        """What does not depend on earlier tracks, frame by frame."""
        is_warned = False
        for number, still, output in observe(stills, detector, first):
            trackable, motion = None, None
            size = frame_size if still is None else still.shape[:2]
            if output is not None:
                trackable = FrameDetections.of(output, number, size, kind, min_score)
                if len(trackable.rows) > room and not is_warned:
                    excess = f"frame {number} has {len(trackable.rows)}, more than the {room}"
                    warn(f"detections: {excess} of max_detections{_STRONGEST}")
                    is_warned = True
                trackable = trackable.strongest(room)
                if use_colours and still is not None and kind.has_boxes:
                    trackable = with_colours(trackable, still)
            if flow is not None and still is not None:
                boxes = trackable.boxes if trackable is not None and kind.has_boxes else None
                motion = flow(still, None if boxes is None else top_left(boxes))
            yield number, trackable, motion, next(times, None)

    return _track(inputs(), tracker, ahead)


# The number of a frame, and what a step uses of it: detections, the camera's motion, the time.
_Inputs = tuple[int, FrameDetections | None, CameraMotion | None, float | None]


def _track(
    inputs: Iterator[_Inputs], tracker: ObjectTracker, ahead: bool
) -> Generator[Tracks, None, None]:
    state, is_warned = tracker.init(), False
    with read_ahead(inputs) if ahead else contextlib.nullcontext(inputs) as coming:
        for number, detections, motion, time in coming:
            state, tracks = advance(tracker, state, detections, motion, time)
            if tracks.full and not is_warned:
                excess = f"frame {number} has more objects than the {tracker.max_objects}"
                warn(f"tracker: {excess} of max_objects{_STRONGEST}")
                is_warned = True
            yield tracks._replace(number=number)


@contextlib.contextmanager
def read_ahead(items: Iterable[Any]) -> Iterator[Iterator[Any]]:
    """The items in their order, each made in one other thread before it is asked for.

    The thread has this one's settings. An exception in making an item is raised in the place of the
    item. Leaving the block ends the thread, which closes the items if they can be closed.
    """
    coming, end, context = iter(items), object(), contextvars.copy_context()

    def start(call: Callable[..., Any], *arguments: Any) -> Future[Any]:
        return thread.submit(context.run, call, *arguments)

    def take() -> Iterator[Any]:
        while (item := waiting.popleft().result()) is not end:
            waiting.append(start(next, coming, end))
            yield item

    with ThreadPoolExecutor(1) as thread:
        waiting = deque(start(next, coming, end) for _ in range(_WAITING))
        try:
            yield take()
        finally:
            for future in waiting:
                future.cancel()
            start(getattr(items, "close", lambda: None)).result()


# --- tracks as files have them -------------------------------------------------------------


def online_rows(tracks: Tracks, *, described: bool = False) -> Float[np.ndarray, "k columns"]:
    """Rows (frame, id, x, y, w, h) of the objects that are shown in a frame (`Tracks.shown`).

    The frame is `Tracks.number`. For points the rows are (frame, id, x, y). With `described` each
    has two more columns, the score of its latest detection and its class.
    """
    return _rows(tracks, tracks.shown, described)


@checked
def offline_rows(
    tracks_of_frames: Iterable[Tracks], *, described: bool = False
) -> Float[np.ndarray, "r columns"]:
    """Rows of every object that was shown at some time, including its unconfirmed frames.

    The columns are those of `online_rows`.
    """
    tracks_of_frames = list(tracks_of_frames)
    shown = np.concatenate([np.zeros(0, int), *(t.identities[t.shown] for t in tracks_of_frames)])
    coordinates = tracks_of_frames[0].boxes.shape[1] if tracks_of_frames else 4
    rows = [np.zeros((0, 2 + coordinates + 2 * described))]
    for tracks in tracks_of_frames:
        written = np.isin(tracks.identities, shown) & (tracks.shown | ~tracks.confirmed)
        rows.append(_rows(tracks, written, described))
    return np.concatenate(rows)


def _rows(tracks: Tracks, written: np.ndarray, described: bool) -> np.ndarray:
    written = np.flatnonzero(written & (tracks.identities > 0))
    names = tracks.identities[written]
    columns = [np.full(len(names), tracks.number), names, tracks.corner_boxes[written]]
    if described:
        columns += [tracks.scores[written], tracks.classes[written]]
    # Rounded as in files, so that scores are the same from a file.
    return np.round(np.column_stack(columns)[np.argsort(names, kind="stable")], 3)
