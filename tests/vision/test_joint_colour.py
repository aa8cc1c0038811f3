"""Several objects known by their colours: the likelihood, its pieces, and scenes gone wrong."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax.vision.boxes.colour_model import ColourModel
from mpfjax.vision.boxes.joint_colour import joint_colour_model, object_boxes
from mpfjax.vision.colour.bins import HSVColours, RGBColours

KEY = jax.random.key(0)
COLOURS = HSVColours(4, 2, 2)
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


@pytest.mark.thorough
def test_lambda_and_sigma_are_one_parameter(frame, model):
    """With one band λ = 1 / 2σ²: the object's model is the plain colour model."""
    sigma = 0.2
    joint = joint_colour_model(
        frame, BOXES, lambda_=1 / (2 * sigma**2), num_parts=1, colours=COLOURS
    )
    single = ColourModel.from_frame(frame, BOXES[1:2], colours=COLOURS, sigma=sigma)
    states = jax.tree.map(lambda leaf: leaf[:, 1], joint.sample_initial(KEY, 20))
    plain = type(states)(states.box, states.reference)
    observation = jnp.asarray(frame)
    np.testing.assert_allclose(
        joint.object_at(1).log_likelihood(observation, states),
        single.log_likelihood(observation, plain),
        rtol=1e-4,
    )


def test_each_object_is_most_likely_at_its_own_place(frame, model):
    observation = model.prepare_observation(jnp.asarray(frame))
    for j in range(3):
        states = states_at(model, *np.roll(centres(), j, axis=0))
        values = [
            model.object_log_likelihood(observation, model.object_states(states, i), i)[0]
            for i in jnp.arange(3, dtype=jnp.int32)
        ]
        assert (np.array(values) > -1e-3).all() if j == 0 else (np.array(values) < -10).all()


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


def test_boxes_are_where_the_states_say(model):
    boxes = object_boxes(model, states_at(model, *(centres() + 2)))
    np.testing.assert_allclose(boxes[0], BOXES + np.array([2, 2, 0, 0]), rtol=1e-6)


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


@pytest.fixture(scope="module")
def run_all():
    def run(model, frame, num_particles=14):
        """The final mixtures of the filters of this module after two equal frames."""
        observations = jnp.stack([jnp.asarray(frame)] * 2)
        for make in (mpfjax.partitioned_sampling, mpfjax.distributed_partitioned_sampling):
            run = mpfjax.run_filter(KEY, make(model, num_particles), observations)
            yield run

    return run


def assert_defined(run):
    assert not np.isnan(run.log_marginal_likelihood)
    assert np.isfinite(run.final.particles.box).all()
    np.testing.assert_allclose(run.final.weights.sum(), 1, rtol=1e-4)


class TestScenesGoneWrong:
    @pytest.mark.thorough
    def test_two_objects_on_the_same_spot_with_the_same_looks(self, frame, run_all):
        model = joint_colour_model(frame, BOXES[[1, 1, 2]], colours=COLOURS)
        for run in run_all(model, frame):
            assert_defined(run)
            means = object_boxes(model, run.final.particles)[:, :, :2].mean(axis=0)
            np.testing.assert_allclose(means, BOXES[[1, 1, 2], :2], atol=4)

    @pytest.mark.thorough
    def test_an_object_that_has_left_the_frame(self, frame, model, run_all):
        """It lies at the largest distance everywhere, and drifts; the others are tracked on."""
        start = model.object_model.reference_boxes.at[0, 0, 0].set(-200.0)
        gone = eqx.tree_at(lambda m: m.object_model.reference_boxes, model, start)
        for run in run_all(gone, frame):
            assert_defined(run)
            boxes = object_boxes(gone, run.final.particles)
            assert (boxes[:, 0, 0] < -100).all()
            np.testing.assert_allclose(boxes[:, 1, :2].mean(axis=0), BOXES[1, :2], atol=4)

    def test_an_empty_histogram_lies_farthest_from_all(self, frame, model):
        """A box that holds no pixel's centre: d² is that of nothing in common in each band."""
        states = states_at(model, *centres())
        tiny = eqx.tree_at(lambda s: s.box, states, states.box.at[:, :, 2:].set(1e-4))
        value = model.log_likelihood(jnp.asarray(frame), tiny)
        np.testing.assert_allclose(value, [-20.0 * 3 * 2], rtol=1e-5)

    @pytest.mark.thorough
    def test_one_object(self, frame):
        """PS of one object is the particle filter on it bit for bit, and DPS has one component."""
        model = joint_colour_model(frame, BOXES[:1], colours=COLOURS)
        observations = jnp.stack([jnp.asarray(frame)] * 2)
        runs = [
            mpfjax.run_filter(KEY, make(model, 14), observations)
            for make in (mpfjax.particle_filter, mpfjax.partitioned_sampling)
        ]
        np.testing.assert_array_equal(runs[0].final.particles.box, runs[1].final.particles.box)
        assert mpfjax.distributed_partitioned_sampling(model, 14).num_components == 1

    def test_more_components_than_particles(self, model):
        with pytest.raises(ValueError, match=r"num_particles.*2.*|num_components.*3"):
            mpfjax.distributed_partitioned_sampling(model, 2)

    def test_an_order_that_is_no_permutation(self, model):
        for order in ((0, 1, 1), (0, 1), (1, 2, 3)):
            with pytest.raises(ValueError, match=r"order: .* is no permutation of the objects"):
                mpfjax.partitioned_sampling(model, 10, order)


@pytest.mark.usefixtures("as_installed")
@pytest.mark.parametrize(
    ("message", "boxes", "options"),
    [
        ("boxes: there are none", np.zeros((0, 4)), {}),
        ("boxes: 1,1,0,5 has no area", [[1, 1, 0, 5]], {}),
        ("boxes: .* outside the first frame", [[500, 1, 5, 5]], {}),
        ("lambda_: 0", BOXES, {"lambda_": 0.0}),
        ("lambda_: nan", BOXES, {"lambda_": float("nan")}),
        ("num_parts: 0", BOXES, {"num_parts": 0}),
        ("deviations", BOXES, {"deviations": (0.0, 1, 1, 1)}),
        ("templates: 3 is none of the 3 objects", BOXES, {"templates": {3: None}}),
    ],
)
def test_bad_input_is_named(frame, message, boxes, options):
    if "templates" in options:
        options = {"templates": dict.fromkeys(options["templates"], (frame, BOXES[0]))}
    with pytest.raises(ValueError, match=message):
        joint_colour_model(frame, np.array(boxes), **options)
