"""Several objects known by their colours: the likelihood and its pieces."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mpfjax.vision.boxes.joint_colour import joint_colour_model
from mpfjax.vision.colour import HSVColours

KEY = jax.random.key(0)
BOXES = np.array([[10.0, 10, 12, 20], [50, 20, 16, 24], [30, 40, 10, 12]])
PAINTS = [(220, 20, 20), (20, 20, 220), (20, 200, 40)]


@pytest.fixture(scope="module")
def frame():
    """A red, a blue and a green box with dark legs, on noise."""
    image = np.random.default_rng(0).integers(0, 256, (70, 90, 3), dtype=np.uint8)
    for (x, y, w, h), colour in zip(BOXES.astype(int), PAINTS, strict=True):
        image[y : y + h // 2, x : x + w] = colour
        image[y + h // 2 : y + h, x : x + w] = 5
    return image


@pytest.fixture(scope="module")
def model(frame):
    return joint_colour_model(frame, BOXES)


def states_at(model, *centres):
    """One particle with its objects at these centres, of the size of their templates."""
    states = model.sample_initial(KEY, 1)
    box = jnp.asarray(np.array([[[x, y, 1, 1] for x, y in centres]], np.float32))
    return eqx.tree_at(lambda s: (s.box, s.previous), states, (box, box))


def centres(boxes=BOXES):
    return boxes[:, :2] + boxes[:, 2:] / 2


@pytest.mark.exactness
def test_the_likelihood_is_the_papers_formula(frame):
    """Σ_j -λ Σ_halves (1 - Σ_b sqrt(h r)), from numpy's histograms of the bins."""
    shifts, bins = np.array([[4, 0], [0, -6], [-3, 4]]), np.asarray(HSVColours().bins(frame))

    def histogram(left, top, w, h):
        counts = np.bincount(bins[top : top + h, left : left + w].ravel(), minlength=110)
        return counts / counts.sum()

    total = 0.0
    for (x, y, w, h), (dx, dy) in zip(BOXES.astype(int), shifts, strict=True):
        for top in (y, y + h // 2):
            now, template = histogram(x + dx, top + dy, w, h // 2), histogram(x, top, w, h // 2)
            total += 1 - np.sqrt(now * template).sum()
    assert 1 < total < 5
    for lambda_ in (7.0, 21.0):
        model = joint_colour_model(frame, BOXES, lambda_=lambda_)
        states = states_at(model, *(centres() + shifts))
        value = eqx.filter_jit(model.log_likelihood)(jnp.asarray(frame), states)
        np.testing.assert_allclose(value, [-lambda_ * total], rtol=1e-4)


@pytest.mark.exactness
def test_dynamics_are_the_papers(model):
    """x_t = x_{t-1} + 0.5 (x_{t-1} - x_{t-2}) + σ ω_t, of each object on its own."""
    states = model.sample_initial(KEY, 4000)
    states = eqx.tree_at(lambda s: s.box, states, states.box + 4.0)
    moved = model.sample_transition(jax.random.key(1), states)
    np.testing.assert_array_equal(moved.previous, states.box)
    noise = np.asarray(moved.box - states.box - 0.5 * (states.box - states.previous))
    deviations = np.array([2, 2, 0.001, 0.001])
    np.testing.assert_allclose(noise.mean(axis=0) / deviations[None], 0, atol=4 / 4000**0.5)
    np.testing.assert_allclose(noise.std(axis=0) / deviations[None], 1, atol=4 / 8000**0.5)


@pytest.mark.exactness
def test_a_template_from_elsewhere(frame):
    """Object 0 starts in the red box and is known by the looks of the blue one."""
    learned = joint_colour_model(frame, BOXES, templates={0: (frame, BOXES[1])})
    own = learned.object_at(0)
    here, there = (
        learned.object_states(states_at(learned, *places), jnp.asarray(0, jnp.int32))
        for places in (centres(), centres()[[1, 1, 2]])
    )
    assert -2 * own.sigma**2 * own.log_likelihood(jnp.asarray(frame), here)[0] > 0.3
    assert -2 * own.sigma**2 * own.log_likelihood(jnp.asarray(frame), there)[0] < 0.05
    drawn = learned.sample_initial(KEY, 100).box[:, 0, :2].mean(axis=0)
    np.testing.assert_allclose(drawn, centres()[0], atol=1)
