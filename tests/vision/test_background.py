"""Detection against what was drawn, and on real video against boxes drawn by hand."""

import numpy as np
import pytest

from mpfjax.vision import BackgroundSubtraction, read_frames, read_tracks

cv2 = pytest.importorskip("cv2", reason="detection needs the extra 'video'")

HEIGHT, WIDTH = 120, 160
BODY = (12, 32)


def street(num_frames, people, seed=0, paint=None):
    """Noisy frames of a textured ground with a person at the corners that `people(t)` gives.

    A person is a head of half the width on a body; `paint(frame, t)` adds what else there is.
    """
    rng = np.random.default_rng(seed)
    ground = rng.uniform(90, 150, (HEIGHT, WIDTH, 3))
    frames = []
    for t in range(num_frames):
        frame = ground.copy()
        for x, y in people(t):
            w, h = BODY
            # What lies outside the frame is not drawn.
            for left, top, right, bottom in (
                (x + w // 4, y, x + 3 * w // 4, y + 9),
                (x, y + 8, x + w, y + h),
            ):
                frame[max(top, 0) : max(bottom, 0), max(left, 0) : max(right, 0)] = (200, 30, 40)
        if paint is not None:
            paint(frame, t)
        frames.append(np.clip(frame + rng.normal(0, 2, frame.shape), 0, 255).astype(np.uint8))
    return np.stack(frames)


def detections(frames):
    detector = BackgroundSubtraction()
    return [detector.detect(frame) for frame in frames]


def overlaps(boxes, others):
    """Intersection over union of each pair."""
    low = np.maximum(boxes[:, None, :2], others[:, :2])
    high = np.minimum((boxes[:, :2] + boxes[:, 2:])[:, None], others[:, :2] + others[:, 2:])
    shared = np.prod(np.maximum(high - low, 0), axis=2)
    return shared / (boxes[:, 2:].prod(axis=1)[:, None] + others[:, 2:].prod(axis=1) - shared)


def recall_and_precision(truth, boxes, least=0.5):
    """Shares of the true boxes that are found, and of the found ones that are true."""
    hits = [overlaps(*pair) >= least for pair in zip(truth, boxes, strict=True)]
    found = sum(hit.any(axis=1).sum() for hit in hits)
    right = sum(hit.any(axis=0).sum() for hit in hits)
    return found / sum(map(len, truth)), right / max(sum(map(len, boxes)), 1)


def walkers(t):
    return [(10 + 2 * t, 20), (140 - 2 * t, 70)]


def drawn(corners):
    return np.array([[x, y, *BODY] for x, y in corners], float).reshape(-1, 4)


def test_the_boxes_are_what_was_drawn():
    walk = [walkers(t) if t >= 10 else [] for t in range(60)]
    for found, corners in zip(detections(street(60, walk.__getitem__)), walk, strict=True):
        true = drawn(sorted(corners))
        assert found.shape == true.shape
        np.testing.assert_allclose(found, true, atol=2)


def test_who_is_there_in_the_first_frame_leaves_no_ghost():
    found = detections(street(40, walkers))
    assert len(found[0]) == 0
    true = [drawn(walkers(t)) for t in range(18, 40)]
    assert recall_and_precision(true, found[18:]) == (1, 1)


def test_boxes_are_clipped_to_the_frame():
    entering = [(-4, 50), (WIDTH - 8, 10), (60, HEIGHT - 20), (90, -8)]
    found = detections(street(12, lambda t: entering if t >= 10 else []))[-1]
    assert len(found) == 4
    assert np.all(found[:, :2] >= 0)
    assert np.all(found[:, :2] + found[:, 2:] <= [WIDTH, HEIGHT])
    low = np.maximum(drawn(entering)[:, :2], 0)
    high = np.minimum(drawn(entering)[:, :2] + BODY, [WIDTH, HEIGHT])
    true = np.hstack([low, high - low])
    assert overlaps(found, true).max(axis=1).min() > 0.5


def belt(frame, t):
    frame[60:62] = 120


def shadow(frame, t):
    frame[40:72, 50:62] *= 0.75 if t >= 10 else 1


def two_things(frame, t):
    if t >= 10:
        frame[10:13, 10:12] = frame[100:104, 20:90] = 255


@pytest.mark.parametrize(
    ("corners", "paint", "expected"),
    [
        ([(50, 40)], belt, [(50, 40, *BODY)]),  # a gap in the height is closed
        ([], shadow, []),
        ([], two_things, [(20, 100, 70, 4)]),  # what is much smaller than a person is dropped
    ],
)
def test_what_comes_after_ten_frames_is_found_if_it_may_be_a_person(corners, paint, expected):
    frames = street(12, lambda t: corners if t >= 10 else [], paint=paint)
    boxes = np.array(expected, float).reshape(-1, 4)
    np.testing.assert_allclose(detections(frames)[-1], boxes, atol=1)


def test_the_shape_of_one_is_learned_from_the_video():
    """People who walk alone for a while teach it that the two who come are two."""
    two = [(50, 40), (61, 42)]
    found = detections(street(40, lambda t: two if t >= 34 else [(10 + 3 * t, 40)]))[-1]
    np.testing.assert_allclose(found, drawn(two), atol=2)


@pytest.mark.exactness
@pytest.mark.real_data
def test_people_on_a_real_street_are_found(data):
    """Frames 1 to 120, with people from the first on, pairs, and an unlabelled walker."""
    folder = data / "pets09_s2l1"
    tracks = read_tracks(folder / "gt.txt")
    detector = BackgroundSubtraction()
    found = [detector.detect(frame) for frame in read_frames(folder, 1, 120)]
    true = [tracks[tracks[:, 0] == t][:, 2:] for t in range(1, 121)]
    recall, precision = recall_and_precision(true, found)
    assert recall > 0.77
    assert precision > 0.82


def test_a_large_frame_is_reduced_and_boxes_are_in_its_own_pixels():
    """The same street at eight times the size, looked at in a quarter of its pixels."""
    frames = street(12, lambda t: [(20 + 3 * t, 40)])
    large = [np.kron(frame, np.ones((8, 8, 1), np.uint8)) for frame in frames]
    small = detections(frames)[-1]
    found = detections(large)[-1]
    assert len(found) == len(small) == 1
    np.testing.assert_allclose(found, 8 * small, atol=8)
