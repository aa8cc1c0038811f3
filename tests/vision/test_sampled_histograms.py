"""Histograms from a grid of points in each box, against counting the points one by one."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from mpfjax.vision import HSVColours, RGBColours
from mpfjax.vision.colour.histograms import (
    SampledBoxes,
    bhattacharyya,
    integral_histogram,
    normalise,
)

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


@pytest.mark.parametrize(
    "box",
    [
        [-50, 10, 8, 8],
        [10, 200, 8, 8],
        [3e9, 10, 8, 8],
    ],
)
def test_what_is_no_box_in_the_frame_counts_nothing(box):
    assert not np.asarray(counted([box], HSVColours(4, 2, 2), 3)).any()


@pytest.mark.thorough
def test_distances_are_nearly_those_of_all_pixels():
    """A frame of broad patches, boxes of many pixels: the mean error of B² stays small."""
    coarse = RNG.integers(0, 256, (12, 16, 3), dtype=np.uint8)
    frame = jnp.asarray(np.kron(coarse, np.ones((10, 10, 1), np.uint8)))
    places = np.c_[RNG.uniform(30, 130, (200, 1)), RNG.uniform(40, 80, (200, 1))]
    boxes = jnp.asarray(np.c_[places, RNG.uniform(20, 60, (200, 2))], jnp.float32)
    colours = HSVColours(4, 2, 2)
    exact = normalise(integral_histogram(frame, colours).counts(boxes))
    sampled = normalise(counted(boxes, colours, frame=np.asarray(frame)))
    errors = np.abs(
        bhattacharyya(sampled, jnp.roll(sampled, 1, 0))
        - bhattacharyya(exact, jnp.roll(exact, 1, 0))
    )
    assert errors.mean() < 0.02
    assert np.asarray(bhattacharyya(sampled, exact)).mean() < 0.02


def test_a_bad_frame_is_named(as_installed):
    for frame in (np.zeros((3, 4), np.uint8), np.zeros((3, 4, 3), np.float32)):
        with pytest.raises(ValueError, match=r"^frame: "):
            SampledBoxes.of(frame, BOXES, HSVColours())
