"""The loop over frames: any detector, with pixels and without, and what may go wrong on the way."""

import itertools
import threading
import warnings

import numpy as np
import pytest
from PIL import Image

from mpfjax.vision import ObjectTracker, Tracks, track
from mpfjax.vision.boxes.recipes import follow_boxes
from mpfjax.vision.tracking.track import _WAITING, offline_rows, online_rows

SHAPE = (48, 64, 3)
NUM_FRAMES = 8
TRACKER = ObjectTracker(3)


def walks(num_frames=NUM_FRAMES):
    """Rows of two boxes that walk past each other at some distance, the second the stronger."""
    t = np.arange(num_frames)
    one = np.column_stack([t + 1, 0 * t - 1, 20 + t, 0 * t + 5, 0 * t + 8, 0 * t + 14, 0 * t + 1])
    two = np.column_stack([t + 1, 0 * t - 1, 44 - t, 0 * t + 28, 0 * t + 8, 0 * t + 14, 0 * t + 2])
    return np.concatenate([one, two]).astype(float)


def stills(num_frames=NUM_FRAMES):
    """Noise with a red and a blue box where the rows are."""
    frames = np.random.default_rng(0).integers(90, 130, (num_frames, *SHAPE), dtype=np.uint8)
    for frame, _, x, y, w, h, score in walks(num_frames).astype(int):
        frames[frame - 1, y : y + h, x : x + w] = (220, 10, 10) if score == 1 else (10, 10, 220)
    return frames


def by_frame(rows):
    """Boxes and scores of each frame."""
    for frame in range(1, int(rows[:, 0].max()) + 1):
        here = rows[rows[:, 0] == frame]
        yield here[:, 2:6], here[:, 6]


def detector_of(rows):
    found = by_frame(rows)
    return lambda frame: next(found)


def tracked(frames, detections, **options):
    return list(track(frames, detections, TRACKER, **options))


def assert_same(some, others, same_rows=True):
    """The same tracks, and where the same was given the same rows of it."""
    assert len(some) == len(others)
    for a, b in zip(some, others, strict=True):
        if not same_rows:
            a = a._replace(detections=b.detections)
        for left, right in zip(a, b, strict=True):
            np.testing.assert_array_equal(left, right)


@pytest.fixture(scope="module")
def with_pixels():
    return tracked(stills(), walks())


@pytest.fixture(scope="module")
def without_pixels():
    return tracked(None, walks())


@pytest.mark.parametrize(
    ("wrap", "ahead"), [(by_frame, False), (detector_of, False), (detector_of, True)]
)
def test_every_kind_of_detector_gives_the_same_tracks(wrap, ahead, with_pixels):
    """Also where frames are looked at ahead of the tracks."""
    assert_same(tracked(iter(stills()), wrap(walks()), ahead=ahead), with_pixels)


def test_files_are_tracked_by_their_paths(tmp_path, with_pixels, without_pixels):
    path = tmp_path / "det.txt"
    path.write_text("".join(",".join(map(str, row)) + "\n" for row in walks()))
    assert_same(tracked(None, path), without_pixels)
    assert_same(tracked(None, str(path)), without_pixels)
    for number, still in enumerate(stills(), 1):
        Image.fromarray(still).save(tmp_path / f"{number}.png")
    assert_same(tracked(tmp_path, walks()), with_pixels)


def test_frames_ahead_end_with_the_tracks_and_errors_come_in_their_place():
    """Another thread reads a few frames ahead; warnings and errors are as without it."""
    read, readers, before = [], set(), threading.active_count()

    def camera():
        try:
            for number in range(1, 41):
                readers.add(threading.current_thread())
                read.append(number)
                yield np.zeros(SHAPE, np.uint8)
            warnings.warn("it is dusk", RuntimeWarning, stacklevel=1)
            raise OSError("unplugged")
        finally:
            read.append("closed")

    def run():
        return track(camera(), lambda frame: np.zeros((0, 4)), TRACKER, ahead=True)

    tracks = run()
    next(tracks)
    tracks.close()
    assert read.pop() == "closed"
    # Those that wait, the one that was taken, and one in the thread's hands.
    assert len(read) <= _WAITING + 2
    tracks = run()
    with pytest.warns(RuntimeWarning, match="it is dusk"):  # noqa: PT031
        assert [next(tracks).number for _ in range(40)] == list(range(1, 41))
        with pytest.raises(OSError, match="unplugged"):
            next(tracks)
    assert threading.current_thread() not in readers
    assert threading.active_count() == before


def test_weak_detections_are_left_out_where_a_least_score_is_given():
    rows = walks()
    strong = rows[rows[:, 6] >= 1.5]
    assert_same(tracked(None, rows, min_score=1.5), tracked(None, strong), same_rows=False)


# --- bad input -----------------------------------------------------------------------------------


def in_every_frame(*box):
    return [[frame, -1, *box, 9.0] for frame in range(1, NUM_FRAMES + 1)]


def two_thousand():
    """As weak ones, where two boxes and these four fill the room."""
    weak = np.random.default_rng(0).uniform(5, 40, (2000, 7))
    weak[:, 0], weak[:, 6] = 4, 0.1
    return weak


FOUR = np.array([[4, -1, 10 * i, 40, 5, 5, 1] for i in range(4)], float)


@pytest.mark.parametrize(
    ("message", "bad", "others"),
    [
        (r"frame 1, row 0, .* of no area", in_every_frame(10.0, 10, 5, -5), FOUR[:0]),
        (r"frame 1, row 0, .* not finite", in_every_frame(10.0, np.nan, 5, 5), FOUR[:0]),
        (r"frame 1, row 0, .* outside the frame", in_every_frame(10.0, -30, 5, 30), FOUR[:0]),
        ("frame 4 has 2006, more than the 6 of max_detections", two_thousand(), FOUR),
    ],
)
def test_what_cannot_be_tracked_is_left_out_with_one_warning(message, bad, others):
    with pytest.warns(RuntimeWarning, match=message) as caught:
        run = tracked(stills(), np.concatenate([bad, walks(), others]))
    assert sum("detections: " in str(each.message) for each in caught) == 1
    assert_same(run, tracked(stills(), np.concatenate([walks(), others])), same_rows=False)


def test_more_objects_than_room_are_flagged_and_the_strongest_kept():
    places = np.stack([np.arange(6) * 10, np.full(6, 10), np.full(6, 6), np.full(6, 12)], axis=1)
    scores = np.linspace(0.5, 1, 6)
    tracker = ObjectTracker(3, scores="as_given")
    with pytest.warns(RuntimeWarning, match="frame 1 has more objects than the 3 .* max_objects"):
        run = list(track(None, [(places, scores)] * 3, tracker))
    assert run[0].full
    np.testing.assert_allclose(np.sort(run[-1].boxes[:, 0]), [33, 43, 53], atol=3)


def test_detections_after_the_last_frame_are_told_of():
    with pytest.warns(RuntimeWarning, match="4 lie in frames after the last, 6"):
        tracked(stills()[:6], walks())
    with pytest.warns(RuntimeWarning, match="go on after the last frame, 6"):
        tracked(stills()[:6], by_frame(walks()))


def test_an_error_of_the_detector_says_in_which_frame():
    def detector(frame):
        if next(numbers) == 2:
            raise OSError("no network")
        return np.zeros((0, 4))

    numbers = itertools.count(1)
    with pytest.raises(OSError, match="no network") as caught:
        tracked(stills(), detector)
    assert "detector at frame 2" in caught.value.__notes__[0]


def test_a_damaged_frame_is_predicted_and_later_ones_keep_their_numbers():
    frames = [*stills()]
    frames[2] = None
    boxes = iter([[[10.0 + t, 10, 12, 20]] for t in range(NUM_FRAMES - 1)])
    tracks = list(track(frames, lambda frame: next(boxes), TRACKER))
    assert all(1 in each.identities for each in tracks)
    found = [bool((each.detections >= 0).any()) for each in tracks]
    assert found == [frame is not None for frame in frames]


# --- which frames there are -----------------------------------------------------------------------


def test_a_frame_that_a_mapping_has_not_is_one_without_a_detector():
    """As None in the place of boxes is."""
    some = {n: each for n, each in enumerate(by_frame(walks()), 1) if n not in (4, 6)}
    listed = [some.get(number) for number in range(1, NUM_FRAMES + 1)]
    assert_same(tracked(None, some), tracked(None, listed))
    assert all(tracks.shown.sum() == 2 for tracks in tracked(None, some))


def rows_at(*numbers):
    """A row of one still object in each of these frames."""
    return np.array([[number, -1, 20.0, 10, 12, 30, 0.9] for number in numbers]).reshape(-1, 7)


@pytest.mark.parametrize(
    ("numbers", "steps"),
    [((100_001, 100_002, 100_004), 4), (1_732_665_600_000 + 40 * np.arange(3), 81), ((), 0)],
    ids=["a late clip", "milliseconds", "none"],
)
def test_steps_without_pixels_begin_at_the_first_row(numbers, steps):
    by_number = {number: rows_at(number)[:, 2:6] for number in numbers}
    for detections in (rows_at(*numbers), by_number):
        assert len(list(track(None, detections))) == steps


@pytest.mark.parametrize(
    ("numbers", "options", "named"),
    [
        ((2, 1, 99_999), {}, "frame 99999 comes 99997 frames after frame 2"),
        ((99_999,), {"first": 7}, "frame 99999 comes 99992 frames after frame 7"),
        ((1, 1502), {}, "frame 1502 .* a minute has 1500"),
    ],
)
def test_a_row_that_is_a_minute_later_is_named(numbers, options, named):
    by_number = {number: rows_at(number)[:, 2:6] for number in numbers}
    for detections in (rows_at(*numbers), by_number):
        with pytest.raises(ValueError, match=f"detections: {named}"):
            track(None, detections, **options)


def test_a_minute_without_rows_passes_where_it_is_filmed_or_less():
    slow = ObjectTracker(2, frames_per_second=1)
    assert len(list(track(None, rows_at(1, 61), slow))) == 61
    fast = ObjectTracker(2, frames_per_second=100)
    assert next(track(None, rows_at(1, 5000), fast)).identities.size
    next(track(stills(1), rows_at(1, 5000)))


# --- which detection is whose ---------------------------------------------------------------------


def test_tracks_say_which_row_each_object_took_whatever_the_order_and_what_is_left_out():
    rows, flat, labels = walks(), [0.0, 0, 0, 5], []
    order = np.random.default_rng(0).permuted(np.tile(np.arange(3), (NUM_FRAMES, 1)), axis=1)
    frames = [
        np.array([*rows[rows[:, 0] == t + 1, 2:6], flat])[order[t]] for t in range(NUM_FRAMES)
    ]
    with pytest.warns(RuntimeWarning, match="frame 1, row ., .* of no area"):
        found = tracked(None, [*frames, np.zeros((0, 4))])
    for tracks, names in zip(found, order, strict=False):
        labels.append(dict(zip(tracks.identities.tolist(), names[tracks.detections], strict=True)))
    assert all(each == labels[0] and set(each.values()) == {0, 1} for each in labels)
    assert (found[-1].detections == -1).all()


# --- rows, trackers, drawn boxes -----------------------------------------------------------------


def test_rows_online_are_of_what_was_known_then_and_offline_of_what_is_known_at_the_end():
    boxes, none = np.tile([10.0, 20.0, 4.0, 8.0], (3, 1)), np.zeros(3, int)
    tracks = [
        Tracks(
            boxes, np.array(identities), np.array(confirmed) > 0, none, False,
            np.array(shown) > 0, none - 1, 0.0 * none, none, 1.0 + none, number,
        )
        for number, identities, confirmed, shown in (
            (5, [2, 1, 0], [0, 0, 0], [0, 0, 0]),
            (6, [2, 1, 3], [0, 1, 0], [0, 1, 0]),
            (7, [0, 1, 3], [0, 1, 1], [0, 0, 0]),  # 3 is an object, but for a duplicate
        )
    ]  # fmt: skip
    online = np.concatenate([online_rows(each) for each in tracks])
    assert online.tolist() == [[6, 1, 8, 16, 4, 8]]
    assert offline_rows(tracks)[:, :2].tolist() == [[5, 1], [6, 1]]
    assert offline_rows([]).shape == (0, 6)
    assert online_rows(tracks[1], described=True).tolist() == [[6, 1, 8, 16, 4, 8, 1, 0]]


@pytest.mark.parametrize(
    ("form", "warning"),
    [("corners", "boxes reach far beyond the frame"), ("shares", "lie within"), ("pixels", None)],
)
def test_boxes_that_are_not_corner_and_size_are_warned_of(form, warning):
    rng = np.random.default_rng(0)
    corners, sides = rng.uniform(0, 90, (4, 6, 2)), rng.uniform(5, 10, (4, 6, 2))
    boxes = np.concatenate([corners, sides + (corners if form == "corners" else 0)], axis=2)
    boxes = boxes / 100 if form == "shares" else boxes
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        list(track(None, list(boxes), frame_size=(100, 100)))
    messages = [str(each.message) for each in caught]
    assert len(messages) == (warning is not None)  # once
    assert warning is None or f"{warning}" in messages[0]


def test_a_first_row_is_shown_at_once_where_its_score_is_no_low_one():
    for score, shown in ((0.1, 0), (0.9, 1)):
        found = [(np.array([[10.0, 20.0, 5.0, 9.0]]), np.array([score]))] * 2
        first, second = track(None, found)
        assert (first.shown.sum(), second.shown.sum()) == (shown, 1)


def test_tracks_have_the_number_of_their_frame():
    rows = walks()
    late = list(track(None, rows[rows[:, 0] > 2]))
    assert [tracks.number for tracks in late] == list(range(3, NUM_FRAMES + 1))
    assert online_rows(late[0])[0, 0] == 3
    tracker = ObjectTracker()
    assert tracker.step(None, tracker.init(), None, None)[1].number == 1


@pytest.mark.exactness
def test_drawn_boxes_give_one_track_each_in_the_order_given():
    first = walks()[walks()[:, 0] == 1][:, 2:6]
    frames = [*stills()[:4]]
    frames[1] = None  # it cannot be decoded
    run = list(follow_boxes(frames, first[::-1]))
    assert len(run) == len(frames)
    with pytest.raises(ValueError, match="frames: there is no first one, in which the boxes are"):
        next(follow_boxes([None], first))
    for number, tracks in enumerate(run, 1):
        assert tracks.number == number
        rows = online_rows(tracks)
        assert rows[:, 1].tolist() == [1, 2]
        expected = walks()[walks()[:, 0] == number][::-1, 2:6]
        np.testing.assert_allclose(rows[:, 2:4], expected[:, :2], atol=9)


def test_frames_move_objects_by_the_time_between_them():
    """One that walks steadily, seen at 10 and 2.5 frames a second by turns, never out of sight."""
    since = np.cumsum([0.1, 0.4] * 12)
    boxes, times = [np.array([[60 * time, 20.0, 30.0, 60.0]]) for time in since], 1.7e9 + since
    tracker = ObjectTracker(3, frames_per_second=10)
    # In the last frame no detector ran, and it is predicted.
    *_, before, ahead = track(None, [*boxes[:-1], None], tracker, times=times)
    assert before.identities.tolist() == [1]
    assert ahead.corner_boxes[0, 0] == pytest.approx(60 * since[-1], abs=3)
    times[-1] = times[-2] + 1.2  # more than a second without a detection
    *_, lost = track(None, [*boxes[:-1], boxes[0][:0]], tracker, times=times)
    assert len(lost.identities) == 0
    state, _ = tracker.step(None, tracker.init(), None, boxes[0], time=3.0)
    with pytest.raises(ValueError, match=r"time: 3\.0 s is not after"):
        tracker.step(None, state, None, boxes[0], time=3.0)
