"""Colour and detections together, against SciPy's densities and a sum over a grid."""

from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal

from mpfjax import Autoregression, Propagate
from mpfjax.mixture import single_component
from mpfjax.vision import (
    BoxState,
    ColourModel,
    DetectedColourModel,
    DetectedFrame,
    DetectionProposal,
    Detections,
    HSVColours,
    integral_histogram,
)

HEIGHT, WIDTH = 40, 50
BOXES = np.array([[10.0, 8, 8, 16], [30, 12, 10, 20]])
STEPS = np.array([1.5, 1.0, 0.1, 0.08])
DEVIATIONS = np.array([0.2, 0.1, 0.25, 0.15])
# Detections near both boxes, as corner and size.
FOUND = np.array([[11.0, 8, 7, 18], [29, 13, 11, 18]])


def a_frame():
    """A red box and a blue box on noisy grey."""
    image = np.random.default_rng(0).integers(90, 160, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    for (x, y, w, h), colour in zip(BOXES.astype(int), [(220, 20, 20), (20, 20, 220)], strict=True):
        image[y : y + h, x : x + w] = colour
    return image


FRAME = a_frame()


DYNAMICS = {
    "random walk": None,
    "autoregression": Autoregression(
        jnp.diag(jnp.array([1.6, 1.5, 1.0, 0.9])),
        jnp.diag(jnp.array([-0.6, -0.5, 0.0, 0.0])),
        # Noise that is not independent, which the proposal takes for independent.
        jnp.diag(jnp.asarray(STEPS, jnp.float32)).at[1, 0].set(0.5),
        jnp.array([25.0, 20, 1, 1]),
    ),
}


@cache
def model_of(dynamics="random walk", switch_probability=0.0):
    colour = ColourModel.from_frame(
        FRAME,
        BOXES,
        colours=HSVColours(4, 2, 2),
        sigma=0.3,
        deviations=STEPS,
        dynamics=DYNAMICS[dynamics],
        switch_probability=switch_probability,
    )
    return DetectedColourModel(colour, jnp.asarray(DEVIATIONS, jnp.float32))


def observation_of(boxes=FOUND, valid=(True, True)):
    centres = np.concatenate([boxes[:, :2] + boxes[:, 2:] / 2, boxes[:, 2:]], axis=1)
    found = Detections(jnp.asarray(centres, jnp.float32), jnp.array(valid), jnp.ones(len(valid)))
    return DetectedFrame(integral_histogram(jnp.asarray(FRAME), HSVColours(4, 2, 2)), found)


def states_of(model, rows, references):
    """Boxes, with a box before them that lay one pixel to the left where dynamics ask for it."""
    box = jnp.asarray(np.asarray(rows, np.float32))
    previous = box - jnp.array([[1.0, 0, 0, 0]]) if model.colour.dynamics.order == 2 else None
    return BoxState(box, jnp.asarray(references, jnp.int32), previous)


def some_states(model, num, seed=0):
    rng = np.random.default_rng(seed)
    references = np.arange(num) % 2
    centres = (BOXES[:, :2] + BOXES[:, 2:] / 2)[references]
    box = np.concatenate([centres, np.ones((num, 2))], axis=1) + STEPS * rng.normal(size=(num, 4))
    return states_of(model, box, references)


def in_pixels(states):
    box = np.asarray(states.box, float)
    size = BOXES[np.asarray(states.reference), 2:]
    return np.concatenate([box[:, :2], box[:, 2:] * size], axis=1)


# Compiled once for each kind of model: operation by operation they take far longer.
log_likelihood = eqx.filter_jit(lambda model, seen, states: model.log_likelihood(seen, states))
log_transition = eqx.filter_jit(lambda model, *states: model.log_transition(*states))
propose = eqx.filter_jit(lambda proposal, *arguments: proposal.propose(*arguments))
propagate = eqx.filter_jit(lambda move, *arguments: move(*arguments))


# --- the likelihood ---------------------------------------------------------------------------


def test_the_likelihood_is_colour_times_a_gaussian_over_a_floor():
    model = model_of()
    states = some_states(model, 12)
    observation = observation_of()
    boxes, own = in_pixels(states), np.asarray(observation.detections.boxes)[np.arange(12) % 2]
    gaps = np.concatenate(
        [(own[:, :2] - boxes[:, :2]) / boxes[:, 2:], np.log(own[:, 2:] / boxes[:, 2:])], axis=1
    )
    gaussian = multivariate_normal(np.zeros(4), np.diag(DEVIATIONS**2))
    nearness = gaussian.pdf(gaps) / gaussian.pdf(np.zeros(4))
    assert nearness.max() > 0.1
    colour = np.asarray(log_likelihood(model.colour, observation.frame, states))
    np.testing.assert_allclose(
        np.asarray(log_likelihood(model, observation, states)),
        colour + np.log(0.02 + nearness),
        rtol=1e-3,
        atol=1e-4,
    )


def test_without_a_detection_colour_alone_speaks():
    model = model_of()
    states = some_states(model, 12)
    found = log_likelihood(model, observation_of(valid=(True, False)), states)
    colour = log_likelihood(model.colour, observation_of().frame, states)
    beside = np.asarray(found - colour)
    np.testing.assert_allclose(beside[1::2], np.log(0.02), rtol=1e-5)
    assert (beside[::2] > np.log(0.02) + 0.01).any()


def test_a_frame_is_as_good_as_its_histogram():
    model = model_of()
    states, observation = some_states(model, 12), observation_of()
    plain = DetectedFrame(jnp.asarray(FRAME), observation.detections)
    np.testing.assert_array_equal(
        log_likelihood(model, plain, states), log_likelihood(model, observation, states)
    )


def test_boxes_without_area_and_far_outside_keep_a_finite_likelihood():
    model = model_of()
    rows = [[-500.0, 20, 1, 1], [14, 16, 0, 1], [14, 16, -0.5, -1], [14, 16, 1, 1]]
    states = states_of(model, 3 * rows, [0] * 12)
    found = np.asarray(log_likelihood(model, observation_of(), states))[:4]
    assert np.isfinite(found).all()
    assert found.argmax() == 3


def test_the_motion_is_that_of_the_colour_model():
    model, key = model_of(), jax.random.key(0)
    start = model.sample_initial(key, 8)
    moved = model.sample_transition(key, start)
    np.testing.assert_array_equal(start.box, model.colour.sample_initial(key, 8).box)
    np.testing.assert_array_equal(moved.box, model.colour.sample_transition(key, start).box)
    np.testing.assert_array_equal(
        model.log_transition(moved, start), model.colour.log_transition(moved, start)
    )


# --- the proposal -----------------------------------------------------------------------------


def the_agreement(dynamics, previous, earlier, detection, reference):
    """Mean and covariance of the product of two Gaussians, with matrices: the slow way."""
    if dynamics == "random walk":
        predicted, spread = previous, np.diag(STEPS**2)
    else:
        ar = DYNAMICS[dynamics]
        A1, A2, B, mean = (np.asarray(part, float) for part in (ar.A1, ar.A2, ar.B, ar.mean))
        predicted = mean + A1 @ (previous - mean) + A2 @ (earlier - mean)
        spread = np.diag(np.diag(B @ B.T))
    size = BOXES[reference, 2:]
    seen = np.concatenate([detection[:2], detection[2:] / size])
    noise = np.diag((DEVIATIONS * np.concatenate([detection[2:], seen[2:]])) ** 2)
    covariance = np.linalg.inv(np.linalg.inv(spread) + np.linalg.inv(noise))
    mean = covariance @ (np.linalg.solve(spread, predicted) + np.linalg.solve(noise, seen))
    return mean, covariance, predicted


def the_transition(dynamics, predicted):
    B = np.diag(STEPS) if dynamics == "random walk" else np.asarray(DYNAMICS[dynamics].B, float)
    return multivariate_normal(predicted, B @ B.T)


@pytest.mark.parametrize(
    ("dynamics", "switch_probability"), [("random walk", 0.4), ("autoregression", 0.0)]
)
def test_the_density_of_a_proposal_is_scipys(dynamics, switch_probability):
    model = model_of(dynamics, switch_probability)
    previous = some_states(model, 40)
    observation = observation_of(valid=(True, False))
    proposal = DetectionProposal(model, share=0.7)
    states, log_density = propose(proposal, jax.random.key(1), observation, previous)
    for i in range(40):
        reference = int(previous.reference[i])
        earlier = None if previous.previous is None else np.asarray(previous.previous[i], float)
        box = np.asarray(states.box[i], float)
        mean, covariance, predicted = the_agreement(
            dynamics,
            np.asarray(previous.box[i], float),
            earlier,
            np.asarray(observation.detections.boxes[reference], float),
            reference,
        )
        share = 0.7 if reference == 0 else 0.0
        expected = share * multivariate_normal(mean, covariance).pdf(box)
        expected += (1 - share) * the_transition(dynamics, predicted).pdf(box)
        stays = int(states.reference[i]) == reference
        expected *= (1 - switch_probability if stays else 0) + switch_probability / 2
        np.testing.assert_allclose(float(log_density[i]), np.log(expected), rtol=2e-3, atol=2e-3)


def test_draws_have_the_moments_of_the_mixture():
    dynamics, num = "autoregression", 40_000
    model = model_of(dynamics)
    one = some_states(model, 1)
    previous = jax.tree.map(lambda leaf: jnp.tile(leaf, (num,) + (1,) * (leaf.ndim - 1)), one)
    observation = observation_of()
    proposal = DetectionProposal(model, share=0.7)
    states, _ = propose(proposal, jax.random.key(2), observation, previous)
    box = np.asarray(states.box, float)
    earlier = None if one.previous is None else np.asarray(one.previous[0], float)
    mean, covariance, predicted = the_agreement(
        dynamics,
        np.asarray(one.box[0], float),
        earlier,
        np.asarray(observation.detections.boxes[0], float),
        0,
    )
    transition = the_transition(dynamics, predicted)
    first = 0.7 * mean + 0.3 * transition.mean
    second = 0.7 * (np.diag(covariance) + mean**2)
    second += 0.3 * (np.diag(transition.cov) + transition.mean**2)
    for values, expected in ((box, first), (box**2, second)):
        error = values.std(axis=0) / np.sqrt(num)
        np.testing.assert_array_less(np.abs(values.mean(axis=0) - expected), 4.5 * error)
    np.testing.assert_array_equal(states.previous, previous.box)


@pytest.mark.parametrize(
    ("dynamics", "switch_probability"),
    [("random walk", 0.4), ("autoregression", 0.0)],
)
def test_weights_of_the_proposal_estimate_what_the_bootstraps_do(dynamics, switch_probability):
    """E_q[f L D / q] = E_D[f L], for 1, the coordinates of the box and the reference."""
    model, num = model_of(dynamics, switch_probability), 40_000
    previous = jax.tree.map(
        lambda leaf: jnp.tile(leaf, (num // 4,) + (1,) * (leaf.ndim - 1)), some_states(model, 4)
    )
    observation = observation_of()

    start = single_component(previous)
    means, errors = [], []
    for seed, proposal in enumerate((None, DetectionProposal(model))):
        mixture = propagate(Propagate(model, proposal), jax.random.key(seed), start, observation)
        states, weights = mixture.particles, np.asarray(mixture.weights, float)
        # Within a step the weights may lack a factor, which the mass has.
        weights *= num * np.exp(float(mixture.log_mass)) / weights.sum()
        columns = [np.ones(num), *np.asarray(states.box).T, np.asarray(states.reference)]
        values = np.stack(columns, axis=1) * weights[:, None]
        means.append(values.mean(axis=0))
        errors.append(values.std(axis=0) / np.sqrt(num))
    assert means[0][0] > 0.005
    np.testing.assert_array_less(np.abs(means[0] - means[1]), 4.5 * np.hypot(*errors) + 1e-9)
    # The proposal is worth it: its estimate of the evidence is the sharper one.
    assert errors[1][0] < 0.8 * errors[0][0]


def test_without_a_detection_the_proposal_is_the_dynamics():
    model, key = model_of(), jax.random.key(4)
    previous = some_states(model, 40)
    nothing = observation_of(valid=(False, False))
    states, log_density = propose(DetectionProposal(model), key, nothing, previous)
    moved = model.sample_transition(jax.random.split(key, 3)[0], previous)
    np.testing.assert_allclose(states.box, moved.box, rtol=1e-5)
    expected = log_transition(model, states, previous)
    np.testing.assert_allclose(log_density, expected, rtol=1e-4, atol=1e-4)


# --- detections -------------------------------------------------------------------------------


def test_detections_are_centred_and_padded():
    found = Detections.from_boxes(np.array([[2.0, 3, 4, 6], [10, 20, 6, 8]]), 4)
    np.testing.assert_array_equal(found.valid, [True, True, False, False])
    # The largest comes first; what is no detection is finite and has an area.
    np.testing.assert_array_equal(found.boxes[:2], [[13, 24, 6, 8], [4, 6, 4, 6]])
    assert (found.boxes[2:] > 0).all()


def test_of_too_many_detections_the_largest_are_kept():
    boxes = np.array([[0.0, 0, 2, 2], [0, 0, 5, 5], [0, 0, 3, 3], [1, 1, 3, 3]])
    found = Detections.from_boxes(boxes, 2)
    np.testing.assert_array_equal(found.valid, [True, True])
    np.testing.assert_array_equal(found.boxes, [[2.5, 2.5, 5, 5], [1.5, 1.5, 3, 3]])


def test_there_may_be_no_detections():
    found = Detections.from_boxes(np.zeros((0, 4)), 3)
    assert found.boxes.shape == (3, 4)
    assert not found.valid.any()


def test_a_detection_may_leave_the_frame_in_part_or_as_a_whole():
    """It is kept as it is; where it lies wholly outside, its likelihood is finite all the same."""
    boxes = np.array([[-4.0, 10, 8, 16], [WIDTH + 30, -90, 10, 20]])
    found = Detections.from_boxes(boxes, 2)
    np.testing.assert_array_equal(found.boxes, [[WIDTH + 35, -80, 10, 20], [0, 18, 8, 16]])
    model = model_of()
    start = single_component(some_states(model, 40))
    move = Propagate(model, DetectionProposal(model))
    mixture = propagate(move, jax.random.key(0), start, observation_of(boxes))
    assert np.isfinite(mixture.particles.box).all()
    assert np.isfinite(mixture.log_weights).all()


@pytest.mark.parametrize(
    ("boxes", "room", "said"),
    [
        ([[1.0, 1, 0, 5]], 3, r"boxes: \[1.0, 1.0, 0.0, 5.0\] has no area"),
        ([[1.0, 1, 4, 5], [1, 1, 4, -5]], 3, r"boxes: \[1.0, 1.0, 4.0, -5.0\] has no area"),
        ([[np.nan, 1, 4, 5]], 3, r"boxes: \[nan, 1.0, 4.0, 5.0\] .* not finite"),
        ([[1.0, 1, np.inf, 5]], 3, r"boxes: \[1.0, 1.0, inf, 5.0\] .* not finite"),
        ([[1.0, 1, 4, 5]], 0, "max_detections: 0"),
        ([[1.0] * 8], 3, r"boxes: shape \(1, 8\)"),
        ([1.0] * 4, 3, r"boxes: shape \(4,\)"),
    ],
)
def test_bad_detections_are_named(as_installed, boxes, room, said):
    with pytest.raises(ValueError, match=said):
        Detections.from_boxes(np.array(boxes), room)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda model: DetectedColourModel(model.colour, jnp.array([0.2, 0.1, 0.0, 0.1])), "devia"),
        (lambda model: DetectedColourModel(model.colour, jnp.ones(3)), "deviations: .* not four"),
        (lambda model: DetectedColourModel(model.colour, miss=jnp.array(0.0)), "miss: 0"),
        (lambda model: DetectionProposal(model, share=1.0), "share: 1"),
        (lambda model: DetectionProposal(model, share=-0.1), "share: -0.1"),
    ],
)
def test_misuse_is_named(as_installed, make, said):
    with pytest.raises(ValueError, match=said):
        make(model_of())
