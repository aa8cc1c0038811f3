"""Histograms from a grid of points in each box, against counting the points one by one."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from mpfjax.vision import HSVColours, RGBColours
from mpfjax.vision.colour.histograms import SampledBoxes

RNG = np.random.default_rng(0)
FRAME = RNG.integers(0, 256, (30, 40, 3), dtype=np.uint8)
BOXES = np.array(
    [[20, 15, 10, 12], [3.3, 4.1, 9, 7.5], [38, 28, 12, 9], [20, 15, 90, 70], [15, 10, 0.4, 0.4]]
)


@eqx.filter_jit
def _counted(looked, num_parts):
    return looked.counts(num_parts)


def counted(boxes, colours, num_parts=1, frame=FRAME):
    """As one program: one operation after the other compiles longer."""
    boxes = np.asarray(boxes, np.float32)
    return _counted(SampledBoxes.of(frame, boxes, colours), num_parts)


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


@pytest.mark.parametrize("colours", [HSVColours(4, 2, 2), RGBColours(5)], ids=["hsv", "rgb"])
@pytest.mark.parametrize("num_parts", [1, 3])
def test_every_point_counts_once(colours, num_parts):
    counts = np.asarray(counted(BOXES, colours, num_parts))
    expected = [one_by_one(FRAME, box, colours, 18, 8, num_parts) for box in BOXES]
    np.testing.assert_array_equal(counts, expected)
