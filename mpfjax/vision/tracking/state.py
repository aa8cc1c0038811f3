"""What a tracker knows after a frame, and what it says of it."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mpfjax.vision.tracking.camera import CameraState
from mpfjax.vision.tracking.gaussian import Gaussian
from mpfjax.vision.tracking.lives import Coasting, Duplicates, Lives
from mpfjax.vision.tracking.noise import NoiseState
from mpfjax.vision.tracking.scores import ScoreState


class TrackerState(NamedTuple):
    """All that an `ObjectTracker` remembers, in arrays with a row for each of M objects.

    - `objects`: the moments of place and velocity, (m, 4) each.
    - `lives`, `coasting`, `duplicates`: identities and counts; how long predictions are right;
      which are a second box of another one.
    - `scores`, `camera`, `noise`: what has been learned of the detector, the camera and the motion.
    - `colours`: (m, bins), the histograms of each object, all zero where it has none.
    """

    objects: Gaussian
    lives: Lives
    coasting: Coasting
    duplicates: Duplicates
    scores: ScoreState
    camera: CameraState
    noise: NoiseState
    colours: Float[Array, "m bins"]


class Tracks(NamedTuple):
    """The tracks in one frame, a row for each of M objects.

    - `boxes`: (m, 4), the mean box of each, centre and size in pixels.
    - `identities`: (m,), a number that an object keeps for life, 0 in an empty row.
    - `confirmed`: (m,), whether it has had enough detections to be taken for an object.
    - `unseen`: (m,), frames since its last detection.
    - `full`: whether a detection that would have started an object found no room.
    - `shown`: (m,), which are confirmed, were detected a moment ago, and are not more probably
      duplicates of another one.
    - `detections`: (m,), the row of the detection assigned to each in this frame, in what the
      detector gave; -1 for none. Use it to look up masks and features.
    - `probabilities`: (m,), that this detection is the object's own; 0 where there is none.
    - `classes`: (m,), the class of each, the first that its detections had; 0 for none.
    """

    boxes: Float[Array, "m 4"]
    identities: Int[Array, " m"]
    confirmed: Bool[Array, " m"]
    unseen: Int[Array, " m"]
    full: Bool[Array, ""]
    shown: Bool[Array, " m"]
    detections: Int[Array, " m"]
    probabilities: Float[Array, " m"]
    classes: Int[Array, " m"]

    @property
    def corner_boxes(self) -> Float[Array | np.ndarray, "m 4"]:
        """The boxes (x, y, w, h) with (x, y) the top-left corner, as files have them."""
        sides = self.boxes[:, np.array([2, 3, 2, 3])]
        return self.boxes - sides * np.array([[0.5, 0.5, 0, 0]], self.boxes.dtype)
