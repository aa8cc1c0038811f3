"""What `track` makes of far origins, and of gaps between detections."""

import numpy as np
import pytest

from mpfjax.vision import ObjectTracker, track
from tests.vision.test_track import by_frame

TRACKER = ObjectTracker(6, frames_per_second=25)
BOX = np.array([100.0, 200, 20, 40])


def identities(boxes, **options):
    """The identities in each frame of one box a frame, None for no detection."""
    found = [np.zeros((0, 4)) if box is None else np.array([box], float) for box in boxes]
    return [sorted(each.identities.tolist()) for each in track(None, found, TRACKER, **options)]


@pytest.mark.parametrize("step", [(6.0, 0.0), (-6.0, 0.0), (0.0, 9.0), (0.0, -9.0)])
def test_a_gap_at_the_border_of_all_detections_so_far_ends_nobody(step):
    """An object that walks outward is at the border of what was detected at all times."""
    boxes = [None if 5 <= t < 11 else BOX + t * np.array([*step, 0, 0]) for t in range(14)]
    assert identities(boxes) == [[1]] * 14


@pytest.mark.parametrize("right", [640, 10_000_000])
def test_who_leaves_a_frame_of_known_size_ends_and_who_enters_there_is_another(right):
    """The centre passes the right border in the ninth frame."""
    leaving = [[right - 60.0 + 6 * t, 200, 20, 40] for t in range(8)]
    entering = [[right - 25.0 - 6 * t, 200, 20, 40] for t in range(6)]
    found = identities([*leaving, *[None] * 8, *entering], frame_size=(480, right))
    assert [found[t] for t in (6, 13, -1)] == [[1], [], [2]]


@pytest.mark.exactness
@pytest.mark.parametrize("every", [2, 14, 25])
def test_a_motionless_object_that_is_rarely_detected_is_one_object(every):
    found = identities([BOX if t % every == 0 else None for t in range(6 * every + 1)])
    assert found[::every] == [[1]] * 7


@pytest.mark.exactness
@pytest.mark.parametrize("origin", [(-5e6, 3e5), (4e8, 2e9)])
@pytest.mark.parametrize("form", [np.array, by_frame])
def test_the_origin_of_the_coordinates_changes_nothing(origin, form):
    """Four objects of .6 x 1.8 walk, and are detected with errors of a few hundredths."""
    rng, rows = np.random.default_rng(0), []
    for frame, number in np.ndindex(40, 4):
        place = rng.normal([3 * number + 0.05 * frame, 2.5 * number], 0.02)
        rows.append([frame + 1, -1, *place, 0.6, 1.8, 1])
    moved = np.array(rows) + np.array([0, 0, *origin, 0, 0, 0])
    near, far = (list(track(None, form(each), TRACKER)) for each in (np.array(rows), moved))
    for here, there in zip(near, far, strict=True):
        for name in ("identities", "shown", "detections"):
            np.testing.assert_array_equal(getattr(there, name), getattr(here, name))
        # An ulp of a float64 at 2e9 is 2e-7.
        expected = here.corner_boxes + np.array([*origin, 0, 0])
        np.testing.assert_allclose(there.corner_boxes, expected, rtol=0, atol=1e-5)
    assert max(each.identities.max() for each in far) == 4
