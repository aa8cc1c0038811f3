"""The rendered scene: the same for the same key, with boxes that fit what is drawn."""

import jax
import numpy as np
import pytest

from benchmarks.scenes.football import football_scene


@pytest.fixture(scope="module")
def scene():
    return football_scene(jax.random.key(3), 12)


def test_the_same_key_gives_the_same_scene(scene):
    again, other = (football_scene(jax.random.key(seed), 12) for seed in (3, 4))
    np.testing.assert_array_equal(scene.frames, again.frames)
    np.testing.assert_array_equal(scene.tracks, again.tracks)
    assert not np.array_equal(scene.tracks, other.tracks)


def test_the_kits_are_where_the_boxes_are(scene):
    """The upper middle of a box is its player's shirt: red of kit 0, no redder than blue of 1."""
    first = scene.tracks[scene.tracks[:, 0] == 1]
    for _, id, x, y, w, h in first:
        middle = scene.frames[0][int(y + 0.3 * h), int(x + w / 2)].astype(int)
        redness = middle[0] - middle[2]
        assert redness > 80 if scene.kits[int(id)] == 0 else redness < 40
