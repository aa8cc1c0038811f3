"""A tracker of an unknown number of objects, from detections: a Kalman filter for each."""

from typing import Any, Literal

import equinox as eqx
import numpy as np
from jaxtyping import Array, Key, UInt8

from mpfjax.checks import Checked, Count, Finite, Positive, checked
from mpfjax.vision.colour import HSVColours, sampled_histograms
from mpfjax.vision.tracking.detections import BOXES, FrameDetections, Kind, kind_of_points
from mpfjax.vision.tracking.gaussian import CameraMotion, Gaussian
from mpfjax.vision.tracking.lives import Lives, Spans
from mpfjax.vision.tracking.noise import NoiseState
from mpfjax.vision.tracking.scores import ScoreState
from mpfjax.vision.tracking.state import TrackerState, Tracks
from mpfjax.vision.tracking.step import advance


class _FewColours(HSVColours):
    """Few bins, for the few points of a detection that are looked at."""

    num_hues, num_saturations, num_values = 8, 4, 6


_COLOURS, _BANDS = _FewColours(), 3


class ObjectTracker(Checked):
    """Tracks an unknown and changing number of objects, with any detector.

    Every object has a Kalman filter for its box. `step` is a deterministic function of the state
    and of the detections of a frame. In a step

    - objects move by their velocities, and by their common motion, the camera's;
    - the scores of detections determine which are strong, by what became of earlier ones;
    - each pair of object and detection has a probability in the joint distribution of all
      one-to-one assignments; the most probable assignment is chosen, and an object is updated by
      its detection according to the probability of the pair, as in probabilistic data association;
    - objects without detections, or outside the frame, end; strong detections that no object
      explains start new ones;
    - the detector's errors and the noises of the motion are estimated from the innovations.

    Lengths are in boxes, so that nothing depends on the size of the frame or of the objects; with
    `point_deviation` they are in standard deviations of points. Points are assigned by distance
    alone, and by the clutter density, which is estimated. One new point in ten is assumed to be of
    an object, and one of an object's seven to be missed; odds of 20 to 1 confirm an object. Two
    objects that start within 3.5 standard deviations of each other are one until they separate.
    Vectors of boxes are weighted by the information in their cosine distances so far.

    - `max_objects`: M, the maximum number of objects.
    - `frames_per_second`: of the video.
    - `lost_seconds`: an object ends after so long without a detection. None is one second, or eight
      frames if these are longer.
    - `point_deviation`: detections are points (x, y) with an error of this standard deviation along
      each coordinate, instead of boxes: radar detections, keypoints, animals in aerial images.
    - `scores`: "rank" estimates the score from which a detection is strong, and starts an object,
      on any scale. "as_given" interprets scores as probabilities: strong from .5 on, and a
      detection below .2 is ignored.

    Objects are matched with detections of their own class only, and detections of another class are
    not duplicates. Class 0 is none, and matches all.

    Raises `ValueError` for a number of objects that is not an integer, or below 1, a rate that is
    not positive, and scores that are none of these.
    """

    max_objects: Count = eqx.field(static=True, default=24)
    frames_per_second: Positive | None = eqx.field(static=True, default=None, kw_only=True)
    lost_seconds: Positive | None = eqx.field(static=True, default=None, kw_only=True)
    point_deviation: Positive | None = eqx.field(static=True, default=None, kw_only=True)
    scores: Literal["rank", "as_given"] = eqx.field(static=True, default="rank", kw_only=True)

    @property
    def rate(self) -> float:
        """Frames per second, 25 if not specified."""
        return 25.0 if self.frames_per_second is None else float(self.frames_per_second)

    @property
    def kind(self) -> Kind:
        """The kind of the detections: boxes or points."""
        return BOXES if self.point_deviation is None else kind_of_points(self.point_deviation)

    @property
    def spans(self) -> Spans:
        """Numbers of frames at this rate."""
        return Spans.at(self.rate, self.lost_seconds)

    def init(self) -> TrackerState:
        """The state before the first frame: no objects."""
        none, coordinates = np.zeros(0, int), self.kind.coordinates
        return TrackerState(
            objects=Gaussian.none(coordinates),
            lives=Lives.initial(none, none, none > 0, 0.0),
            scores=ScoreState.initial(coordinates, self.spans.lasting),
            noise=NoiseState.initial(self.rate, coordinates),
            colours=np.zeros((0, _BANDS * _COLOURS.num_bins)),
        )

    @checked
    def step(
        self,
        key: Key[Array, ""] | None,
        state: TrackerState,
        frame: UInt8[np.ndarray, "h w 3"] | None,
        detections: Any,
        motion: CameraMotion | None = None,
        *,
        time: Finite | None = None,
    ) -> tuple[TrackerState, Tracks]:
        """The state after a frame and its detections, and the tracks in it.

        `detections` are the same as from a detector of `track`: boxes, (boxes, scores), (boxes,
        scores, classes), or `Detections`; with `point_deviation` points instead of boxes; None if
        it did not run, which is not "no objects". Detections that cannot be tracked are ignored as
        by `track`. If `frame` is None, colours are not used. Nothing is
        random: the key may be None.

        - `motion`: the result of `OpticalFlow` for the frames; None estimates it from the
          detections.
        - `time`: in seconds, for frames that are not equally spaced; None is the next frame by
          `frames_per_second`.

        Raises `ValueError` for a frame that is not (h, w, 3) of type uint8, for a time that is not
        after the previous one, and for detections as `Detections.of` does.
        """
        trackable = None
        if detections is not None:
            size = None if frame is None else np.shape(frame)[:2]
            trackable = FrameDetections.of(detections, state.number + 1, size, self.kind)
            if frame is not None and self.kind.has_boxes:
                trackable = with_colours(trackable, frame)
        return advance(self, state, trackable, motion, time)


def with_colours(detections: FrameDetections, frame: UInt8[np.ndarray, "h w 3"]) -> FrameDetections:
    """With the colours of the detections, the part of a frame that a step needs."""
    histograms = sampled_histograms(frame, detections.boxes, _COLOURS, _BANDS)
    colours = histograms.reshape(len(histograms), _BANDS * _COLOURS.num_bins)
    return detections._replace(colours=colours)
