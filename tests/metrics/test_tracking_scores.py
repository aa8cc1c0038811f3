"""Scores of tracks so small that each can be worked out by hand."""

import numpy as np
import pytest

from mpfjax.metrics.tracking_scores import multi_object_scores, overlap


def row(frame, id, x, y=0.0, w=10.0, h=20.0):
    return [frame, id, x, y, w, h]


# Two objects over four frames: eight boxes.
TRUTH = np.array([row(t, id, 100.0 * id) for t in (1, 2, 3, 4) for id in (1, 2)])
NONE = np.zeros((0, 6))
RATIOS = ("HOTA", "DetA", "AssA", "MOTA", "MOTP", "IDF1")
COUNTS = ("id_switches", "false_positives", "misses")


def check(scores, **expected):
    """Every ratio is 1 and every count 0, but for those given."""
    perfect = dict.fromkeys(RATIOS, 1.0) | dict.fromkeys(COUNTS, 0.0)
    assert scores == pytest.approx(perfect | expected)


@pytest.mark.parametrize("tracks", [NONE, np.array([row(t, 1, 100.0, w=0.0) for t in (1, 2)])])
def test_tracks_that_find_nothing(tracks):
    """None at all, and boxes without area."""
    pytest.importorskip("trackeval", reason="scoring needs the extra 'trackeval', of 'test'")
    nothing = dict.fromkeys(RATIOS, 0.0)
    nothing["MOTA"] = -len(tracks) / 8
    check(multi_object_scores(tracks, TRUTH), **nothing, misses=8, false_positives=len(tracks))


def test_overlap_by_hand():
    boxes = np.array([[0.0, 0, 10, 10], [5, 5, 10, 10], [2, 2, -4, 3], [3, 3, 0, 0]])
    objects = np.array([[0.0, 0, 10, 10], [2, 2, 5, 5], [20, 20, 1, 1]])
    expected = [[1, 0.25, 0], [25 / 175, 4 / 121, 0], [0, 0, 0], [0, 0, 0]]
    np.testing.assert_allclose(overlap(boxes, objects), expected)
    assert overlap(np.zeros((0, 4)), objects).shape == (0, 3)
