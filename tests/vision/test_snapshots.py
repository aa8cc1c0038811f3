"""Tracks made of what is kept of each frame."""

import numpy as np
import pytest

from mpfjax.vision.snapshots import Snapshot, track_rows


def snapshots(references=True):
    """Three components in three frames of one run; the second dies and its label is used again."""
    active = np.array([[1, 1, 0], [1, 0, 0], [1, 1, 1]], bool)
    owners = np.array([[0, 1, 5], [0, 1, 5], [0, 0, 1]])
    return [
        Snapshot(
            means=np.array([[[10.0 + m, 20.0 + frame, 4.0, 6.0] for m in range(3)]]),
            active=active[frame][None],
            points=None,
            labels=None,
            references=owners[frame][None] if references else None,
        )
        for frame in range(3)
    ]


def test_a_track_is_a_life_of_a_component():
    rows = track_rows(snapshots(references=False), first=7)
    assert rows[:, :2].tolist() == [[7, 1], [7, 2], [8, 1], [9, 1], [9, 3], [9, 4]]
    np.testing.assert_allclose(rows[1], [7, 2, 9.0, 17.0, 4.0, 6.0])


def test_or_a_hypothesis_about_one_of_the_given_boxes():
    rows = track_rows(snapshots(), by_reference=True)
    assert rows[:, :2].tolist() == [[1, 1], [1, 2], [2, 1], [3, 1], [3, 1], [3, 2]]


def test_without_references_there_is_no_such_track():
    with pytest.raises(ValueError, match="by_reference: the snapshots"):
        track_rows(snapshots(references=False), by_reference=True)
