"""Several objects known by their colours: the likelihood and its pieces."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax.vision.boxes.joint_colour import joint_colour_model
from mpfjax.vision.colour.bins import HSVColours, RGBColours

KEY = jax.random.key(0)
COLOURS = HSVColours(num_hues=4, num_saturations=2, num_values=2)
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
    return joint_colour_model(frame, BOXES, colours=COLOURS)


def states_at(model, *centres):
    """One particle with its objects at these centres, of the size of their templates."""
    states = model.sample_initial(KEY, 1)
    box = jnp.asarray(np.array([[[x, y, 1, 1] for x, y in centres]], np.float32))
    return eqx.tree_at(lambda s: (s.box, s.previous), states, (box, box))


def centres(boxes=BOXES):
    return boxes[:, :2] + boxes[:, 2:] / 2


@pytest.mark.exactness
def test_the_likelihood_is_the_papers_formula(frame):
    """Σ_j -λ Σ_parts (1 - Σ_b sqrt(h r)), from numpy's histograms of red, green and blue."""
    model = joint_colour_model(frame, BOXES, lambda_=7.0, colours=RGBColours(8), num_parts=2)
    shifts = np.array([[4, 0], [0, -6], [-3, 4]])
    total = 0.0
    for (x, y, w, h), (dx, dy) in zip(BOXES.astype(int), shifts, strict=True):
        for part in range(2):
            halves = []
            for left, top in ((x, y), (x + dx, y + dy)):
                rows = slice(top + part * h // 2, top + (part + 1) * h // 2)
                patch = frame[rows, left : left + w].reshape(-1, 3)
                counts = [np.histogram(patch[:, c], np.arange(9) * 32)[0] for c in range(3)]
                halves.append(np.array(counts) / len(patch))
            total += (1 - np.sqrt(halves[0] * halves[1]).sum(axis=1)).sum()
    assert 1 < total < 15
    states = states_at(model, *(centres() + shifts))
    value = eqx.filter_jit(model.log_likelihood)(jnp.asarray(frame), states)
    np.testing.assert_allclose(value, [-7.0 * total], rtol=1e-4)
    three = joint_colour_model(frame, BOXES, lambda_=21.0, colours=RGBColours(8), num_parts=2)
    other = eqx.filter_jit(three.log_likelihood)(jnp.asarray(frame), states)
    np.testing.assert_allclose(other, 3 * value, rtol=1e-5)


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
    learned = joint_colour_model(frame, BOXES, colours=COLOURS, templates={0: (frame, BOXES[1])})
    own = learned.object_at(0)
    here, there = (
        learned.object_states(states_at(learned, *places), jnp.asarray(0, jnp.int32))
        for places in (centres(), centres()[[1, 1, 2]])
    )
    assert -2 * own.sigma**2 * own.log_likelihood(jnp.asarray(frame), here)[0] > 0.3
    assert -2 * own.sigma**2 * own.log_likelihood(jnp.asarray(frame), there)[0] < 0.05
    drawn = learned.sample_initial(KEY, 100).box[:, 0, :2].mean(axis=0)
    np.testing.assert_allclose(drawn, centres()[0], atol=1)


def test_another_lambda_and_order_are_the_same_program(frame):
    """They differ in the values of arrays alone, on which no compilation depends."""
    one, other = (
        mpfjax.partitioned_sampling(joint_colour_model(frame, BOXES, lambda_=lambda_), 12, order)
        for lambda_, order in ((10.0, (0, 1, 2)), (40.0, (2, 0, 1)))
    )
    arrays, rest = zip(
        *(eqx.partition(filter, eqx.is_array) for filter in (one, other)), strict=True
    )
    assert eqx.tree_equal(*rest)
    assert not eqx.tree_equal(*arrays)
    assert eqx.tree_equal(*(jax.eval_shape(lambda tree=tree: tree) for tree in arrays))
