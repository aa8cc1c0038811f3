"""The synthetic sequence of section 3.2: the paper's facts about it, and boxes that fit it."""

import jax
import numpy as np
import pytest

from benchmarks.scenes import distracter_scene


@pytest.fixture(scope="module")
def scene():
    return distracter_scene(jax.random.key(0))


def overlap(a, b):
    low, high = np.maximum(a[:2], b[:2]), np.minimum(a[:2] + a[2:], b[:2] + b[2:])
    return np.prod(np.maximum(high - low, 0)) / np.prod(a[2:])


def test_sizes(scene):
    assert scene.frames.shape == (25, 288, 360, 3)
    assert scene.frames.dtype == np.uint8
    assert scene.boxes.shape == (25, 7, 4)
    assert len(np.unique(scene.boxes[:, :, 2:].reshape(-1, 2), axis=0)) == 1


def test_the_same_key_gives_the_same_scene(scene):
    again, other = (distracter_scene(jax.random.key(seed)) for seed in (0, 1))
    np.testing.assert_array_equal(scene.frames, again.frames)
    np.testing.assert_array_equal(scene.boxes, again.boxes)
    assert not np.array_equal(scene.boxes, other.boxes)


@pytest.fixture(scope="module")
def scenes(scene):
    return [scene, *(distracter_scene(jax.random.key(seed)) for seed in range(1, 12))]


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


def test_object_one_is_the_quicker_one(scenes):
    """By its deviation, of 4 for 3, and because it walks clear of where it was."""
    steps = np.diff(np.stack([scene.boxes[..., :2] for scene in scenes]), axis=1)
    speed = np.linalg.norm(steps, axis=-1).mean(axis=(0, 1))
    assert speed[0] > 1.25 * speed[1:].max()


@pytest.mark.parametrize("seed", range(2))
def test_a_distracter_with_a_speed_leads_away(seed):
    scene = distracter_scene(
        jax.random.key(seed), size=(32, 40), speed=6.0, deviation=3.0, noise="colour"
    )
    np.testing.assert_array_equal(scene.boxes[..., 2:], np.broadcast_to([32, 40], (25, 7, 2)))
    moved = np.hypot(*(scene.distracter[2:8] - scene.distracter[2])[:, :2].T)
    np.testing.assert_allclose(moved, 6 * np.arange(6), atol=1.5)
    way = scene.boxes[7, 0, :2] - scene.boxes[2, 0, :2]
    assert (scene.distracter[7] - scene.distracter[2])[:2] @ way < 0


def test_objects_keep_inside_and_apart():
    for seed in range(4):
        boxes = distracter_scene(jax.random.key(seed)).boxes
        assert (boxes[..., :2] >= 0).all()
        assert (boxes[..., :2] + boxes[..., 2:] <= np.array([360, 288])).all()
        for frame in boxes:
            assert not any(overlap(a, b) for i, a in enumerate(frame) for b in frame[:i])


def test_steps_are_those_of_the_papers_dynamics(scenes):
    """x_t - x_{t-1} - 0.5 (x_{t-1} - x_{t-2}) has a deviation of 3; boxes are on whole pixels."""
    paths = np.stack([scene.boxes[:, 1:, :2] for scene in scenes])
    steps = np.diff(paths, axis=1)
    noise = steps[:, 1:] - 0.5 * steps[:, :-1]
    rounding = (1 + 1.5**2 + 0.5**2) / 12
    np.testing.assert_allclose(noise.std(), np.sqrt(9 + rounding), rtol=0.04)
    correlation = np.corrcoef(noise[:, 1:].ravel(), noise[:, :-1].ravel())[0, 1]
    assert abs(correlation) < 0.2


def test_what_is_drawn_is_where_the_boxes_are(scene):
    """A box holds its object, whose colours stay, and what is not an object is noise."""
    stills = scene.frames.astype(float)
    free = np.ones(stills.shape[:3], bool)
    for t, frame in enumerate(scene.boxes.astype(int)):
        for x, y, w, h in [*frame, *scene.distracter[t : t + 1][np.isfinite(
            scene.distracter[t : t + 1, 0])].astype(int)]:  # fmt: skip
            free[t, y : y + h, x : x + w] = False
    assert np.array_equal(stills[free][:, 0], stills[free][:, 2])
    assert abs(stills[free].mean() - 127.5) < 0.5
    assert abs(stills[free].std() - np.sqrt((256**2 - 1) / 12)) < 0.5
    for j in range(1, 7):
        means = []
        for t in (0, 5, 24):
            x, y, w, h = scene.boxes[t, j].astype(int)
            means.append(stills[t, y : y + h, x : x + w].mean(axis=(1, 2)))
        np.testing.assert_array_equal(means[0], means[1])
        np.testing.assert_array_equal(means[0], means[2])


def test_the_template_is_the_distracter_over_object_one(scene):
    frame, box = scene.template
    np.testing.assert_array_equal(frame, scene.frames[2])
    np.testing.assert_array_equal(box, scene.boxes[2, 0])
    x, y, w, h = box.astype(int)
    covered = frame[y : y + h, x : x + w].astype(int)
    x, y, w, h = scene.boxes[0, 0].astype(int)
    own = scene.frames[0, y : y + h, x : x + w].astype(int)
    change = np.abs(covered - own).mean(axis=(1, 2))
    assert change[: h // 4].mean() < 25 < change[h // 2 :].mean()


def test_coloured_noise():
    frame = distracter_scene(jax.random.key(0), 3, noise="colour").frames[0].astype(float)
    corner = frame[:20, :20].reshape(-1, 3)
    assert abs(np.corrcoef(corner.T)[0, 1]) < 0.2


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("size", (24, 0)),
        ("size", (120, 90)),
        ("size", (102, 24)),
        ("speed", -1.0),
        ("speed", np.nan),
        ("speed", 30.0),
        ("deviation", 0.0),
        ("deviation", np.inf),
        ("deviation", 0.2),
        ("deviation", 1e300),
        ("noise", "white"),
        ("num_frames", 300),
    ],
)
def test_what_leaves_no_scene_is_named(monkeypatch, name, value):
    monkeypatch.setattr("benchmarks.scenes.distracter._TRIES", 1000)
    with pytest.raises(ValueError, match=f"^{name}"):
        distracter_scene(jax.random.key(0), **{name: value})


def test_too_few_frames_are_named():
    with pytest.raises(ValueError, match="num_frames: 2 is not a whole number of at least 3"):
        distracter_scene(jax.random.key(0), 2)
    assert np.isfinite(distracter_scene(jax.random.key(0), 3).distracter[2]).all()
