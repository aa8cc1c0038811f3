"""The colour model of section 5.2, against its formulas."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mpfjax import RandomWalk, WalkWithVelocity, check_model
from mpfjax.vision.boxes.colour_model import BoxState, ColourModel
from mpfjax.vision.boxes.recipes import with_one_reference
from mpfjax.vision.colour import RGBColours

BOXES = np.array([[10.0, 10, 12, 20], [50, 20, 16, 24]])
DEVIATIONS = np.array([2.0, 1.0, 0.1, 0.05])


@pytest.fixture(scope="module")
def frame():
    """A red box and a blue box, each with dark legs, on noisy grey."""
    image = np.random.default_rng(0).integers(90, 160, (70, 90, 3), dtype=np.uint8)
    for (x, y, w, h), colour in zip(BOXES.astype(int), [(220, 20, 20), (20, 20, 220)], strict=True):
        image[y : y + h // 2, x : x + w] = colour
        image[y + h // 2 : y + h, x : x + w] = 5
    return image


# As one program: one operation after the other compiles longer.
log_likelihood = eqx.filter_jit(ColourModel.log_likelihood)


def squared_distances(model, observation, states):
    return -2 * model.sigma**2 * log_likelihood(model, observation, states)


def model_of(frame, **options):
    return ColourModel.from_frame(frame, BOXES, **{"deviations": DEVIATIONS} | options)


def states(*rows):
    """(x, y, s_x, s_y, reference) a row."""
    rows = np.array(rows, np.float32)
    return BoxState(jnp.asarray(rows[:, :4]), jnp.asarray(rows[:, 4].astype(np.int32)))


def at_references(model):
    return states(*[(x + w / 2, y + h / 2, 1, 1, r) for r, (x, y, w, h) in enumerate(BOXES)])


def test_the_likelihood_is_the_papers_formula(frame):
    model = model_of(frame, colours=RGBColours(8), sigma=0.2)
    state = states((30.0, 30.0, 1.5, 0.75, 1))

    def histogram(x, y, w, h):
        patch = frame[int(y) : int(y + h), int(x) : int(x + w)].reshape(-1, 3)
        counts = np.stack([np.histogram(patch[:, c], np.arange(9) * 32)[0] for c in range(3)])
        return counts / counts.sum(axis=1, keepdims=True)

    here, reference = histogram(30 - 12, 30 - 9, 24, 18), histogram(*BOXES[1])
    squares = 1 - np.sqrt(here * reference).sum(axis=1)
    expected = -squares.sum() / (2 * 0.2**2)
    assert 0.5 < squares.sum() < 2.5
    np.testing.assert_allclose(
        float(log_likelihood(model, jnp.asarray(frame), state)[0]), expected, rtol=1e-4
    )


@pytest.mark.parametrize("options", [{}, {"num_parts": 3}, {"num_parts": 3, "weigh_colours": True}])
def test_the_reference_itself_is_most_likely(frame, options):
    model, observation = model_of(frame, **options), jnp.asarray(frame)
    true = at_references(model)
    np.testing.assert_allclose(
        np.asarray(squared_distances(model, observation, true)), 0.0, atol=1e-5
    )
    shifted = BoxState(true.box + jnp.array([[6.0, 5.0, 0.0, 0.0]]), true.reference)
    swapped = BoxState(true.box, true.reference[::-1])
    assert (squared_distances(model, observation, shifted) > 0.05).all()
    assert (squared_distances(model, observation, swapped) > 0.5).all()


def test_bands_tell_a_box_from_its_mirror_image(frame):
    """Trousers above a shirt: the same colours in all, but not in each band."""
    upside_down = jnp.asarray(frame.copy())
    x, y, w, h = BOXES[0].astype(int)
    upside_down = upside_down.at[y : y + h, x : x + w].set(frame[y : y + h, x : x + w][::-1])
    whole, bands = model_of(frame), model_of(frame, num_parts=2)
    true = at_references(whole)
    assert squared_distances(whole, upside_down, true)[0] < 1e-5
    assert squared_distances(bands, upside_down, true)[0] > 1


def test_x0_scatters_equally_about_all_references(frame):
    model = model_of(frame)
    start = model.sample_initial(jax.random.key(0), 4001)
    counts = np.bincount(np.asarray(start.reference))
    assert abs(counts[0] - counts[1]) <= 1
    for r, (x, y, w, h) in enumerate(BOXES):
        boxes = np.asarray(start.box)[np.asarray(start.reference) == r]
        error = DEVIATIONS / np.sqrt(len(boxes))
        assert (np.abs(boxes.mean(axis=0) - [x + w / 2, y + h / 2, 1, 1]) < 5 * error).all()
        np.testing.assert_allclose(boxes.std(axis=0), DEVIATIONS, rtol=0.1)


VELOCITY = WalkWithVelocity(RandomWalk(jnp.asarray(DEVIATIONS)), 0.5, jnp.asarray([3.0, 1, 0, 0]))


@pytest.mark.exactness
@pytest.mark.parametrize(("switch", "dynamics"), [(0.0, None), (0.3, None), (0.0, VELOCITY)])
def test_the_transition_draws_from_its_own_density(frame, switch, dynamics):
    model = dataclasses.replace(model_of(frame, dynamics=dynamics), switch_probability=switch)
    check_model(jax.random.key(0), model, jnp.asarray(frame))


@pytest.mark.exactness
def test_dynamics_with_a_velocity_carry_it_along(frame):
    model = model_of(frame, dynamics=VELOCITY)
    start = model.sample_initial(jax.random.key(0), 4000)
    velocity = np.asarray(start.box - start.previous)
    np.testing.assert_allclose(velocity.std(axis=0), [3, 1, 0, 0], rtol=0.06, atol=1e-6)
    after = model.sample_transition(jax.random.key(1), start)
    # Adopted by parents one pixel to the right, which have the same past.
    parents = BoxState(start.box + jnp.array([[1.0, 0, 0, 0]]), start.reference, start.previous)
    adopted = model.with_history(after, parents)
    learned = 0.5 * (parents.box - parents.previous) + 0.5 * (after.box - parents.box)
    np.testing.assert_allclose(adopted.box - adopted.previous, learned, atol=1e-3)


def test_a_shared_reference_is_the_mean_of_all(frame):
    own = model_of(frame)
    shared = with_one_reference(own)
    mean = np.asarray(own.references).mean(axis=0)
    np.testing.assert_allclose(np.asarray(shared.references), np.stack([mean, mean]), atol=1e-6)
    np.testing.assert_allclose(np.asarray(shared.reference_boxes[:, 2:]), [[14, 22], [14, 22]])
