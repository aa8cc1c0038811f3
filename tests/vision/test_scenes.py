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


def test_shapes_and_ids(scene):
    assert scene.frames.shape == (12, 288, 512, 3)
    assert scene.frames.dtype == np.uint8
    assert scene.tracks.shape == (12 * 8, 6)
    assert scene.kits == {1: 0, 2: 0, 3: 0, 4: 0, 5: 1, 6: 1, 7: 1, 8: 1}
    for frame in range(1, 13):
        assert scene.tracks[scene.tracks[:, 0] == frame, 1].tolist() == list(range(1, 9))


def test_the_kits_are_where_the_boxes_are(scene):
    """The upper middle of a box is its player's shirt: red of kit 0, no redder than blue of 1."""
    first = scene.tracks[scene.tracks[:, 0] == 1]
    for _, id, x, y, w, h in first:
        middle = scene.frames[0][int(y + 0.3 * h), int(x + w / 2)].astype(int)
        redness = middle[0] - middle[2]
        assert redness > 80 if scene.kits[int(id)] == 0 else redness < 40


@pytest.mark.thorough
def test_the_camera_moves_and_players_change_places():
    long = football_scene(jax.random.key(0), 110, height=96, width=160)
    centres = long.tracks[:, 2] + long.tracks[:, 4] / 2
    across = centres.reshape(110, 8)[:, :4]
    order = np.argsort(across, axis=1)
    assert (order != order[0]).any(), "no two players of the team ever cross"
    stand = np.abs(np.diff(long.frames[:, :20].astype(int), axis=0)).mean(axis=(1, 2, 3))
    assert stand.mean() > 1, "the stand stays where it is: the camera does not pan"


@pytest.mark.parametrize(
    ("name", "options"),
    [("num_frames", {"num_frames": 0}), ("num_players", {"num_players": 0}),
     ("num_opponents", {"num_opponents": -1})],
)  # fmt: skip
def test_wrong_numbers_are_named(name, options):
    with pytest.raises(ValueError, match=name):
        football_scene(jax.random.key(0), **options)


def test_one_player_alone():
    scene = football_scene(jax.random.key(0), 2, num_players=1, num_opponents=0)
    assert scene.kits == {1: 0}
