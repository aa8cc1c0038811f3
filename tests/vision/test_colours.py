"""The bins of pixels, against NumPy and matplotlib's own conversion."""

import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.colors import rgb_to_hsv

from mpfjax.vision.colour import HSVColours, hue_saturation_value, integral_histogram


@pytest.fixture(scope="module")
def frame():
    """Every kind of pixel: random ones, pure colours, greys, black and white."""
    image = np.random.default_rng(0).integers(0, 256, (40, 50, 3), dtype=np.uint8)
    corners = [[r, g, b] for r in (0, 255) for g in (0, 255) for b in (0, 255)]
    image[0, : len(corners)] = corners
    image[1] = np.linspace(0, 255, 50).astype(np.uint8)[:, None]
    return image


def test_hue_saturation_and_value_are_matplotlibs(frame):
    expected = rgb_to_hsv(frame / 255.0)
    found = np.stack(
        [np.asarray(part) for part in hue_saturation_value(jnp.asarray(frame))], axis=-1
    )
    np.testing.assert_allclose(found, expected, atol=1e-6)


@pytest.mark.exactness
def test_hsv_counts_by_colour_or_by_value(frame):
    """N_h N_s + N_v bins in one histogram, filled by a loop over the pixels."""
    colours = HSVColours(num_hues=5, num_saturations=4, num_values=3)
    hue, saturation, value = np.moveaxis(rgb_to_hsv(frame / 255.0), -1, 0)
    expected = np.zeros(5 * 4 + 3)
    for h, s, v in zip(hue.ravel(), saturation.ravel(), value.ravel(), strict=True):
        if s >= 0.1 and v >= 0.2:
            expected[min(int(h * 5), 4) * 4 + min(int(s * 4), 3)] += 1
        else:
            expected[20 + min(int(v * 3), 2)] += 1
    table = integral_histogram(jnp.asarray(frame), colours, False)
    counts = table.counts(jnp.array([[25.0, 20.0, 50.0, 40.0]]), 1)
    assert counts.shape == (1, 1, 1, 23)
    # Float32 may put a pixel on the border of two bins into the other one.
    assert np.abs(np.asarray(counts[0, 0, 0]) - expected).sum() <= 10
    assert expected[20:].min() > 0
    assert expected[:20].min() > 0
