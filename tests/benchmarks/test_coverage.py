"""Coverage, strays and swaps on tracks small enough to count by hand."""

import numpy as np
import pytest

from benchmarks.coverage import coverage, covers


def row(frame, id, x, y=0.0, w=10.0, h=20.0):
    return [frame, id, x, y, w, h]


def test_the_reach_of_a_box():
    """|dx| < 0.75 w and |dy| < 0.5 h of the object, strictly, whatever the track's own size."""
    truth = np.array([[0.0, 0, 10, 20]])
    centres = [(5 + 7.4, 10), (5 + 7.5, 10), (5, 10 + 9.9), (5, 10 + 10), (5 - 7.4, 10 - 9.9)]
    boxes = np.array([(x - 2, y - 3, 4, 6) for x, y in centres])
    assert covers(boxes, truth)[:, 0].tolist() == [True, False, True, False, True]


def test_shares_by_hand():
    objects = np.array([row(t, id, 100 * id) for t in (1, 2, 3, 4) for id in (1, 2)])
    tracks = np.array(
        [row(1, 7, 100), row(1, 8, 200), row(2, 7, 100), row(2, 8, 500), row(3, 8, 200)]
    )
    result = coverage(tracks, objects)
    assert result.all_covered == 0.25
    assert result.per_object == {1: 0.5, 2: 0.5}
    assert result.on_object == pytest.approx(4 / 5)
    assert result.id_swaps == 0


def test_a_box_on_somebody_else_is_told_from_one_on_nothing():
    objects = np.array([row(1, 1, 100), row(2, 1, 100)])
    others = np.array([row(1, 2, 104), row(1, 3, 300), row(3, 3, 300)])
    tracks = np.array(
        [row(1, 7, 100), row(1, 8, 300), row(2, 8, 300), row(2, 9, 500), row(3, 9, 300)]
    )
    result = coverage(tracks, objects, others)
    assert (result.on_object, result.on_other) == (1 / 4, 1 / 4)
    assert coverage(tracks, objects) == result._replace(on_other=0.0)


def test_an_object_without_a_box_does_not_count():
    objects = np.array([row(1, 1, 0), row(2, 1, 0), row(2, 2, 100)])
    result = coverage(np.array([row(1, 5, 0), row(2, 5, 0)]), objects)
    assert result.all_covered == 0.5
    assert result.per_object == {1: 1.0, 2: 0.0}


def test_two_tracks_that_change_objects_are_two_swaps():
    objects = np.array([row(t, id, 100 * id) for t in (1, 2) for id in (1, 2)])
    tracks = np.array([row(1, 7, 100), row(1, 8, 200), row(2, 8, 100), row(2, 7, 200)])
    assert coverage(tracks, objects).id_swaps == 2


def test_a_track_that_still_covers_is_kept_though_another_is_nearer():
    objects = np.array([row(1, 1, 100), row(2, 1, 100)])
    tracks = np.array([row(1, 7, 100), row(2, 7, 104), row(2, 8, 100)])
    assert coverage(tracks, objects).id_swaps == 0


def test_a_gap_is_no_swap_but_a_new_track_is():
    objects = np.array([row(t, 1, 100) for t in (1, 2, 3, 4)])
    tracks = np.array([row(1, 7, 100), row(3, 7, 100), row(4, 9, 100)])
    assert coverage(tracks, objects).id_swaps == 1


def test_one_track_is_not_the_identity_of_two_objects():
    objects = np.array([row(1, 1, 100), row(1, 2, 104), row(2, 1, 100), row(2, 2, 104)])
    tracks = np.array([row(1, 7, 100), row(2, 7, 100), row(2, 8, 104)])
    result = coverage(tracks, objects)
    assert result.id_swaps == 0
    assert result.all_covered == 1.0


def test_no_tracks_and_no_objects():
    objects = np.array([row(1, 1, 100)])
    nothing = coverage(np.zeros((0, 6)), objects)
    assert (nothing.all_covered, nothing.on_object, nothing.id_swaps) == (0.0, 0.0, 0)
    with pytest.raises(ValueError, match="objects"):
        coverage(np.zeros((0, 6)), np.zeros((0, 6)))
