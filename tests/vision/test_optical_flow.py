"""The camera's motion from pixels: against textures and scenes whose motion is known."""

import sys

import numpy as np
import pytest

from mpfjax.vision import ObjectTracker, track
from mpfjax.vision.tracking.gaussian import CameraMotion, Gaussian
from mpfjax.vision.tracking.opencv import OpticalFlow, has_opencv

cv2 = pytest.importorskip("cv2", reason="OpenCV comes with the extra 'video', which 'test' brings")

WIDTH, HEIGHT = 480, 320


def texture(seed=0, height=HEIGHT, width=WIDTH):
    """Random values, smooth between pixels, with patterns of several sizes as pictures have."""
    values = np.random.default_rng(seed).normal(size=(height, width)).astype(np.float32)
    patterns = [size * cv2.GaussianBlur(values, (0, 0), size) for size in (2.0, 5.0, 12.0)]
    return np.clip(128 + 100 * sum(patterns), 0, 255).astype(np.uint8)


def similarity(angle, scale, shift, centre=(WIDTH / 2, HEIGHT / 2)):
    """(2, 3) of a turn and a growth about the centre, and a shift."""
    matrix = scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return np.column_stack([matrix, np.asarray(centre) - matrix @ centre + shift])


def warped(frame, matrix):
    return cv2.warpAffine(frame, matrix, frame.shape[1::-1], borderMode=cv2.BORDER_REFLECT)


def errors(motion, matrix, width=WIDTH, height=HEIGHT):
    """The largest distance between the two motions of the corners of the frame and its centre."""
    points = np.array([[0, 0], [width, 0], [0, height], [width, height], [width / 2, height / 2]])
    (a, b), shift = motion.turn, motion.shift
    got = points @ np.array([[a, -b], [b, a]]).T + shift
    return np.linalg.norm(got - points @ matrix[:, :2].T - matrix[:, 2], axis=1).max()


def flow_between(first, second, before=None, now=None):
    flow = OpticalFlow()
    assert flow(first, before) is None
    return flow(second, now)


@pytest.mark.parametrize(
    ("angle", "scale", "shift", "size"),
    [
        (0.0, 1.0, (0.0, 0.0), 1),
        (0.0, 1.0, (7.3, -4.6), 1),
        (0.0, 1.0, (-40.0, 12.0), 1),
        (0.03, 1.0, (0.0, 0.0), 1),
        (0.0, 1.04, (0.0, 0.0), 1),
        (-0.02, 0.97, (11.0, 5.0), 1),
        (0.01, 1.02, (21.0, -9.0), 4),
    ],
)
def test_a_known_similarity_is_found_in_pixels_of_the_frame(angle, scale, shift, size):
    """To a quarter of a pixel in the corners of the picture, to which a large frame is reduced."""
    width, height = size * WIDTH, size * HEIGHT
    frame = cv2.resize(texture(), (width, height), interpolation=cv2.INTER_CUBIC)
    matrix = similarity(angle, scale, shift, (width / 2, height / 2))
    assert errors(flow_between(frame, warped(frame, matrix)), matrix, width, height) < 0.25 * size


@pytest.mark.parametrize("boxed", [(True, True), (True, False), (False, True)])
def test_what_moves_on_its_own_counts_for_nothing_inside_its_box(boxed):
    """A box over two thirds of the frame moves left while the rest moves right."""
    ground, crowd = texture(1), texture(2)
    frames = []
    for shift in (0, 6):
        frame = warped(ground, similarity(0, 1, (shift, 0)))
        frame[:, 40:360] = warped(crowd, similarity(0, 1, (-shift, 0)))[:, 40:360]
        frames.append(frame)
    boxes = np.array([[40.0, 0.0, 320.0, HEIGHT]])
    with_boxes = flow_between(*frames, *(boxes if given else None for given in boxed))
    assert errors(with_boxes, similarity(0, 1, (6, 0))) < 0.25
    without = flow_between(*frames)
    assert without is None or errors(without, similarity(0, 1, (-6, 0))) < 0.5


NOISE = np.random.default_rng(5)


def noisy(level):
    values = 128 + level * NOISE.standard_normal((HEIGHT, WIDTH, 3))
    return np.clip(values, 0, 255).astype(np.uint8)


@pytest.mark.parametrize(
    "frames",
    [
        [np.zeros((HEIGHT, WIDTH, 3), np.uint8)] * 2,
        [texture(1), texture(2)],
        [texture(), np.full((HEIGHT, WIDTH), 90, np.uint8)],
        [noisy(60), noisy(60)],
        [noisy(2.5), noisy(2.5)],
        [texture(height=31), texture(height=31)],
        [texture(height=1, width=1), texture(height=1, width=1)],
        [texture(), texture(width=WIDTH // 2)],
    ],
    ids=["blank", "cut", "dark", "noise", "faint noise", "flat", "one pixel", "another size"],
)
def test_no_motion_is_known_where_there_is_none_to_find(frames):
    """Not as an error, which would end the run, and not as a motion of the objects."""
    assert flow_between(*frames) is None


# --- what a tracker makes of it -------------------------------------------------------------------


def test_moments_are_carried_by_the_matrix_of_the_similarity():
    """Means by the matrix, variances by the diagonal of R V R', sizes by the scale."""
    rng = np.random.default_rng(1)
    parts = [rng.uniform(1, 3, (5, 4)) for _ in range(5)]
    a, b, shift = 1.02, 0.3, np.array([4.0, -7.0])
    got, matrix = CameraMotion(np.array([a, b]), shift).carry(Gaussian(*parts)), [[a, -b], [b, a]]
    expected = [part.copy() for part in parts]
    for k, power in enumerate((1, 1, 2, 2, 2)):
        expected[k][:, :2] = parts[k][:, :2] @ (np.array(matrix) ** power).T
    expected[0] += [*shift, *[np.log(np.hypot(a, b))] * 2]
    np.testing.assert_allclose(got, expected, rtol=1e-12)


TRACKER = ObjectTracker(max_objects=6)


def shaken(num_frames=24, seed=0):
    """Textures before a camera that jumps by up to 24 pixels, and four boxes that stand still."""
    rng, wide = np.random.default_rng(seed), texture(3, HEIGHT + 120, WIDTH + 120)
    jumps = rng.integers(-12, 13, (num_frames, 2)) * (np.arange(num_frames)[:, None] > 3)
    frames = [wide[y : y + HEIGHT, x : x + WIDTH] for x, y in 60 + jumps]
    corners = np.array([[80, 90], [200, 120], [300, 100], [380, 180]]) - jumps[:, None]
    boxes = np.concatenate([corners, np.tile([30.0, 60.0], (num_frames, 4, 1))], axis=2)
    return frames, list(boxes + rng.normal(0, 0.5, boxes.shape))


def run(frames, boxes, **settings):
    return list(track(frames, boxes, TRACKER, **settings))


def distances(tracks, boxes):
    """How far the nearest confirmed object is from the centre of each box, in pixels."""
    centres = boxes[:, :2] + boxes[:, 2:] / 2
    gaps = tracks.boxes[tracks.confirmed, :2] - centres[:, None]
    return np.linalg.norm(gaps, axis=2).min(axis=1)


@pytest.mark.exactness
def test_an_object_without_detections_moves_with_the_picture():
    """For the last four frames nothing is detected, and so detections cannot tell of jumps."""
    frames, boxes = shaken(seed=4)
    found = [rows if number < len(boxes) - 4 else rows[:0] for number, rows in enumerate(boxes)]
    pixels = run(frames, found, camera_motion="pixels")
    assert distances(pixels[-1], boxes[-1]).max() < 3
    detections = run(frames, found, camera_motion="detections")
    assert distances(detections[-1], boxes[-1]).min() > 6


@pytest.mark.exactness
def test_wrong_motions_from_pixels_are_overruled_by_the_detections():
    """Jumps of 5 pixels, which the camera did not make, are taken out again."""
    boxes, state, rng = shaken(1)[1][0], TRACKER.init(), np.random.default_rng(2)
    for _ in range(40):
        wrong = CameraMotion(np.array([1.0, 0]), np.array([rng.choice([-5.0, 5]), 0]))
        state, tracks = TRACKER.step(None, state, None, boxes, wrong)
    assert sorted(tracks.identities[tracks.confirmed]) == [1, 2, 3, 4]
    assert distances(tracks, boxes).max() < 1.0
    assert state.camera.left[0] > 0.03 > 0.02 > state.camera.left[1]  # of boxes 30 pixels wide


# --- without OpenCV, and what does not fit -------------------------------------------------------


def test_without_opencv_detections_alone_tell_the_motion(monkeypatch):
    """Silently by default; an explicit request names what is missing."""
    frames, boxes = shaken(6)
    expected = run(frames, boxes, camera_motion="detections")
    monkeypatch.setitem(sys.modules, "cv2", None)
    assert not has_opencv()
    for one, other in zip(run(frames, boxes), expected, strict=True):
        np.testing.assert_array_equal(one.boxes, other.boxes)
    with pytest.raises(ImportError, match="pip install opencv-python-headless"):
        track(frames, boxes, TRACKER, camera_motion="pixels")
