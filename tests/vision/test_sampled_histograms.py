"""Histograms from a grid of points in each box, against counting the points one by one."""

import jax.numpy as jnp
import numpy as np
import pytest

from mpfjax.vision import HSVColours, RGBColours
from mpfjax.vision.colour.histograms import sampled_histograms

RNG = np.random.default_rng(0)
FRAME = RNG.integers(0, 256, (30, 40, 3), dtype=np.uint8)
BOXES = np.array(
    [[20, 15, 10, 12], [3.3, 4.1, 9, 7.5], [38, 28, 12, 9], [20, 15, 90, 70], [15, 10, 0.4, 0.4]]
)


def one_by_one(frame, box, colours, rows, columns, num_parts):
    bins = np.asarray(colours.bins(jnp.asarray(frame)))
    counts = np.zeros((num_parts, colours.num_channels, colours.num_bins))
    x, y, w, h = box
    for i in range(rows):
        for j in range(columns):
            down = int(np.floor(y + h * ((i + 0.5) / rows - 0.5)))
            across = int(np.floor(x + w * ((j + 0.5) / columns - 0.5)))
            if 0 <= down < frame.shape[0] and 0 <= across < frame.shape[1]:
                for channel in range(colours.num_channels):
                    counts[i * num_parts // rows, channel, bins[down, across, channel]] += 1
    return counts


@pytest.mark.parametrize(
    "colours",
    [HSVColours(num_hues=4, num_saturations=2, num_values=2), RGBColours(5)],
    ids=["hsv", "rgb"],
)
@pytest.mark.parametrize("num_parts", [1, 3])
def test_every_point_counts_once(colours, num_parts):
    shares = sampled_histograms(FRAME, BOXES, colours, num_parts)
    expected = np.stack([one_by_one(FRAME, box, colours, 18, 8, num_parts) for box in BOXES])
    expected /= np.maximum(expected.sum(axis=-1, keepdims=True), 1)
    np.testing.assert_allclose(shares, expected, rtol=1e-12)
