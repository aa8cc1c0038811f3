"""The object tracker, step by step: who begins, lives on and ends, by which detections."""

import pickle

import jax
import numpy as np
import pytest

from mpfjax.vision import ObjectTracker
from mpfjax.vision.tracking.detections import FrameDetections
from mpfjax.vision.tracking.gaussian import CameraMotion
from mpfjax.vision.tracking.step import advance
from mpfjax.vision.tracking.tracker import with_colours
from tests.marking import weekly

HEIGHT, WIDTH, M, SIZE = 48, 64, 4, (6, 12)
PATIENCE = 8  # a second, and the least there is
SHIRTS = [(220, 30, 30), (30, 30, 220), (30, 200, 30), (220, 200, 30), (200, 30, 200), (20,) * 3]
TRACKER = ObjectTracker(M, frames_per_second=8)


def draw(corners):
    """A frame with a person in a shirt of its own at each corner that is not None."""
    frame = np.full((HEIGHT, WIDTH, 3), 128, np.uint8)
    for corner, shirt in zip(corners, SHIRTS, strict=False):
        if corner is not None:
            (x, y), (w, h) = (max(int(c), 0) for c in corner), SIZE
            frame[y : y + h, x : x + w] = shirt
    return frame


def boxes_at(corners):
    rows = [[*corner, *SIZE] for corner in corners if corner is not None]
    return np.array(rows, float).reshape(-1, 4)


def run(corners_of_frames, tracker=TRACKER, seen=None, pixels=False, scores=None, classes=None):
    """The tracks of each frame.

    `seen(t, corners)` says what is detected, all by default, `scores(t)` how surely, and
    `classes(t)` of which class.
    """
    state, tracks = tracker.init(), []
    for t, corners in enumerate(corners_of_frames):
        boxes = boxes_at(corners) if seen is None else seen(t, corners)
        found = boxes, *(None if of is None else of(t) for of in (scores, classes))
        trackable = FrameDetections.of(found, t + 1, (HEIGHT, WIDTH), tracker.kind)
        if pixels:
            trackable = with_colours(trackable, draw(corners))
        state, now = advance(tracker, state, trackable)
        tracks.append(now)
        assert_sound(state, tracks[-1])
    return tracks


def assert_sound(state, tracks):
    assert len(np.unique(tracks.identities)) == len(tracks.identities) <= M
    assert tracks.identities.min(initial=1) >= 1
    assert tracks.identities.max(initial=0) <= state.last_identity
    assert not (tracks.shown & ~tracks.confirmed).any()
    for leaf in jax.tree.leaves(state):
        assert np.isfinite(leaf).all()
    for variance in (state.objects.var_place, state.objects.var_velocity):
        assert (variance >= 0).all()


def living(tracks):
    return sorted(tracks.identities[tracks.identities > 0].tolist())


def believed(tracks):
    return sorted(tracks.identities[tracks.confirmed].tolist())


def box_of(tracks, identity):
    (m,) = np.flatnonzero(tracks.identities == identity)
    return tracks.boxes[m]


def centre_of(corner):
    return np.array(corner) + np.array(SIZE) / 2


# --- who begins and who ends ---------------------------------------------------------------


@pytest.mark.parametrize("pixels", [False, True])
def test_objects_are_confirmed_at_their_second_detection_and_keep_their_identities(pixels):
    """Two walk from the first frame on, a third comes later; every mean box stays on its own."""

    def corners(t):
        return [(5 + t, 5), (50 - t, 30), (30, 3) if t >= 5 else None]

    tracks = run([corners(t) for t in range(12)], pixels=pixels)
    assert [living(each) for each in tracks] == [[1, 2]] * 5 + [[1, 2, 3]] * 7
    # Who is there at the start is believed in at once, and the newcomer in its second frame.
    assert [believed(each) for each in tracks] == [[1, 2]] * 6 + [[1, 2, 3]] * 6
    assert all((each.unseen == 0).all() for each in tracks)
    for t, each in enumerate(tracks[8:], 8):
        ids = [1, 2] if abs(box_of(each, 1)[0] - 8 - t) < 3 else [2, 1]
        for identity, corner in zip(ids, corners(t)[:2], strict=True):
            np.testing.assert_allclose(box_of(each, identity)[:2], centre_of(corner), atol=1.0)
            np.testing.assert_allclose(box_of(each, identity)[2:], SIZE, rtol=0.1)


def test_an_object_outlives_its_detections_for_a_second():
    tracks = run([[(20, 20)]] * (7 + PATIENCE), seen=lambda t, c: boxes_at(c if t < 5 else []))
    assert [living(each) for each in tracks] == [[1]] * (5 + PATIENCE) + [[]] * 2
    assert [each.unseen.max(initial=0) for each in tracks] == [0] * 5 + [
        *range(1, PATIENCE + 1)
    ] + [0, 0]


def test_what_is_not_yet_believed_may_be_missed_once_and_no_identity_is_used_again():
    """Beside one who is there from the start."""

    def seen(t, corners):
        return boxes_at(corners if t in (1, 4, 6) else corners[:1])

    tracks = run([[(50, 5), (20, 20)]] * 7, seen=seen)
    expected = [[1], [1, 2], [1, 2], [1], [1, 3], [1, 3], [1, 3]]
    assert [living(each) for each in tracks] == expected
    assert [believed(each) for each in tracks] == [[1]] * 6 + [[1, 3]]


def test_detections_outside_the_frame_begin_nobody():
    outside = [[WIDTH + 3, 10, 6, 12], [-20, 10, 6, 12], [10, -40, 6, 12], [10, 200, 6, 12]]
    in_part = [WIDTH - 5, 20, 8, 12]
    for tracks in run([[]] * 3, seen=lambda t, c: np.array([*outside, in_part], float)):
        assert living(tracks) == [1]


def test_a_full_house_takes_no_more_and_the_next_free_place_is_filled():
    corners = [(2, 2), (14, 2), (26, 2), (38, 2), (50, 2), (2, 30)]

    def seen(t, given):
        return boxes_at(given if t < 3 else given[1:])

    tracks = run([corners] * 3 + [[None, *corners[1:]]] * (PATIENCE + 2), seen=seen)
    for each in tracks[:3]:
        assert living(each) == [1, 2, 3, 4]
        assert each.full
    assert living(tracks[-1]) == [2, 3, 4, 5]


def test_a_detection_between_two_is_less_probably_ones_own():
    apart, close = run([[(5, 5), (45, 5)]] * 5)[-1], run([[(20, 5), (22.2, 5)]] * 3)[-1]
    own = [each.probabilities[each.identities > 0] for each in (apart, close)]
    assert own[0].min() > 0.995 > own[1].max() > 0
    unseen = run([[(5, 5)]] * 3 + [[None]])[-1]
    assert unseen.probabilities.tolist() == [0.0]


@pytest.mark.exactness
def test_nothing_leaks_over_many_random_frames():
    """Detections that come, go, jump, overlap, and lie outside; every frame is checked."""
    rng = np.random.default_rng(1)
    state, ever, gone = TRACKER.init(), set(), set()
    for t in range(120):
        k = rng.integers(0, 9)
        boxes = np.concatenate([rng.uniform(-10, 60, (k, 2)), rng.uniform(2, 20, (k, 2))], axis=1)
        if t % 7 in (0, 1, 2):
            boxes = np.concatenate([boxes[:2], boxes_at([(20, 20), (40 + t % 7, 5)])])
        frame = rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
        state, tracks = TRACKER.step(None, state, frame, boxes)
        assert_sound(state, tracks)
        now = set(living(tracks))
        assert not now & gone
        gone |= ever - now
        ever |= now
    assert len(ever) > 20
    assert max(ever) == state.last_identity == len(ever)


# --- frames without a detector, dropped frames, long covers -----------------------------------


def steps(tracker, found):
    """The tracks of each frame."""
    state, tracks = tracker.init(), []
    for boxes in found:
        state, now = tracker.step(None, state, None, boxes)
        tracks.append(now)
    return tracks


@pytest.mark.exactness
def test_a_frame_on_which_the_detector_did_not_run_is_not_one_in_which_nothing_is_there():
    """One walks, and the detector runs on every tenth frame: it stays, is shown, and moves on."""
    tracker = ObjectTracker(M, frames_per_second=25)
    boxes = [np.array([[20.0 + 2 * t, 50, 20, 40]]) for t in range(90)]
    ran = [box if t < 30 or t % 10 == 0 else None for t, box in enumerate(boxes)]
    tracks = steps(tracker, ran)
    assert all(each.identities.tolist() == [1] and each.shown.all() for each in tracks)
    assert [each.unseen.max() for each in tracks] == [0] * 90
    for each, box in zip(tracks[30:], boxes[30:], strict=True):
        np.testing.assert_allclose(each.corner_boxes, box, atol=1.5)
    nobody = steps(tracker, [box if box is not None else np.zeros((0, 4)) for box in ran])
    assert not all(each.shown.any() for each in nobody)
    gone = steps(tracker, [*boxes[:30], *[None] * 60, np.zeros((0, 4))])
    assert [len(each.identities) for each in gone[-2:]] == [1, 0]  # a detector ran


@pytest.mark.exactness
@pytest.mark.parametrize(("lost_seconds", "names"), [(None, 2), (3.0, 1)])
def test_an_object_behind_a_long_cover_is_the_same_for_as_long_as_one_says(lost_seconds, names):
    tracker = ObjectTracker(M, frames_per_second=25, lost_seconds=lost_seconds)
    walk = [np.array([[20.0 + 2 * t, 50, 20, 40]]) for t in range(120)]
    covered = [boxes[:0] if 40 <= t < 90 else boxes for t, boxes in enumerate(walk)]
    assert steps(tracker, covered)[-1].identities.max() == names


# --- a function of the state ---------------------------------------------------------------


def test_a_step_is_a_pure_function_of_a_state_that_may_be_kept():
    """The key counts for nothing; a state that went on is as it was."""
    frames = [boxes_at([(5 + t, 5), (50 - t, 30)]) for t in range(6)]
    states = [TRACKER.init()]
    for t, boxes in enumerate(frames):
        key = None if t % 2 else jax.random.key(t)
        states.append(TRACKER.step(key, states[-1], None, boxes)[0])
    again = pickle.loads(pickle.dumps(states[2]))
    for boxes in frames[2:]:
        again, _ = TRACKER.step(None, again, None, boxes)
    for a, b in zip(jax.tree.leaves(again), jax.tree.leaves(states[-1]), strict=True):
        np.testing.assert_array_equal(a, b)


def test_who_looks_alike_in_place_is_told_by_colour():
    """Two of another shirt each come together in one place and go on: with pixels as they came."""

    def corners(t):
        return [(8 + 3 * t, 20), (44 - 3 * t, 20)]

    tracks = run([corners(t) for t in range(13)], pixels=True)
    first = 1 if box_of(tracks[0], 1)[0] < box_of(tracks[0], 2)[0] else 2
    assert box_of(tracks[-1], first)[0] > box_of(tracks[-1], 3 - first)[0]


# --- scores and classes --------------------------------------------------------------------


def test_a_weak_detection_sustains_an_object_and_begins_none():
    """Two walk; the scores of one fall to a third of the other's, and it is not lost for that."""
    corners = [[(5 + t, 5), (50 - t, 30)] for t in range(10)]
    both = run(corners, scores=lambda t: [1.0, 1.0 if t < 4 else 0.35])
    assert all(living(each) == [1, 2] for each in both)
    assert all((each.unseen == 0).all() for each in both)
    late = run(
        corners,
        seen=lambda t, c: boxes_at(c[:1] if t < 4 else c),
        scores=lambda t: [1.0] if t < 4 else [1.0, 0.35],
    )
    assert all(living(each) == [1] for each in late)


def test_scores_count_in_shares_of_a_sure_one():
    corners = [[(5 + t, 5), (50 - t, 30)] for t in range(8)]
    hardly = run(corners, scores=lambda t: [1.0, 1.0 if t < 4 else 0.1])
    assert [int(each.unseen.max()) for each in hardly] == [0] * 4 + [1, 2, 3, 4]
    scores = np.random.default_rng(0).uniform(0.1, 1, (8, 2))
    once = run(corners, scores=lambda t: scores[t])
    again = run(corners, scores=lambda t: 90 * scores[t])
    for a, b in zip(once, again, strict=True):
        np.testing.assert_array_equal(a.identities, b.identities)
        np.testing.assert_array_equal(a.unseen, b.unseen)


@pytest.mark.parametrize(
    ("pair", "rank", "as_given"), [([1, 0.3], 1, 1), ([9, 1], 1, 2), ([0.4, 0.3], 2, 0)]
)
def test_scores_may_be_ranked_or_taken_as_given(pair, rank, as_given):
    corners = [[(5 + t, 5), (50 - t, 30)] for t in range(4)]
    for scores, number in (("rank", rank), ("as_given", as_given)):
        chosen = ObjectTracker(M, frames_per_second=8, scores=scores)
        tracks = run(corners, chosen, scores=lambda t: pair)
        assert [len(living(each)) for each in tracks] == [number] * 4


@pytest.mark.parametrize(("change", "names"), [(2, [1, 2]), (0, [1])])
def test_an_object_has_detections_of_its_own_class_or_of_none(change, names):
    """One box in the same place for ever, whose class changes in the fifth frame; 0 is none."""
    tracks = run([[(20, 20)]] * 8, classes=lambda t: [1 if t < 4 else change])
    classes = {name: set() for name in names}
    for each in tracks:
        for name, of_name in zip(each.identities.tolist(), each.classes.tolist(), strict=True):
            classes[name].add(of_name)
    assert list(classes.values()) == [{name} for name in names]  # it keeps the first


@pytest.mark.parametrize(("classes", "number"), [([1, 2], 2), ([1, 1], 1)])
def test_boxes_of_another_class_are_no_duplicates(classes, number):
    """A rider on a horse: two boxes that overlap by more than a half, in all frames."""
    pair = np.array([[20, 20, 10, 20], [20, 22, 10, 19]], float)
    tracks = run([[]] * 5, seen=lambda t, c: pair, classes=lambda t: classes)
    assert len(living(tracks[-1])) == number


@pytest.mark.parametrize(("speed", "is_tracked"), [(20, True), (34, True), (111, False)])
def test_an_object_that_moves_its_length_in_a_frame_is_tracked_from_its_second(speed, is_tracked):
    """Beside one that stands still, whose detections are not taken from it; no further, though."""
    tracker, still = ObjectTracker(M, frames_per_second=10), [200, 100, 16, 37]
    state = tracker.init()
    for t in range(12):
        moving = [[400, 1300 - speed * t, 16, 37]] * (t >= 4)
        state, tracks = tracker.step(None, state, None, np.array([still, *moving], float))
        assert tracks.identities[0] == 1
        if t > 4:
            assert tracks.confirmed.all() == is_tracked
    assert (tracks.identities.max() == 2) == is_tracked


@pytest.mark.parametrize(("away", "is_known"), [(60, True), (6, False)])
def test_what_was_weakly_detected_for_a_while_is_shown_with_its_first_strong_detection(
    away, is_known
):
    """Three tenths of a second; but not beside an object, where it may be one more box of it."""
    tracker = ObjectTracker(M, frames_per_second=10)
    state = tracker.init()
    for t in range(6):
        boxes = np.array([[100.0, 50, 20, 40], [100.0 + away, 72, 20, 40]])
        scores = np.array([1.0, 0.8 if t == 5 else 0.3])
        state, tracks = tracker.step(None, state, None, (boxes, scores))
        assert tracks.shown.sum() == 1 + (t == 5 and is_known)


# --- a camera that shakes ------------------------------------------------------------------


EIGHT = ObjectTracker(8, frames_per_second=25)


@pytest.mark.exactness
@pytest.mark.parametrize(("shake", "width"), [(10, 45), (9, 10), *weekly([(4, 45), (4, 10)])])
def test_still_objects_before_a_shaking_camera_are_shown_and_keep_their_names(shake, width):
    """Two have weaker scores, and must not seem to be none. Pixels tell of jolts by a box."""
    at, box = np.array([[150, 150], [350, 160], [200, 350], [420, 340]]), width * np.array([1, 2])
    for rng in map(np.random.default_rng, range(5)):
        state, jolts = EIGHT.init(), rng.normal(0, shake, (80, 2))
        for before, jolt in zip(np.roll(jolts, 1, axis=0), jolts, strict=True):
            noise = rng.normal(0, 0.02, (4, 4))
            sizes = box * np.exp(noise[:, 2:])
            boxes = np.concatenate([at + jolt + noise[:, :2] * box - sizes / 2, sizes], axis=1)
            told = CameraMotion(np.array([1.0, 0]), jolt - before) if 2 * shake > width else None
            found = boxes, np.array([1, 1, 0.6, 0.6])
            state, tracks = EIGHT.step(None, state, None, found, told)
            assert tracks.shown.sum() == tracks.identities.max() == 4


def test_velocities_end_with_the_pan_that_all_objects_followed():
    """Otherwise the camera's shift makes up for them, and who is detected alone is lost."""
    at, state = np.array([[150, 150], [350, 160], [200, 350], [420, 340]]), EIGHT.init()
    rng, places = np.random.default_rng(0), np.cumsum([12.0] * 40 + [0.0] * 25)
    for t, place in enumerate(places):
        corners = at + np.array([place, 0]) + rng.normal(0, 1, (4, 2))
        boxes = np.concatenate([corners, 0 * at + 40], axis=1)
        state, tracks = EIGHT.step(None, state, None, boxes[: 1 if t >= 60 else 4])
    assert np.abs(state.objects.velocity[0, 0]) < 1
    assert tracks.identities.max() == 4
    assert tracks.shown[0]


def test_a_jolt_is_told_by_those_known_for_long_whatever_becomes_of_a_newcomer():
    """Two objects jump by half a box; a third, of three frames, has no detection since."""
    at, state = np.array([[150, 150], [350, 160], [200, 350]]), EIGHT.init()
    for t in range(30):
        boxes = np.concatenate([at + np.array([0, 20 * (t >= 27)]), 0 * at + 40], axis=1)
        state, tracks = EIGHT.step(None, state, None, boxes[: 3 if 24 <= t < 27 else 2])
    assert tracks.identities.tolist() == [1, 2, 3]
