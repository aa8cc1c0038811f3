"""Tracks made of what is kept of each frame."""

import jax
import numpy as np
import pytest

from benchmarks.visual_tracking.following import Snapshot, follow, track_rows
from mpfjax.vision.boxes.recipes import PRESETS
from tests.marking import weekly


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


@pytest.mark.exactness
@pytest.mark.parametrize("name", ["default", *weekly(["paper"])])
def test_the_recipes_keep_to_objects_that_stand_still(name):
    """A red and a blue box on grey: a component is on each, and in all three frames."""
    still, boxes = (
        np.full((48, 64, 3), 110, np.uint8),
        np.array([[8.0, 10, 8, 14], [40, 24, 8, 14]]),
    )
    for (x, y, w, h), colour in zip(boxes.astype(int), [(220, 10, 10), (10, 10, 220)], strict=True):
        still[y : y + h, x : x + w] = colour
    keys = jax.random.split(jax.random.key(0), 1)
    snapshots = list(follow(keys, PRESETS[name](still, boxes)["mpf"], [still] * 3))
    assert len(snapshots) == 3
    for snapshot in snapshots:
        means = snapshot.means[0][snapshot.active[0]]
        gaps = np.abs(means[:, None, :2] - boxes[None, :, :2] - [4, 7]).max(axis=2)
        assert (gaps.min(axis=0) < 3).all()
