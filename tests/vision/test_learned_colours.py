"""Colours that are learned on the way: by hand, and in a scene where an object hides."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mpfjax import Step
from mpfjax.mixture import single_component
from mpfjax.vision import RGBColours
from mpfjax.vision.boxes.colour_model import BoxState
from mpfjax.vision.boxes.hypotheses import AdaptAppearance, LearnedColourModel

RNG = np.random.default_rng(0)
FIRST, NOW = (RNG.integers(0, 256, (40, 50, 3), dtype=np.uint8) for _ in range(2))
BOXES = np.array([[5.0, 5, 10, 20], [20, 10, 10, 15]])
BINS = 4


def colour_model():
    return LearnedColourModel.from_frame(FIRST, BOXES, colours=RGBColours(BINS), sigma=0.5)


def states_of(model, xs=(10.0, 12.0, 25.0), references=(0, 0, 1)):
    box = jnp.asarray([[x, 16.0, 1.0, 1.0] for x in xs], jnp.float32)
    reference = jnp.asarray(references, jnp.int32)
    return BoxState(box, reference, None, model.references[reference])


def counted(frame, x, y, w, h):
    """Histograms (channels, bins) of a box about (x, y), pixel by pixel."""
    rows, columns = slice(int(y - h / 2), int(y + h / 2)), slice(int(x - w / 2), int(x + w / 2))
    pixels = frame[rows, columns].reshape(-1, 3) // (256 // BINS)
    counts = np.stack([np.bincount(pixels[:, c], minlength=BINS) for c in range(3)])
    return counts / counts.sum(axis=1, keepdims=True)


def squared(first, second):
    return np.sum(1 - np.sum(np.sqrt(first * second), axis=1))


def by_hand(rate):
    """log L and the new appearance of the first particle, which stands where box 0 was."""
    first, now = counted(FIRST, 10, 15, 10, 20), counted(NOW, 10, 16, 10, 20)
    # Its appearance is already that of the other box.
    appearance = counted(FIRST, 25, 17.5, 10, 15)
    distance = 0.2 * squared(first, now) + 0.8 * squared(appearance, now)
    seen, unseen = np.exp(-0.5 * distance / 0.25), np.exp(-0.5 * 0.6 / 0.25)
    share = rate * seen / (seen + unseen)
    return np.log(seen + unseen), appearance + share * (now - appearance)


@pytest.mark.exactness
@pytest.mark.parametrize("rate", [0.5, 1.0])
def test_the_likelihood_and_what_is_learned_by_hand(rate):
    model = colour_model()
    states = states_of(model)
    appearance = states.appearance.at[0].set(model.references[1])
    states = BoxState(states.box, states.reference, None, appearance)
    log_likelihood, learned = by_hand(rate)
    frame = jnp.asarray(NOW)
    np.testing.assert_allclose(model.log_likelihood(frame, states)[0], log_likelihood, atol=1e-4)
    mixture = single_component(states)
    moved = AdaptAppearance(rate)(jax.random.key(0), mixture, Step(model, frame))
    np.testing.assert_allclose(moved.particles.appearance[0, 0], learned, atol=1e-4)
    np.testing.assert_array_equal(moved.log_weights, mixture.log_weights)
    np.testing.assert_array_equal(moved.particles.box, states.box)


def test_outside_the_frame_nothing_is_learned_and_the_object_is_hidden():
    model = colour_model()
    states, frame = states_of(model, xs=(-500.0, np.nan, 10.0)), jnp.asarray(NOW)
    learned = model.learn(frame, states, 1.0)
    np.testing.assert_array_equal(learned.appearance[:2], states.appearance[:2])
    assert not np.allclose(learned.appearance[2], states.appearance[2])
    # Without a colour the distance is the largest, 3.
    hidden = np.logaddexp(-0.5 * 0.6 / 0.5**2, -0.5 * 3 / 0.5**2)
    assert model.log_likelihood(frame, states)[0] == pytest.approx(hidden, abs=0.01)
