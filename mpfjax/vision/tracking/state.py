"""The state of a tracker after a frame, and its report."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from mpfjax.checks import Renamed
from mpfjax.vision.files.boxes import top_left
from mpfjax.vision.tracking.associate import Clutter, Likeness
from mpfjax.vision.tracking.camera import CameraState
from mpfjax.vision.tracking.gaussian import Gaussian
from mpfjax.vision.tracking.lives import Coasting, Duplicates, Lives
from mpfjax.vision.tracking.noise import NoiseState
from mpfjax.vision.tracking.scores import ScoreState


class TrackerState(NamedTuple):
    """The memory of an `ObjectTracker`, with a row for each object.

    - `objects`: the moments of position and velocity, (m, 4) each, or (m, 2) for points.
    - `lives`: identities and counts.
    - `scores`, `noise`, `camera`: estimates on the detector, the motion and the camera.
    - `colours`: (m, bins), the histograms of each object, all zero if it has none.
    - `coasting`, `duplicates`: how long predictions are correct; which are a second box of another
      object.
    - `vectors`: (m, e), as the detector's; `likeness`: estimates of their similarity.
    - `clutter`: for points, the clutter density.
    - `last_identity`: the highest identity so far.
    - `full`: whether there was no room for a new object in the last frame.
    - `has_begun`: whether there was a frame on which the detector ran; `waited`: for how many
      frames it has not run since.
    - `time`: in seconds, of the last frame; None if unknown.
    - `forms`: (3,), of the first boxes, as in `FrameDetections.form_counts`.
    - `number`: the number of frames so far; `has_faults`: whether a detection could not be tracked.
    """

    objects: Gaussian
    lives: Lives
    scores: ScoreState
    noise: NoiseState
    colours: Float[np.ndarray, "m bins"]
    coasting: Coasting = Coasting()
    duplicates: Duplicates = Duplicates()
    camera: CameraState = CameraState()
    vectors: Float[np.ndarray, "m e"] = np.zeros((0, 0))
    likeness: Likeness = Likeness()
    clutter: Clutter = Clutter()
    last_identity: int = 0
    full: bool = False
    has_begun: bool = False
    waited: float = 0.0
    time: float | None = None
    number: int = 0
    has_faults: bool = False
    forms: Int[np.ndarray, "3"] = np.zeros(3, int)
    begun = Renamed("begun", "has_begun")


class Tracks(NamedTuple):
    """The tracks in one frame, a row for each object.

    - `boxes`: (m, 4), the mean box of each, centre and size in pixels; (m, 2), its mean point.
    - `identities`: (m,), a number that an object keeps for its lifetime.
    - `confirmed`: (m,), whether it has had enough detections to be confirmed as an object.
    - `unseen`: (m,), frames since its last detection.
    - `full`: whether there was no room for a detection that would have started an object.
    - `shown`: (m,), which are confirmed, were detected recently, and are probably not duplicates of
      another one.
    - `detections`: (m,), the row of the detection assigned to each in this frame, in the detector's
      output; -1 for none. Use it to look up masks and features.
    - `probabilities`: (m,), that this detection is the object's own; 0 if there is none.
    - `classes`: (m,), the class of each, the first that its detections had; 0 for none.
    - `scores`: (m,), the score of the latest detection of each, 1 if detections have none.
    - `number`: of the frame, as files and `track` count them; frames of `step` count from 1.
    """

    boxes: Float[np.ndarray, "m k"]
    identities: Int[np.ndarray, " m"]
    confirmed: Bool[np.ndarray, " m"]
    unseen: Float[np.ndarray, " m"]
    full: bool
    shown: Bool[np.ndarray, " m"]
    detections: Int[np.ndarray, " m"]
    probabilities: Float[np.ndarray, " m"]
    classes: Int[np.ndarray, " m"]
    scores: Float[np.ndarray, " m"]
    number: int

    @property
    def corner_boxes(self) -> Float[np.ndarray, "m k"]:
        """The boxes (x, y, w, h) with (x, y) the top-left corner, as in files; or points."""
        return top_left(self.boxes)
