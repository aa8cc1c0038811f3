"""Rendered scenes: the facts of the paper's section 3.2, and boxes that fit what is drawn."""

import jax
import numpy as np
import pytest

from benchmarks.scenes import distracter_scene


def overlap(a, b):
    low, high = np.maximum(a[:2], b[:2]), np.minimum(a[:2] + a[2:], b[:2] + b[2:])
    return np.prod(np.maximum(high - low, 0)) / np.prod(a[2:])


@pytest.fixture(scope="module")
def scenes():
    return [distracter_scene(jax.random.key(seed)) for seed in range(12)]


def gaps(scene):
    """How far object 1 is clear of the place of the distracter, in each frame."""
    offsets = np.abs(scene.boxes[:, 0, :2] - scene.distracter[7, :2])
    return np.max(offsets - scene.boxes[0, 0, 2:], axis=1)


def test_the_distracter_stands_over_object_one_which_walks_away(scenes):
    for scene in scenes:
        there = np.isfinite(scene.distracter).all(axis=1)
        assert (np.flatnonzero(there) + 1).tolist() == [3, 4, 5, 6, 7, 8]
        for t in np.flatnonzero(there):
            np.testing.assert_array_equal(scene.distracter[t], scene.boxes[2, 0])
            assert all(overlap(scene.distracter[t], box) == 0 for box in scene.boxes[t, 1:])
        # Corners are rounded to whole pixels.
        assert 3 <= gaps(scene)[7] <= 13
        assert gaps(scene)[-1] >= 11
