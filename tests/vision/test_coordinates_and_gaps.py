"""What `track` makes of far origins, and of gaps between detections."""

import numpy as np
import pytest

from mpfjax.vision import ObjectTracker, track
from tests.vision.test_track import by_frame

TRACKER = ObjectTracker(6, frames_per_second=25)
NUM_FRAMES = 40


def crowd(num_frames=NUM_FRAMES):
    """Rows of four objects of .6 x 1.8 that walk, with errors of a few hundredths."""
    rng, rows = np.random.default_rng(0), []
    for frame in range(1, num_frames + 1):
        for number in range(4):
            x, y = 3 * number + 0.05 * frame, 2.5 * number
            rows.append([frame, -1, *(rng.normal([x, y], 0.02)), 0.6, 1.8, 1])
    return np.array(rows)


def placed(rows, x=0.0, y=0.0):
    return rows + np.array([0, 0, x, y, 0, 0, 0])


def alone(boxes):
    """The identities in each frame of one box a frame, None for no detection."""
    found = [np.zeros((0, 4)) if box is None else np.array([box], float) for box in boxes]
    return [living(tracks) for tracks in track(None, iter(found), TRACKER)]


def living(tracks):
    identities = np.asarray(tracks.identities)
    return sorted(identities[identities > 0].tolist())


# --- gaps ----------------------------------------------------------------------------------


@pytest.mark.parametrize("step", [(6.0, 0.0), (-6.0, 0.0), (0.0, 9.0), (0.0, -9.0)])
def test_a_gap_at_the_border_of_all_detections_so_far_ends_nobody(step):
    """An object that walks outward is at the border of what was detected at all times."""
    box = np.array([300.0, 200, 20, 40])
    boxes = [None if 5 <= t < 11 else box + t * np.array([*step, 0, 0]) for t in range(14)]
    assert alone(boxes) == [[1]] * 14


def test_who_leaves_a_frame_of_known_size_ends_and_who_enters_there_is_another():
    """The centre passes the right border, at 640, in the ninth frame."""
    leaving = [[580.0 + 6 * t, 200, 20, 40] for t in range(8)]
    gap = [np.zeros((0, 4))] * 8
    entering = [[615.0 - 6 * t, 200, 20, 40] for t in range(6)]
    found = [np.array([box]) for box in leaving] + gap + [np.array([box]) for box in entering]
    tracks = list(track(None, iter(found), TRACKER, frame_size=(480, 640)))
    assert living(tracks[6]) == [1]
    assert living(tracks[13]) == []
    assert living(tracks[-1]) == [2]


@pytest.mark.exactness
@pytest.mark.parametrize("every", [2, 14, 25])
def test_a_motionless_object_that_is_rarely_detected_is_one_object(every):
    boxes = [(100, 100, 10, 20) if t % every == 0 else None for t in range(6 * every + 1)]
    identities = alone(boxes)
    assert [identities[t] for t in range(0, len(boxes), every)] == [[1]] * 7


# --- coordinates ---------------------------------------------------------------------------


@pytest.mark.exactness
@pytest.mark.parametrize("origin", [(-5e6, 3e5), (4e8, 2e9)])
@pytest.mark.parametrize("form", ["rows", "iterable"])
def test_the_origin_of_the_coordinates_changes_nothing(origin, form):
    def tracked(rows):
        return list(track(None, rows if form == "rows" else by_frame(rows), TRACKER))

    near, far = tracked(crowd()), tracked(placed(crowd(), *origin))
    for here, there in zip(near, far, strict=True):
        np.testing.assert_array_equal(there.identities, here.identities)
        np.testing.assert_array_equal(there.shown, here.shown)
        np.testing.assert_array_equal(there.detections, here.detections)
        alive = np.asarray(here.identities) > 0
        moved = np.asarray(there.corner_boxes, float) - np.array([*origin, 0, 0])
        # An ulp of a float64 at 2e9 is 2e-7.
        np.testing.assert_allclose(moved[alive], here.corner_boxes[alive], atol=1e-5)
    assert max(max(living(tracks)) for tracks in far) == 4


def test_the_origin_moves_the_bounds_of_the_frame_too():
    """A lone object leaves on the right, with coordinates that are large and a frame that is so."""
    side = 10_000_000
    found = [np.array([[side - 60.0 + 6 * t, side - 500.0, 20, 40]]) for t in range(8)]
    found += [np.zeros((0, 4))] * 8
    tracks = list(track(None, iter(found), TRACKER, frame_size=(side, side)))
    assert living(tracks[6]) == [1]
    assert living(tracks[-1]) == []
