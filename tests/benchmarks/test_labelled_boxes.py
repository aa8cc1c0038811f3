"""Labels as states, and boxes around them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.likelihood_tuning.labelled_boxes import boxes_around, labelled_states
from mpfjax import Autoregression, RandomWalk, WalkWithVelocity
from mpfjax.vision.boxes.colour_model import ColourModel
from mpfjax.vision.files.boxes import centred

FRAME = np.full((40, 60, 3), 90, np.uint8)
BOXES = np.array([[10.0, 8, 12, 16], [35, 12, 12, 20]])
TRACK = np.stack([BOXES, BOXES + np.array([[1.0, 2, 3, 4]])])


@pytest.fixture(scope="module")
def model():
    return ColourModel.from_frame(FRAME, BOXES)


def test_states_of_labels_stand_for_their_boxes(model):
    states = labelled_states(model, TRACK)
    np.testing.assert_array_equal(states.reference, [[0, 1], [0, 1]])
    for t in range(2):
        found = model.boxes(jax.tree.map(lambda leaf, t=t: leaf[t], states))
        np.testing.assert_allclose(found, centred(TRACK[t]), rtol=1e-5)


def test_states_of_second_order_remember_the_frame_before():
    dynamics = Autoregression.with_momentum(0.5, jnp.ones(4))
    states = labelled_states(ColourModel.from_frame(FRAME, BOXES, dynamics=dynamics), TRACK)
    np.testing.assert_array_equal(states.previous, states.box[jnp.array([0, 0])])


def test_states_with_a_velocity_remember_it_over_all_frames():
    dynamics = WalkWithVelocity(RandomWalk(np.ones(4)), 0.25)
    track = np.concatenate([TRACK, TRACK[1:] + np.array([2.0, 1, 0, 0])])
    states = labelled_states(ColourModel.from_frame(FRAME, BOXES, dynamics=dynamics), track)
    velocity = np.zeros_like(states.box[0])
    for t in range(1, 3):
        velocity += 0.25 * np.asarray(states.box[t] - states.box[t - 1] - velocity)
        np.testing.assert_allclose(states.box[t] - states.previous[t], velocity, atol=1e-5)


def test_boxes_around_fill_the_neighbourhood_evenly(model):
    states = labelled_states(model, TRACK)
    around = boxes_around(jax.random.key(0), model, states, 2000, reach=1.5, stretch=1.3)
    assert around.box.shape == (2, 2, 2000, 4)
    np.testing.assert_array_equal(around.reference[..., 7], states.reference)
    size = np.asarray(TRACK[..., None, 2:])
    shift = np.asarray(around.box - states.box[:, :, None])[..., :2] / size
    power = np.log((around.box / states.box[:, :, None])[..., 2:]) / np.log(1.3)
    for uniform in (shift / 1.5, power):
        assert np.abs(uniform).max() <= 1.001
        np.testing.assert_allclose(uniform.mean(axis=2), 0, atol=4 / np.sqrt(3 * 2000))
        np.testing.assert_allclose((uniform**2).mean(axis=2), 1 / 3, atol=4 * 0.3 / np.sqrt(2000))


def test_bad_input_is_refused_by_name(model):
    for boxes, named in (
        (TRACK[:, :1], "boxes: shape"),
        (TRACK * np.array([1.0, 1, 0, 1]), "boxes: one"),
        (TRACK * np.nan, "boxes: one"),
    ):
        with pytest.raises(ValueError, match=named):
            labelled_states(model, boxes)
    states = labelled_states(model, TRACK)
    for options in ({"num_boxes": 0}, {"reach": 0.0}, {"stretch": 0.9}):
        with pytest.raises(ValueError, match=next(iter(options))):
            boxes_around(jax.random.key(0), model, states, **{"num_boxes": 2} | options)
