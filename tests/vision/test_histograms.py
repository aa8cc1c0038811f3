"""Integral histograms against NumPy's own, on boxes inside, across and outside the frame."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.colors import rgb_to_hsv

from mpfjax.vision.colour import (
    HSVColours,
    RGBColours,
    bhattacharyya,
    hue_saturation_value,
    integral_histogram,
    normalise,
    sampled_histograms,
)


@eqx.filter_jit
def counted(table, boxes, num_parts=1):
    """As one program: one operation after the other compiles longer."""
    return table.counts(boxes, num_parts)


HEIGHT, WIDTH = 41, 67


@pytest.fixture(scope="module")
def frame():
    return np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)


def numpy_counts(frame, box, num_bins, num_parts):
    """The same counts by NumPy: pixels whose centres the box covers, band by band."""
    x, y, w, h = (float(value) for value in box)
    columns, rows = np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5
    across = (columns >= x - w / 2) & (columns < x + w / 2)
    counts = np.zeros((num_parts, 3, num_bins))
    for part in range(num_parts):
        top, bottom = (y + h * ((part + i) / num_parts - 0.5) for i in (0, 1))
        pixels = frame[(rows >= top) & (rows < bottom)][:, across].reshape(-1, 3)
        for channel in range(3):
            edges = np.arange(num_bins + 1) * 256 / num_bins
            counts[part, channel] = np.histogram(pixels[:, channel], edges)[0]
    return counts


def random_boxes(num):
    """Eighths of a pixel, so that both sides round the same edges alike."""
    rng = np.random.default_rng(1)
    boxes = rng.uniform((-20, -20, 1, 1), (WIDTH + 20, HEIGHT + 20, 60, 60), (num, 4))
    return (np.round(boxes * 8) / 8).astype(np.float32)


@pytest.mark.exactness
@pytest.mark.parametrize(("num_bins", "num_parts"), [(30, 1), (16, 1), (7, 2), (256, 1)])
@pytest.mark.parametrize("wide_counts", [False, True])
def test_counts_are_numpys(frame, num_bins, num_parts, wide_counts):
    boxes = random_boxes(60)
    boxes[:, 3] = np.round(boxes[:, 3])
    table = integral_histogram(jnp.asarray(frame), RGBColours(num_bins), wide_counts)
    counts = counted(table, jnp.asarray(boxes), num_parts)
    assert counts.shape == (60, num_parts, 3, num_bins)
    expected = np.stack([numpy_counts(frame, box, num_bins, num_parts) for box in boxes])
    assert expected.sum() > 0
    np.testing.assert_array_equal(np.asarray(counts), expected)


@pytest.mark.parametrize(
    "box",
    [
        (-30.0, 20.0, 20.0, 20.0),
        (30.0, HEIGHT + 30.0, 20.0, 20.0),
        (30.0, 20.0, 0.0, 20.0),
        (30.0, 20.0, 20.0, -5.0),
        (30.0, 20.0, -20.0, -20.0),
        (np.nan, 20.0, 20.0, 20.0),
        (30.0, np.inf, 20.0, 20.0),
    ],
)
def test_a_box_without_pixels_is_empty_and_lies_farthest(frame, box):
    table = integral_histogram(jnp.asarray(frame), RGBColours(30), False)
    counts = counted(table, jnp.asarray([box]), 2)
    np.testing.assert_array_equal(np.asarray(counts), 0)
    reference = normalise(counted(table, jnp.asarray([(30.0, 20.0, 20.0, 20.0)]), 2))
    np.testing.assert_array_equal(np.asarray(bhattacharyya(normalise(counts), reference)), 1.0)


# --- from a grid of points in each box ---------------------------------------------------------

SMALL = np.random.default_rng(0).integers(0, 256, (30, 40, 3), dtype=np.uint8)
BOXES = np.array(
    [[20, 15, 10, 12], [3.3, 4.1, 9, 7.5], [38, 28, 12, 9], [20, 15, 90, 70], [15, 10, 0.4, 0.4]]
)


def one_by_one(frame, box, colours, rows, columns, num_parts):
    bins, (x, y, w, h) = np.asarray(colours.bins(jnp.asarray(frame))), box
    counts = np.zeros((num_parts, colours.num_channels, colours.num_bins))
    for i, j in np.ndindex(rows, columns):
        down = int(np.floor(y + h * ((i + 0.5) / rows - 0.5)))
        across = int(np.floor(x + w * ((j + 0.5) / columns - 0.5)))
        if 0 <= down < frame.shape[0] and 0 <= across < frame.shape[1]:
            for channel in range(colours.num_channels):
                counts[i * num_parts // rows, channel, bins[down, across, channel]] += 1
    return counts


class FewColours(HSVColours):
    num_hues, num_saturations, num_values = 5, 4, 3


@pytest.mark.parametrize("colours", [FewColours(), RGBColours(5)], ids=["hsv", "rgb"])
@pytest.mark.parametrize("num_parts", [1, 3])
def test_every_point_counts_once(colours, num_parts):
    shares = sampled_histograms(SMALL, BOXES, colours, num_parts)
    expected = np.stack([one_by_one(SMALL, box, colours, 18, 8, num_parts) for box in BOXES])
    expected /= np.maximum(expected.sum(axis=-1, keepdims=True), 1)
    np.testing.assert_allclose(shares, expected, rtol=1e-12)


# --- the bins of pixels ------------------------------------------------------------------------


@pytest.fixture(scope="module")
def kinds():
    """Every kind of pixel: random ones, pure colours, greys, black and white."""
    image = np.random.default_rng(0).integers(0, 256, (40, 50, 3), dtype=np.uint8)
    image[0, :8] = 255 * np.stack(np.unravel_index(np.arange(8), (2, 2, 2)), axis=1)
    image[1] = np.linspace(0, 255, 50).astype(np.uint8)[:, None]
    return image


def test_hue_saturation_and_value_are_matplotlibs(kinds):
    found = np.stack(hue_saturation_value(jnp.asarray(kinds)), axis=-1)
    np.testing.assert_allclose(found, rgb_to_hsv(kinds / 255.0), atol=1e-6)


@pytest.mark.exactness
def test_hsv_counts_by_colour_or_by_value(kinds):
    """N_h N_s + N_v bins in one histogram."""
    hue, saturation, value = np.moveaxis(rgb_to_hsv(kinds / 255.0), -1, 0)
    h, s, v = (np.minimum((x * n).astype(int), n - 1) for x, n in
               ((hue, 5), (saturation, 4), (value, 3)))  # fmt: skip
    bins = np.where((saturation >= 0.1) & (value >= 0.2), 4 * h + s, 20 + v)
    expected = np.bincount(bins.ravel(), minlength=23)
    assert expected.min() > 0
    table = integral_histogram(jnp.asarray(kinds), FewColours(), False)
    counts = table.counts(jnp.array([[25.0, 20.0, 50.0, 40.0]]), 1)
    assert counts.shape == (1, 1, 1, 23)
    # Float32 may put a pixel on the border of two bins into the other one.
    assert np.abs(np.asarray(counts[0, 0, 0]) - expected).sum() <= 10
