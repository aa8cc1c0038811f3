"""Boxes of so many pixels that counts in 16 bits would not do, against numpy."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from mpfjax.vision import ColourModel, RGBColours
from mpfjax.vision.boxes.colour_model import BoxState
from mpfjax.vision.colour import integral_histogram, normalise
from tests.marking import quick_of

HEIGHT, WIDTH, BINS = 600, 620, 4
COLOURS = RGBColours(BINS)
# By their number of pixels: on both sides of where a box, its sides and its surround reach 2¹⁶.
SIZES = {16_383: (127, 129), 16_384: (128, 128), 32_767: (151, 217), 32_768: (128, 256),
         65_535: (255, 257), 65_536: (256, 256)}  # fmt: skip


@pytest.fixture(scope="module")
def frame():
    """Noise that is brightest in the middle."""
    shades = 20 + 180 * np.exp(-(((np.arange(WIDTH) - WIDTH / 2) / 100) ** 2))[None, :, None]
    return (shades + np.random.default_rng(0).uniform(0, 55, (HEIGHT, WIDTH, 3))).astype(np.uint8)


def box_of(pixels):
    """(x, y, w, h) about the middle of the frame, on whole pixels."""
    w, h = SIZES[pixels]
    return np.array([(WIDTH - w) // 2, (HEIGHT - h) // 2, w, h], float)


def numpy_shares(frame, box, but_for=None):
    """The shares of each colour in a box, and of none of another, (3, bins)."""
    chosen = covered(box) if but_for is None else covered(box) & ~covered(but_for)
    bins = frame[chosen].astype(int) * BINS // 256
    counts = np.stack([np.bincount(bins[:, c], minlength=BINS) for c in range(3)])
    return counts / counts.sum(axis=1, keepdims=True)


def covered(box):
    """The pixels whose centres lie in the box."""
    x, y, w, h = box
    columns, rows = np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5
    return ((rows >= y) & (rows < y + h))[:, None] & (columns >= x) & (columns < x + w)


def grown(box, across, down=1.0):
    x, y, w, h = box
    return np.array([x - (across - 1) * w / 2, y - (down - 1) * h / 2, across * w, down * h])


@pytest.mark.exactness
@pytest.mark.parametrize("pixels", SIZES)
@pytest.mark.parametrize("wide_counts", [False, True])
def test_a_count_that_cannot_be_made_is_no_zero(frame, pixels, wide_counts):
    table = integral_histogram(jnp.asarray(frame), COLOURS, wide_counts)
    x, y, w, h = box = box_of(pixels)
    counts = np.asarray(table.counts(jnp.asarray([[x + w / 2, y + h / 2, w, h]]), 1)[0, 0])
    if pixels >= 2**16 and not wide_counts:
        assert np.isnan(counts).all()
        np.testing.assert_array_equal(normalise(jnp.asarray(counts)), 0)
    else:
        np.testing.assert_array_equal(counts, np.round(pixels * numpy_shares(frame, box)))


@pytest.mark.parametrize("pixels", quick_of(SIZES, [16_384, 65_536]))
def test_references_their_weights_and_the_contrast_are_numpys(frame, pixels):
    x, y, w, h = box = box_of(pixels)
    inside = numpy_shares(frame, box)
    model = ColourModel.from_frame(frame, box[None], colours=COLOURS, weigh_colours=True)
    share = inside + numpy_shares(frame, grown(box, 2, 2), but_for=box)
    weights = np.where(share > 0, inside / np.where(share > 0, share, 1), 0.5)
    assert 0.1 < weights.min() < 0.45 or 0.55 < weights.max() < 0.9
    np.testing.assert_allclose(model.colour_weights[0, 0], weights, rtol=1e-5)
    weighed = inside * weights
    expected = weighed / weighed.sum(axis=1, keepdims=True)
    np.testing.assert_allclose(model.references[0, 0], expected, rtol=1e-5)
    model = ColourModel.from_frame(frame, box[None], colours=COLOURS, sigma=0.15)
    model = dataclasses.replace(model, contrast=0.5)
    state = BoxState(jnp.asarray([[x + w / 2, y + h / 2, 1, 1]]), jnp.zeros(1, jnp.int32))
    sides = numpy_shares(frame, grown(box, 2), but_for=box)
    expected = 0.5 * np.sum(1 - np.sum(np.sqrt(sides * inside), axis=1)) / (2 * 0.15**2)
    assert expected > 1
    found = float(model.log_likelihood(jnp.asarray(frame), state)[0])
    np.testing.assert_allclose(found, expected, rtol=1e-3)


@pytest.mark.exactness
def test_growing_beyond_all_counts_is_not_rewarded():
    """On one colour throughout, where no size speaks for itself."""
    plain, box = np.full((HEIGHT, WIDTH, 3), 100, np.uint8), np.array([[280.0, 280.0, 60.0, 60.0]])
    model = ColourModel.from_frame(plain, box, colours=COLOURS)
    model = dataclasses.replace(model, contrast=0.5)
    assert not model.wide_counts
    scales = np.array([1.0, 2.0, 3.0, 3.5, 4.0, 4.2, 4.3, 5.0, 8.0])
    boxes = np.stack([np.full_like(scales, 310), np.full_like(scales, 310), scales, scales], axis=1)
    states = BoxState(jnp.asarray(boxes, jnp.float32), jnp.zeros(len(scales), jnp.int32))
    expected = np.where((60 * scales) ** 2 < 2**16, 0.0, -3 / (2 * 0.15**2))
    np.testing.assert_allclose(
        model.log_likelihood(jnp.asarray(plain), states), expected, rtol=1e-5, atol=1e-3
    )
