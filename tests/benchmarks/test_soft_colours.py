"""Soft histograms against hard ones, and their derivatives against differences."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

import mpfjax
from benchmarks.likelihood_tuning.soft_colours import SoftColourModel, soft_histograms
from mpfjax.vision.boxes.colour_model import BoxState, ColourModel
from mpfjax.vision.colour.bins import RGBColours
from mpfjax.vision.colour.histograms import integral_histogram
from tests.precision import float64

HEIGHT, WIDTH = 40, 60
BOXES = np.array([[10.0, 8, 12, 16], [35, 12, 12, 20]])
SHARP = jnp.array(1e-3)


@pytest.fixture(scope="module")
def frame():
    """Two boxes, red over dark and blue over dark, on smooth grey."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    grey = 110 + 30 * np.sin(0.2 * rows) * np.cos(0.13 * columns)
    image = np.repeat(grey[:, :, None], 3, axis=2).astype(np.uint8)
    for (x, y, w, h), colour in zip(BOXES.astype(int), [(220, 20, 20), (20, 20, 220)], strict=True):
        image[y : y + h // 2, x : x + w] = colour
        image[y + h // 2 : y + h, x : x + w] = 5
    return image


def states(*rows):
    rows = np.array(rows, np.float32)
    return BoxState(jnp.asarray(rows[:, :4]), jnp.asarray(rows[:, 4].astype(np.int32)))


@pytest.mark.parametrize(("num_bins", "num_parts"), [(16, 1), (30, 4)])
def test_the_limit_is_the_hard_histogram(num_bins, num_parts):
    """With a point on every pixel, on noise, where no blur would go unseen."""
    noise = jnp.asarray(np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8))
    boxes = jnp.array([[20.0, 20, 12, 12], [31, 15, 12, 12], [54, 34, 12, 12]])
    hard = integral_histogram(noise, RGBColours(num_bins)).counts(boxes, num_parts)
    soft = soft_histograms(noise, boxes, num_bins, SHARP, 12, num_parts)
    np.testing.assert_allclose(soft * 144 / num_parts, hard, atol=1e-3)


@pytest.mark.parametrize("bandwidth", [0.01, 0.5, 3.0])
def test_bins_sum_to_one_within_the_frame_and_to_less_across_its_edge(frame, bandwidth):
    boxes = jnp.array([[30.0, 20, 20, 20], [0.0, 20, 20, 20], [-30, 20, 20, 20], [jnp.nan] * 4])
    sums = soft_histograms(jnp.asarray(frame), boxes, 16, jnp.array(bandwidth)).sum(axis=-1)
    expected = np.repeat([1.0, 0.5, 0.0, 0.0], 3).reshape(4, 1, 3)
    np.testing.assert_allclose(sums, expected, atol=1e-5)


def test_a_shade_is_spread_as_a_triangle_of_its_bandwidth():
    """Against the integral of the kernel over each bin, by sums."""
    value, bandwidth = 100.0, 1.3
    frame = jnp.full((4, 4, 3), value)
    found = soft_histograms(frame, jnp.array([[2.0, 2, 2, 2]]), 8, jnp.array(bandwidth), 2)
    places = np.linspace(-4, 12, 160_001)
    centre = (value * 8 + 4) / 256
    kernel = np.maximum(0, 1 - np.abs(places - centre) / bandwidth)
    mass = np.histogram(np.clip(places, 0, 7.999), np.arange(9), weights=kernel)[0]
    np.testing.assert_allclose(found[0, 0, 0], mass / mass.sum(), atol=1e-4)


def test_derivatives_in_box_image_and_bandwidth_are_those_of_differences(frame):
    image = jnp.asarray(frame, float)
    weights = jax.random.normal(jax.random.key(0), (1, 2, 3, 8))

    @jax.jit
    def readout(boxes, image, bandwidth):
        return jnp.sum(weights * soft_histograms(image, boxes, 8, bandwidth, 4, 2))

    with float64(), jax.numpy_dtype_promotion("standard"):
        arguments = (jnp.array([[20.23, 17.31, 14.1, 18.3]]), image, jnp.array(0.83))
        arguments = tuple(argument.astype(float) for argument in arguments)
        check_grads(readout, arguments, order=1, modes=["rev"], eps=1e-5, rtol=1e-3)


def test_the_models_derivatives_are_those_of_differences(frame):
    model = SoftColourModel.from_frame(frame, BOXES, num_bins=8, num_points=4, num_parts=2)
    state = states((17.3, 16.6, 1.1, 0.9, 0), (39.1, 21.2, 0.9, 1.0, 1))

    @jax.jit
    def total(logits, lambda_, bandwidth, box):
        changed = eqx.tree_at(
            lambda m: (m.reference_logits, m.lambda_, m.bandwidth),
            model,
            (logits, lambda_, bandwidth),
        )
        moved = BoxState(box, state.reference)
        return jnp.sum(changed.log_likelihood(jnp.asarray(frame), moved))

    with float64(), jax.numpy_dtype_promotion("standard"):
        model = jax.tree.map(lambda leaf: leaf.astype(float), model)
        arguments = (
            model.reference_logits + 0.3 * jax.random.normal(jax.random.key(1), (2, 2, 3, 8)),
            model.lambda_,
            model.bandwidth,
            state.box.astype(float),
        )
        check_grads(total, arguments, order=1, modes=["rev"], eps=1e-6, rtol=1e-3)


class TestModel:
    def test_its_distances_are_near_those_of_the_hard_model(self, frame):
        options = {"sigma": 0.2, "num_parts": 2}
        hard = ColourModel.from_frame(frame, BOXES, colours=RGBColours(16), **options)
        soft = SoftColourModel.from_frame(
            frame, BOXES, bandwidth=1e-2, num_points=24, floor=1e-4, **options
        )
        rows = [(16 + dx, 16, 1, 1, 0) for dx in (0.0, 3.0, 6.0, 12.0)] + [(41, 22, 1, 1, 0)]
        found, expected = (
            eqx.filter_jit(model.log_likelihood)(jnp.asarray(frame), states(*rows))
            for model in (soft, hard)
        )
        np.testing.assert_allclose(found, expected, atol=0.03 * float(-expected.min()))

    def test_distances_are_bounded(self, frame):
        model = SoftColourModel.from_frame(frame, BOXES)
        rng = np.random.default_rng(0)
        box = rng.uniform((-40, -40, -1, -1), (100, 80, 4, 4), (200, 4))
        state = states(*np.concatenate([box, rng.integers(0, 2, (200, 1))], axis=1))
        squared_distances = eqx.filter_jit(model.squared_distances)
        distances = squared_distances(jnp.asarray(frame), state)
        assert (distances >= 0).all()
        assert (distances <= 3).all()
        outside = states((-500.0, 10, 1, 1, 0), (np.nan, 10, 1, 1, 1))
        np.testing.assert_array_equal(squared_distances(jnp.asarray(frame), outside), [3.0, 3.0])

    def test_outside_the_frame_derivatives_are_finite(self, frame):
        model = SoftColourModel.from_frame(frame, BOXES)

        @jax.jit
        def total(model, box):
            state = BoxState(box, jnp.zeros(2, jnp.int32))
            return jnp.sum(model.log_likelihood(jnp.asarray(frame), state))

        box = jnp.array([[-500.0, 10, 1, 1], [16, 16, 1, 1]])
        for gradient in (jax.grad(total)(model, box), jax.grad(total, argnums=1)(model, box)):
            assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))

    def test_it_moves_as_the_hard_model_does(self, frame):
        options = {"dynamics": mpfjax.Autoregression.with_momentum(0.5, jnp.ones(4))}
        hard = ColourModel.from_frame(frame, BOXES, **options)
        soft = SoftColourModel.from_frame(frame, BOXES, **options)
        key = jax.random.key(0)
        first = [model.sample_initial(key, 6) for model in (hard, soft)]
        second = [m.sample_transition(key, s) for m, s in zip((hard, soft), first, strict=True)]
        for ours, theirs in zip(
            jax.tree.leaves((first[1], second[1])),
            jax.tree.leaves((first[0], second[0])),
            strict=True,
        ):
            np.testing.assert_array_equal(ours, theirs)

    def test_a_filter_follows_a_box(self, frame):
        model = SoftColourModel.from_frame(
            frame, BOXES[:1], num_points=6, deviations=np.array([2.5, 1.0, 0.02, 0.02])
        )
        frames = jnp.stack([jnp.roll(jnp.asarray(frame), 2 * t, axis=1) for t in range(5)])
        run = mpfjax.run_filter(
            jax.random.key(0),
            mpfjax.particle_filter(model, 100),
            frames,
            lambda mixture: mixture.component_averages(mixture.particles.box)[0],
        )
        np.testing.assert_allclose(run.collected[-1, 0], 16 + 8, atol=2.0)


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"bandwidth": 0.0}, "bandwidth: 0.0"),
        ({"floor": 0.0}, "floor: 0.0"),
        ({"floor": 1.0}, "floor: 1.0"),
        ({"num_points": 0}, "num_points: 0"),
        ({"num_points": 5, "num_parts": 2}, "num_points: 5"),
        ({"num_parts": 0}, "num_parts: 0"),
        ({"num_bins": 300}, "num_bins: 300"),
        ({"sigma": -1.0}, "sigma: -1.0"),
    ],
)
def test_bad_input_is_refused_by_name(frame, options, named):
    with pytest.raises(ValueError, match=named):
        SoftColourModel.from_frame(frame, BOXES, **options)


def test_a_grey_frame_is_refused(as_installed):
    with pytest.raises(ValueError, match="frame: "):
        soft_histograms(jnp.zeros((4, 4)), jnp.ones((1, 4)), 8, SHARP)
