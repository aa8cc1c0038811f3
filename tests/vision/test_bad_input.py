"""Arguments of the vision part that will not do are errors that name them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mpfjax import vision
from mpfjax.vision.boxes.colour_model import BoxState
from mpfjax.vision.boxes.joint_colour import object_boxes
from tests.refused import INFINITY, NAN, NOTHING, assert_named, refused

VIDEO = "reading, writing and detecting in frames needs the extra 'video', which 'test' brings"
KEY = jax.random.key(0)
FRAME = np.random.default_rng(0).integers(0, 256, (40, 50, 3), dtype=np.uint8)
BOXES = np.array([[5.0, 5, 10, 20], [20, 10, 10, 15]])
STATES = BoxState(jnp.ones((3, 4)), jnp.zeros(3, jnp.int32))
OF_FRAME = {"frame": FRAME, "boxes": BOXES}
COLOUR = {"frame": "array", "boxes": "rows", "sigma": "positive", "num_parts": "count",
          "deviations": "four?", "dynamics": "kind?", "switch_probability": "share"}  # fmt: skip


def built(name):
    if name == "joint":
        return vision.joint_colour_model(FRAME, BOXES)
    return vision.ColourModel.from_frame(FRAME, BOXES, colours=vision.RGBColours(4))


def late(function, **builds):
    """A function of which some arguments are built where they are not given."""

    def call(**arguments):
        made = {name: built(what) for name, what in builds.items() if name not in arguments}
        return function(**made | arguments)

    return call


TABLE = {
    "RGBColours": (vision.RGBColours, {}, {"num_bins": "count"}),
    "HSVColours": (
        vision.HSVColours,
        {},
        {"num_hues": "count", "num_saturations": "count", "num_values": "count",
         "least_saturation": "share", "least_value": "share"},
    ),
    "ColourModel": (
        vision.ColourModel.from_frame,
        OF_FRAME,
        COLOUR | {"colours": "kind?", "contrast": "not negative"},
    ),
    "joint_colour_model": (
        vision.joint_colour_model,
        OF_FRAME,
        {"frame": "array", "boxes": "rows", "lambda_": "positive", "num_parts": "count",
         "colours": "kind?", "deviations": "four", "templates": "kind?"},
    ),
    "object_boxes": (
        late(object_boxes, model="joint"),
        {"states": STATES},
        {"states": "kind"},
    ),
    "Detections": (
        vision.Detections.from_boxes,
        {"boxes": BOXES, "max_detections": 3},
        {"boxes": "rows", "max_detections": "count"},
    ),
    "read_tracks": (vision.read_tracks, {}, {"path": "path"}),
    "read_truth": (vision.read_truth, {}, {"path": "path"}),
    "write_tracks": (
        vision.write_tracks,
        {"path": "/nowhere", "rows": []},
        {"path": "path", "rows": "rows"},
    ),
    "read_frames": (
        vision.read_frames,
        {"path": "."},
        {"path": "path", "first": "count", "last": "count?"},
    ),
    "write_video": (
        vision.write_video,
        {"path": "/nowhere/a.gif", "frames": [FRAME]},
        {"path": "path", "frames_per_second": "positive"},
    ),
    "track": (
        vision.track,
        {"frames": None, "detections": np.zeros((0, 7))},
        {"tracker": "kind?", "key": "key?", "first": "count", "min_score": "finite?",
         "max_detections": "count?", "use_colours": "flag", "camera_motion": "kind?"},
    ),
    "follow_boxes": (
        vision.follow_boxes,
        {"frames": [FRAME], "boxes": BOXES},
        {"boxes": "rows", "key": "key?"},
    ),
    "read_detections": (vision.read_detections, {}, {"path": "path"}),
    "BackgroundSubtraction": (
        vision.BackgroundSubtraction,
        {},
        {"history": "count", "warm_up": "count", "threshold": "positive",
         "most_pixels": "count", "background_share": "inner share",
         "shadow_brightness": "inner share?", "largest_gap": "not negative"},
    ),
    "ObjectTracker": (
        vision.ObjectTracker,
        {},
        {"max_objects": "count", "frames_per_second": "positive?", "scores": "kind",
         "class_matters": "kind"},
    ),
}  # fmt: skip


@pytest.mark.usefixtures("as_installed")
@pytest.mark.parametrize(("function", "good", "name", "value"), refused(TABLE))
def test_what_will_not_do_is_named(function, good, name, value):
    assert_named(function, good, name, value)


@pytest.mark.usefixtures("as_installed")
@pytest.mark.parametrize(
    ("function", "good", "name", "value"),
    [
        (vision.RGBColours, {}, "num_bins", 257),
        (vision.ColourModel.from_frame, OF_FRAME, "boxes", [[5.0, 5, INFINITY, 20]]),
        (vision.ColourModel.from_frame, OF_FRAME, "boxes", [[NAN, 5, 10, 20]]),
        (vision.ColourModel.from_frame, OF_FRAME, "frame", FRAME[:, :, 0]),
        (vision.ColourModel.from_frame, OF_FRAME, "frame", FRAME.astype(float)),
        (vision.ColourModel.from_frame, OF_FRAME, "frame", FRAME[:0]),
        (vision.joint_colour_model, OF_FRAME, "templates", {2: (FRAME, BOXES[0])}),
        (vision.joint_colour_model, OF_FRAME, "templates", {0: FRAME}),
        (vision.joint_colour_model, OF_FRAME, "templates", {0: (FRAME, None)}),
        (vision.joint_colour_model, OF_FRAME, "templates", {0: (None, BOXES[0])}),
        (vision.ObjectTracker, {}, "scores", (0.5, NAN)),
        (vision.write_tracks, {"path": "/nowhere"}, "rows", [[0.5, 1, 2, 3, 4, 5]]),
        (vision.write_tracks, {"path": "/nowhere"}, "rows", [[1, 1, NAN, 3, 4, 5]]),
        (late(object_boxes, model="joint"), {}, "states", STATES),
    ],
)  # fmt: skip
def test_what_does_not_go_with_the_rest_is_named(function, good, name, value):
    assert_named(function, good, name, value)


@pytest.mark.usefixtures("as_installed")
class TestFramesToDetectIn:
    @pytest.mark.parametrize("frame", [*NOTHING, FRAME[:, :, 0], FRAME[:0], FRAME.astype(float)])
    def test_that_are_none_are_named(self, frame):
        pytest.importorskip("cv2", reason=VIDEO)
        with pytest.raises(ValueError, match=r"^frame: "):
            vision.BackgroundSubtraction().detect(frame)

    @pytest.mark.parametrize("frames", [None, 3, []])
    def test_nothing_to_learn_from_is_named(self, frames):
        pytest.importorskip("cv2", reason=VIDEO)
        with pytest.raises(ValueError, match=r"^frames: "):
            vision.BackgroundSubtraction().learn(frames)


@pytest.mark.usefixtures("as_installed")
@pytest.mark.parametrize("frames", [None, 3, [None], [FRAME[None]], [FRAME.astype(float)]])
def test_a_video_of_no_frames_is_named(tmp_path, frames):
    pytest.importorskip("av", reason=VIDEO)
    with pytest.raises(ValueError, match=r"^frames: "):
        vision.write_video(tmp_path / "video.gif", frames)
