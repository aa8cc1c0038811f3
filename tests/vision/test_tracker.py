"""The object tracker, step by step: who begins, lives on and ends, by which detections."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax.vision import Detections, ObjectTracker
from mpfjax.vision.tracking.gaussian import CameraMotion
from mpfjax.vision.tracking.tracker import advanced, colours_of

HEIGHT, WIDTH, M, ROOM, SIZE = 48, 64, 4, 6, (6, 12)
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


def detections(boxes, scores=None, classes=None):
    boxes = np.asarray(boxes, float).reshape(-1, 4)
    scores = None if scores is None else np.asarray(scores, float)
    classes = None if classes is None else np.asarray(classes)
    size = (HEIGHT, WIDTH)
    return Detections.from_boxes(boxes, ROOM, scores, classes=classes, frame_size=size)


def run(corners_of_frames, tracker=TRACKER, seen=None, pixels=False, scores=None, classes=None):
    """The tracks of each frame.

    `seen(t, corners)` says what is detected, all by default, `scores(t)` how surely, and
    `classes(t)` of which class.
    """
    state, tracks = tracker.init(), []
    for t, corners in enumerate(corners_of_frames):
        boxes = boxes_at(corners) if seen is None else seen(t, corners)
        found = detections(boxes, *(None if of is None else of(t) for of in (scores, classes)))
        state, now = tracker.step(None, state, draw(corners) if pixels else None, found)
        tracks.append(jax.device_get(now))
        assert_sound(state, tracks[-1])
    return tracks


def assert_sound(state, tracks):
    alive = np.asarray(state.lives.identities) > 0
    identities = tracks.identities[alive]
    assert len(np.unique(identities)) == len(identities)
    assert identities.max(initial=0) <= int(state.lives.last_identity)
    assert not (tracks.confirmed | tracks.shown | (tracks.detections >= 0))[~alive].any()
    for leaf in jax.tree.leaves(state):
        assert np.isfinite(leaf).all()
    for variance in (state.objects.var_place, state.objects.var_velocity):
        assert (np.asarray(variance)[alive] >= 0).all()


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
    assert [each.unseen.max() for each in tracks] == [0] * 5 + [*range(1, PATIENCE + 1)] + [0, 0]


def test_what_is_not_yet_believed_may_be_missed_once_and_no_identity_is_used_again():
    """Beside one who is there from the start."""

    def seen(t, corners):
        return boxes_at(corners if t in (1, 4, 6) else corners[:1])

    tracks = run([[(50, 5), (20, 20)]] * 7, seen=seen)
    expected = [[1], [1, 2], [1, 2], [1], [1, 3], [1, 3], [1, 3]]
    assert [living(each) for each in tracks] == expected
    assert [believed(each) for each in tracks] == [[1]] * 6 + [[1, 3]]


def test_who_leaves_the_frame_ends_and_detections_outside_begin_nobody():
    tracks = run([[(50 + 2 * t, 20)] for t in range(12)])
    assert living(tracks[3]) == [1]
    assert living(tracks[-1]) == []
    assert max(each.identities.max() for each in tracks) == 1
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


def test_a_second_box_of_an_object_begins_no_other():
    tracks = run(
        [[(20, 20)]] * 4,
        seen=lambda t, c: boxes_at(c) if t == 0 else np.array([[20, 20, 6, 12], [20, 20, 6, 11.5]]),
    )
    assert all(living(each) == [1] for each in tracks)


def test_a_detection_between_two_is_less_probably_ones_own():
    apart, close = run([[(5, 5), (45, 5)]] * 5)[-1], run([[(20, 5), (22.2, 5)]] * 3)[-1]
    own = [each.probabilities[each.identities > 0] for each in (apart, close)]
    assert own[0].min() > 0.995 > own[1].max() > 0
    unseen = run([[(5, 5)]] * 3 + [[None]])[-1]
    assert unseen.probabilities.tolist() == [0.0] * M


def test_nothing_leaks_over_many_random_frames():
    """Detections that come, go, jump, overlap, and lie outside; every frame is checked."""
    rng = np.random.default_rng(1)
    state, ever, gone = TRACKER.init(), set(), set()
    for t in range(120):
        k = rng.integers(0, ROOM + 3)
        boxes = np.concatenate([rng.uniform(-10, 60, (k, 2)), rng.uniform(2, 20, (k, 2))], axis=1)
        if t % 7 in (0, 1, 2):
            boxes = np.concatenate([boxes[:2], boxes_at([(20, 20), (40 + t % 7, 5)])])
        frame = rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
        state, tracks = TRACKER.step(None, state, frame, detections(boxes))
        tracks = jax.device_get(tracks)
        assert_sound(state, tracks)
        now = set(living(tracks))
        assert not now & gone
        gone |= ever - now
        ever |= now
    assert len(ever) > 20
    assert max(ever) == int(state.lives.last_identity) == len(ever)


@pytest.mark.parametrize(("rate", "names"), [(8, 1), (25, 6)])
def test_what_begins_may_move_further_in_a_frame_where_frames_are_rare(rate, names):
    """By a box from frame to frame: an object at 8 frames a second, and six at 25."""
    tracker = ObjectTracker(M, frames_per_second=rate)
    state = tracker.init()
    for t in range(6):
        found = Detections.from_boxes(np.array([[20.0 * t, 50, 20, 40]]), ROOM)
        state, tracks = tracker.step(None, state, None, found)
    assert tracks.identities.max() == names


# --- a function of the state ---------------------------------------------------------------


def test_a_step_is_a_pure_function_and_a_scan_of_it_is_the_loop(tmp_path):
    """The key counts for nothing; a checkpoint is the state."""
    frames = [[(5 + t, 5), (50 - t, 30)] for t in range(6)]
    found = [detections(boxes_at(corners)) for corners in frames]
    states, state = [], TRACKER.init()
    for t, seen in enumerate(found):
        key = None if t % 2 else jax.random.key(t)
        state, tracks = TRACKER.step(key, state, None, seen)
        states.append(state)
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *found)
    scan = jax.jit(lambda xs: jax.lax.scan(lambda s, x: advanced(TRACKER, s, x), states[0], xs))
    last, scanned = scan(jax.tree.map(lambda leaf: leaf[1:], stacked))
    np.testing.assert_allclose(scanned.boxes[-1], tracks.boxes, rtol=1e-4)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-3), last, state)
    mpfjax.save_checkpoint(tmp_path / "state", states[2])
    kept = mpfjax.load_checkpoint(tmp_path / "state", TRACKER.init())
    for a, b in zip(jax.tree.leaves(kept), jax.tree.leaves(states[2]), strict=True):
        np.testing.assert_array_equal(a, b)


def test_who_looks_alike_in_place_is_told_by_colour():
    """Two of another shirt each come together in one place and go on: with pixels as they came."""

    def corners(t):
        return [(8 + 3 * t, 20), (44 - 3 * t, 20)]

    looked = colours_of(draw(corners(0)), detections(boxes_at(corners(0))))
    assert sum(leaf.size for leaf in jax.tree.leaves(looked)) < 4 * ROOM * 18 * 8 * 3
    tracks = run([corners(t) for t in range(13)], pixels=True)
    first = 1 if box_of(tracks[0], 1)[0] < box_of(tracks[0], 2)[0] else 2
    assert box_of(tracks[-1], first)[0] > box_of(tracks[-1], 3 - first)[0]


@pytest.mark.parametrize("pixels", [False, True])
def test_a_step_takes_what_a_detector_gives(pixels):
    """Boxes with scores and classes, or the same with room of one's own."""
    boxes, scores, classes = boxes_at([(5, 5), (50, 30)]), np.array([1.0, 0.9]), np.array([1, 2])
    frame, size = (draw([(5, 5), (50, 30)]), (HEIGHT, WIDTH)) if pixels else (None, None)
    own = Detections.from_boxes(boxes, 2 * M, scores, classes=classes, frame_size=size)
    found = (
        TRACKER.step(None, TRACKER.init(), frame, given)
        for given in ((boxes, scores, classes), own)
    )
    for a, b in zip(*map(jax.tree.leaves, found), strict=True):
        np.testing.assert_array_equal(a, b)


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
def test_scores_may_be_ranked_taken_as_given_or_ignored(pair, rank, as_given):
    corners = [[(5 + t, 5), (50 - t, 30)] for t in range(4)]
    for scores, number in (("rank", rank), ("as_given", as_given), ("ignore", 2)):
        chosen = ObjectTracker(M, frames_per_second=8, scores=scores)
        tracks = run(corners, chosen, scores=lambda t: pair)
        assert [len(living(each)) for each in tracks] == [number] * 4


def test_classes_keep_objects_apart_unless_they_do_not_matter():
    """One box in the same place for ever, whose class changes in the fifth frame."""

    def ever(class_matters, change):
        chosen = ObjectTracker(M, frames_per_second=8, class_matters=class_matters)
        tracks = run([[(20, 20)]] * 8, chosen, classes=lambda t: [1 if t < 4 else change])
        of_class = {}
        for each in tracks:
            for name in living(each):
                of_class.setdefault(name, set()).update(each.classes[each.identities == name])
        assert all(len(classes) == 1 for classes in of_class.values())  # it keeps the first
        return sorted(of_class)

    assert ever(True, 2) == [1, 2]
    assert ever(True, 0) == [1]  # 0 is none, and goes with all
    assert ever("prefers", 2) == [1]
    assert ever(False, 2) == [1]


def test_boxes_of_other_classes_are_no_doubles_and_the_likelier_class_is_taken():
    """A rider on a horse: two boxes that overlap by more than a half, in all frames."""
    pair = np.array([[20, 20, 10, 20], [20, 22, 10, 19]], float)

    def number(class_matters):
        chosen = ObjectTracker(M, frames_per_second=8, class_matters=class_matters)
        tracks = run([[]] * 5, chosen, seen=lambda t, c: pair, classes=lambda t: [1, 2])
        return len(living(tracks[-1]))

    assert number(True) == 2
    assert number(False) == 1
    chosen = ObjectTracker(M, frames_per_second=8, class_matters="prefers")
    both = [(20, 20), (26, 20)]
    tracks = run([both] * 6, chosen, classes=lambda t: [1, 2])
    rows = {name: set() for name in (1, 2)}
    for each in tracks:
        for name in rows:
            rows[name].add(int(each.detections[each.identities == name][0]))
    assert rows == {1: {0}, 2: {1}} or rows == {1: {1}, 2: {0}}


# --- a camera that shakes ------------------------------------------------------------------


EIGHT = ObjectTracker(8, frames_per_second=25)
FOLLOW = jax.jit(lambda xs: jax.lax.scan(lambda s, x: advanced(EIGHT, s, *x), EIGHT.init(), xs)[1])


@pytest.mark.parametrize(("shake", "width"), [(4, 45), (10, 45), (4, 10), (9, 10)])
def test_still_objects_before_a_shaking_camera_are_shown_and_keep_their_names(shake, width):
    """Two have weaker scores, and must not seem to be none. Pixels tell of jolts by a box."""
    at, box = np.array([[150, 150], [350, 160], [200, 350], [420, 340]]), width * np.array([1, 2])
    for rng in map(np.random.default_rng, range(5)):
        frames, jolts = [], rng.normal(0, shake, (80, 2)).astype(np.float32)
        for before, jolt in zip(np.roll(jolts, 1, axis=0), jolts, strict=True):
            noise = rng.normal(0, 0.02, (4, 4))
            sizes = box * np.exp(noise[:, 2:])
            boxes = np.concatenate([at + jolt + noise[:, :2] * box - sizes / 2, sizes], axis=1)
            told = CameraMotion(np.float32([1, 0]), jolt - before, np.asarray(2 * shake > width))
            frames.append((Detections.from_boxes(boxes, 8, np.array([1, 1, 0.6, 0.6])), None, told))
        tracks = FOLLOW(jax.tree.map(lambda *leaves: np.stack(leaves), *frames))
        shown, names = np.asarray(tracks.shown), np.asarray(tracks.identities)
        assert shown.sum(axis=1).min() == names.max() == 4
