"""The loop over frames: from video and detections, or detections alone, to tracks."""

import contextlib
from collections.abc import Generator, Iterable, Iterator
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float, Key, UInt8

from mpfjax.checks import Count, Finite, checked, one_of
from mpfjax.operations.compiling import in_little_memory, jit_with
from mpfjax.vision.files.boxes import centred, top_left
from mpfjax.vision.files.frames import of_one_kind, read_frames
from mpfjax.vision.files.threads import read_ahead
from mpfjax.vision.tracking.adapters import (
    LEAST_ROOM,
    Once,
    Rows,
    Sieve,
    as_detector,
    observed,
)
from mpfjax.vision.tracking.detections import DetectedBoxes, Detections
from mpfjax.vision.tracking.gaussian import CameraMotion
from mpfjax.vision.tracking.optical_flow import OpticalFlow, has_opencv
from mpfjax.vision.tracking.state import Tracks
from mpfjax.vision.tracking.tracker import ObjectTracker, advanced, colours_of

# Compiling in four fifths of the time is worth a tenth of a frame's up to here.
_FEW_OBJECTS = 48


@checked
def track(
    frames: Iterable[UInt8[np.ndarray, "..."] | None] | str | Path | None,
    detections: Any,
    tracker: ObjectTracker | None = None,
    *,
    key: Key[Array, ""] | None = None,
    first: Count = 1,
    min_score: Finite | None = None,
    max_detections: Count | None = None,
    use_colours: bool = True,
    frame_size: tuple[int, int] | None = None,
    camera_motion: Annotated[str, one_of(("pixels", "detections"))] | None = None,
    ahead: bool = False,
) -> Generator[Tracks, None, None]:
    """Track what a detector finds in a video: yields the `Tracks` of each frame as it comes.

    The tracks of a frame depend on this frame and earlier ones only. Any detector will do:

        track(frames, lambda frame: network(frame))        # boxes, scores and classes
        track(frames, read_detections("det.txt"))          # rows of a MOTChallenge file
        track(frames, BackgroundSubtraction().detect)      # what moves before a still camera
        track(None, rows)                                  # without pixels, for speed or radar

    - `frames`: RGB images of eight bits, or grey ones, all of one size, in any iterable, or the
      path of a video or of a folder of images, from frame `first` on; None where there are only
      detections. A frame that is None, as `read_frames` has it for a damaged one, is predicted.
    - `detections`: a function from a frame to its boxes (x, y, w, h), top-left corner first, in
      pixels, or to a tuple of boxes and scores (None for none), or of boxes, scores and classes;
      or an iterable of these, one item for each frame; or an array of rows (frame, id, x, y, w, h,
      score) whose frames count from 1, or the path of a MOTChallenge file of these.
    - `tracker`: None takes `ObjectTracker()`, with more room where a frame has more rows.
    - `key`: counts for nothing, since nothing is drawn.
    - `first`: the number of the first frame, by which rows are found.
    - `min_score`: detections with a lower score are left out; None leaves out none.
    - `max_detections`: the most detections in a frame; if there are more, the strongest are kept.
      None takes twice the tracker's `max_objects`.
    - `use_colours`: with False the tracker sees no pixels, and only the detector does.
    - `frame_size`: height and width, for detections without frames, to tell which boxes and
      objects lie outside; None where there is no border.
    - `camera_motion`: "pixels" finds the motion of the camera by `OpticalFlow`, and what this
      leaves from the detections; "detections" has them alone. None takes "pixels" where the tracker
      sees pixels and OpenCV is installed.
    - `ahead`: read, detect and look at pixels in a thread of its own, up to four frames ahead of
      the tracks; `close()`, or the last track, ends the thread. Use it for recordings, which then
      take less time; a camera's tracks would be late.

    The tracks of each frame are NumPy arrays. Without pixels coordinates may be large, as those of
    maps are. Rows of a masked array with a masked entry are no detections. Boxes without area or
    outside the frame are left out with a warning, as are detections in frames after the last.
    Another warning is given where there are more detections or objects than there is room for.
    Raises `ValueError` with the name of the argument for values that cannot be used, at the frame
    in which they come, and `ImportError` for "pixels" without OpenCV. An exception of the detector
    is passed on, with the number of the frame. Use it for recorded videos and for cameras.
    """
    if isinstance(frames, str | Path):
        frames = read_frames(frames, first)
    del key
    detector, sieve = as_detector(detections), Sieve(min_score, frame_size)
    if frames is None and (callable(detector) or camera_motion == "pixels"):
        raise ValueError("frames: None; a detector, and camera_motion 'pixels', need them")
    if tracker is None:
        of_rows = isinstance(detector, Rows)
        tracker = ObjectTracker(detector.most_objects() if of_rows else LEAST_ROOM)
    room = 2 * tracker.max_objects if max_detections is None else max_detections
    stills = None if frames is None else of_one_kind(frames, first)
    if camera_motion is None and stills is not None and use_colours and has_opencv():
        camera_motion = "pixels"
    flow = OpticalFlow() if camera_motion == "pixels" else None
    found = observed(stills, detector, first)
    return _tracked(_seen(found, sieve, tracker, room, use_colours, flow), tracker, ahead)


class _Seen(NamedTuple):
    """All that a step takes of a frame, and the places of its detections in what was found."""

    number: int
    pixels: Any
    observation: Detections
    motion: CameraMotion | None
    kept: np.ndarray
    origin: np.ndarray


def _seen(
    frames: Iterator[tuple[int, np.ndarray | None, DetectedBoxes]],
    sieve: Sieve,
    tracker: ObjectTracker,
    room: int,
    use_colours: bool,
    flow: OpticalFlow | None,
) -> Iterator[_Seen]:
    """What does not depend on earlier tracks, frame by frame."""
    once, origin = Once(), None
    for number, still, found in frames:
        found, kept = sieve(found, number, still)
        if len(found.boxes) > room:
            once.warn(
                "detections",
                f"detections: frame {number} has {len(found.boxes)}, more than the {room} that"
                " there is room for, max_detections; the strongest are kept",
            )
        if still is not None and (use_colours or flow is not None):
            origin = np.zeros(2)  # that of the pixels
        elif origin is None and len(found.boxes):
            origin = np.median(centred(found.boxes)[:, :2], axis=0)
        corner = np.zeros(2) if origin is None else origin
        size = sieve.frame_size if still is None else still.shape[:2]
        observation = Detections.from_boxes(
            found.boxes, room, found.scores, frame_size=size, origin=corner, classes=found.classes
        )
        pixels = colours_of(still, observation) if use_colours and still is not None else None
        motion = None if flow is None or still is None else flow(still, found.boxes)
        yield _Seen(number, pixels, observation, motion, kept, corner)


def _tracked(
    seen: Iterator[_Seen], tracker: ObjectTracker, ahead: bool
) -> Generator[Tracks, None, None]:
    state, once = tracker.init(), Once()
    advance = jit_with(in_little_memory(soon=tracker.max_objects <= _FEW_OBJECTS), advanced)
    with read_ahead(seen) if ahead else contextlib.nullcontext(seen) as coming:
        for number, pixels, observation, motion, kept, origin in coming:
            state, tracks = advance(tracker, state, observation, pixels, motion)
            tracks = jax.device_get(tracks)
            if tracks.full:
                once.warn(
                    "objects",
                    f"tracker: frame {number} has more objects than the {tracker.max_objects} that"
                    " there is room for, max_objects; the strongest are kept",
                )
            taken = tracks.detections
            yield tracks._replace(
                boxes=tracks.boxes + np.append(origin, [0, 0]),
                detections=np.where(taken >= 0, np.append(kept, -1)[taken], -1),
            )


# --- tracks as files have them -------------------------------------------------------------


def online_rows(number: int, tracks: Tracks) -> Float[np.ndarray, "k 6"]:
    """Rows (frame, id, x, y, w, h) of the objects that are shown in each frame (`Tracks.shown`)."""
    return _rows(number, tracks, tracks.shown)


def offline_rows(kept: Iterable[Tracks], first: int = 1) -> Float[np.ndarray, "r 6"]:
    """Rows of every object that was shown at some time, including its unconfirmed frames."""
    kept = list(kept)
    believed = {0}
    for tracks in kept:
        believed |= set(np.asarray(tracks.identities)[np.asarray(tracks.shown)].tolist())
    chosen = np.array(sorted(believed - {0}))
    rows = [
        _rows(
            number,
            tracks,
            np.isin(tracks.identities, chosen) & (tracks.shown | ~np.asarray(tracks.confirmed)),
        )
        for number, tracks in enumerate(kept, first)
    ]
    return np.concatenate([np.zeros((0, 6)), *rows])


def _rows(number: int, tracks: Tracks, written: Any) -> np.ndarray:
    written = np.flatnonzero(np.asarray(written) & (np.asarray(tracks.identities) > 0))
    corners = top_left(np.asarray(tracks.boxes)[written])
    ids = np.asarray(tracks.identities)[written]
    rows = np.column_stack([np.full(len(ids), number), ids, corners])
    # Rounded as in files, so that scores are the same from a file.
    return np.round(rows[np.argsort(ids, kind="stable")], 3)
