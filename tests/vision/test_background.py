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


def nobody(t):
    return []


def detections(frames, **settings):
    detector = BackgroundSubtraction(**settings)
    return [detector.detect(frame) for frame in frames]


def overlaps(boxes, others):
    """Intersection over union of each pair, one pixel at a time."""
    masks = []
    for group in (boxes, others):
        masks.append(np.zeros((len(group), 400, 400), bool))
        for mask, (x, y, w, h) in zip(masks[-1], np.round(group).astype(int), strict=True):
            mask[max(y, 0) : y + h, max(x, 0) : x + w] = True
    first, second = (mask.reshape(len(mask), 400 * 400).astype(float) for mask in masks)
    shared = first @ second.T
    return shared / (first.sum(1)[:, None] + second.sum(1)[None] - shared)


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
    frames = street(60, lambda t: walkers(t) if t >= 10 else [])
    found = detections(frames)
    for t in range(60):
        true = drawn(walkers(t) if t >= 10 else [])
        assert found[t].shape == true.shape
        ordered = true[np.argsort(true[:, 0])]
        np.testing.assert_allclose(found[t], ordered, atol=2)


def test_who_is_there_in_the_first_frame_leaves_no_ghost():
    frames = street(40, walkers)
    found = detections(frames)
    assert len(found[0]) == 0
    true = [drawn(walkers(t)) for t in range(40)]
    recall, precision = recall_and_precision(true[18:], found[18:])
    assert recall == 1
    assert precision == 1


def test_boxes_are_clipped_to_the_frame():
    entering = [(-4, 50), (WIDTH - 8, 10), (60, HEIGHT - 20), (90, -8)]
    found = detections(street(12, lambda t: entering if t >= 10 else []))[-1]
    assert len(found) == 4
    assert np.all(found[:, :2] >= 0)
    assert np.all(found[:, :2] + found[:, 2:] <= [WIDTH, HEIGHT])
    assert overlaps(found, drawn(entering)).max(axis=1).min() > 0.5


def side_by_side(t):
    return [(50, 40), (61, 42)] if t >= 10 else []


def test_the_shape_of_one_is_learned_from_the_video():
    """People who walk alone for a while teach it that the two who come are two."""
    frames = street(40, lambda t: side_by_side(t) if t >= 34 else [(10 + 3 * t, 40)])
    found = detections(frames)[-1]
    np.testing.assert_allclose(found, drawn(side_by_side(11)), atol=2)


def test_a_gap_in_the_height_of_a_person_is_closed():
    def belt(frame, t):
        frame[60:62] = 120

    frames = street(12, lambda t: [(50, 40)] if t >= 10 else [], paint=belt)
    np.testing.assert_allclose(detections(frames)[-1], drawn([(50, 40)]), atol=1)


def test_a_shadow_is_no_person():
    def shadow(frame, t):
        if t >= 10:
            frame[40:72, 50:62] *= 0.75

    frames = street(12, nobody, paint=shadow)
    assert len(detections(frames)[-1]) == 0


def test_what_has_not_the_size_of_a_person_is_dropped():
    def things(frame, t):
        if t >= 10:
            frame[10:13, 10:12] = frame[100:104, 20:90] = frame[20:90, 100:104] = 255

    frames = street(12, nobody, paint=things)
    assert len(detections(frames, area=(0.015, 1.0))[-1]) == 0
    lenient = detections(frames, area=(0.0, 1.0))[-1]
    np.testing.assert_allclose(lenient, [(10, 10, 2, 3), (20, 100, 70, 4), (100, 20, 4, 70)])


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
