"""Histograms from a grid of points in each box, against counting the points one by one."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mpfjax.vision import (
    HSVColours,
    RGBColours,
    SampledHistogram,
    bhattacharyya,
    integral_histogram,
)
from mpfjax.vision.colour.histograms import normalise
from mpfjax.vision.colour.sampled_histograms import SampledBoxes
from tests.marking import thorough

RNG = np.random.default_rng(0)
FRAME = RNG.integers(0, 256, (30, 40, 3), dtype=np.uint8)
BOXES = np.array(
    [[20, 15, 10, 12], [3.3, 4.1, 9, 7.5], [38, 28, 12, 9], [20, 15, 90, 70], [15, 10, 0.4, 0.4]]
)


@eqx.filter_jit
def counted(table, *arguments):
    """As one program: one operation after the other compiles longer."""
    return table.counts(*arguments)


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
    table = SampledHistogram(jnp.asarray(FRAME), colours, rows=6, columns=4)
    counts = np.asarray(counted(table, jnp.asarray(BOXES, jnp.float32), num_parts))
    expected = [one_by_one(FRAME, box, colours, 6, 4, num_parts) for box in BOXES]
    np.testing.assert_array_equal(counts, expected)


@pytest.mark.thorough
def test_rows_are_made_up_to_whole_bands():
    table = SampledHistogram(jnp.asarray(FRAME), HSVColours(4, 2, 2), rows=7, columns=4)
    counts = table.counts(jnp.asarray(BOXES[:1], jnp.float32), 3)
    np.testing.assert_array_equal(np.asarray(counts).sum(axis=(2, 3)), [[12, 12, 12]])


@pytest.mark.parametrize(
    "box",
    [
        [-50, 10, 8, 8],
        [10, 200, 8, 8],
        [10, 10, 0, 8],
        [10, 10, 8, -3],
        [np.nan, 10, 8, 8],
        [10, 10, np.inf, 8],
        [3e9, 10, 8, 8],
    ],
)
def test_what_is_no_box_in_the_frame_counts_nothing(box):
    table = SampledHistogram(jnp.asarray(FRAME), HSVColours(4, 2, 2))
    assert not np.asarray(counted(table, jnp.asarray([box], jnp.float32), 3)).any()


@pytest.mark.thorough
def test_distances_are_nearly_those_of_all_pixels():
    """A frame of broad patches, boxes of many pixels: the mean error of B² stays small."""
    coarse = RNG.integers(0, 256, (12, 16, 3), dtype=np.uint8)
    frame = jnp.asarray(np.kron(coarse, np.ones((10, 10, 1), np.uint8)))
    places = np.c_[RNG.uniform(30, 130, (200, 1)), RNG.uniform(40, 80, (200, 1))]
    boxes = jnp.asarray(np.c_[places, RNG.uniform(20, 60, (200, 2))], jnp.float32)
    colours = HSVColours(4, 2, 2)
    exact = normalise(integral_histogram(frame, colours).counts(boxes))
    sampled = normalise(SampledHistogram(frame, colours).counts(boxes))
    errors = np.abs(
        bhattacharyya(sampled, jnp.roll(sampled, 1, 0))
        - bhattacharyya(exact, jnp.roll(exact, 1, 0))
    )
    assert errors.mean() < 0.02
    assert np.asarray(bhattacharyya(sampled, exact)).mean() < 0.02


@pytest.mark.thorough
def test_it_is_the_same_under_jit_and_vmap():
    boxes = jnp.asarray(BOXES, jnp.float32)
    colours = HSVColours(4, 2, 2)

    def counted(boxes):
        return SampledHistogram(jnp.asarray(FRAME), colours).counts(boxes, 2)

    plain = counted(boxes)
    np.testing.assert_array_equal(jax.jit(counted)(boxes), plain)
    np.testing.assert_array_equal(jax.vmap(counted)(boxes[:, None])[:, 0], plain)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"frame": np.zeros((3, 4), np.uint8)}, "frame"),
        ({"frame": np.zeros((3, 4, 3), np.float32)}, "frame"),
        ({"colours": "red"}, "colours"),
        ({"rows": 0}, "rows"),
        ({"columns": 2.5}, "columns"),
    ],
)
def test_a_bad_argument_is_named(as_installed, arguments, said):
    with pytest.raises(ValueError, match=f"^{said}: "):
        SampledHistogram(**{"frame": FRAME, "colours": HSVColours()} | arguments)


@pytest.mark.parametrize("num_parts", [3, *thorough([1])])
def test_boxes_looked_up_before_count_the_same(num_parts):
    boxes = np.concatenate([BOXES, [[-50, 10, 8, 8], [10, 10, 0, 8]]]).astype(np.float32)
    colours = HSVColours(4, 2, 2)
    table = SampledHistogram(jnp.asarray(FRAME), colours, rows=6, columns=4)
    looked = SampledBoxes.of(FRAME, boxes, colours, num_parts, rows=6, columns=4)
    np.testing.assert_array_equal(
        counted(looked, num_parts), counted(table, jnp.asarray(boxes), num_parts)
    )
    assert (int(looked.height), int(looked.width)) == FRAME.shape[:2]
    with pytest.raises(ValueError, match="num_parts: 4 does not divide the 6 rows"):
        looked.counts(4)
