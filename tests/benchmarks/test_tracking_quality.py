"""The measures of section 3.1, on boxes and runs small enough to count by hand."""

import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.tracking_quality import (
    precision,
    recall,
    recovery_rate,
    success_rate,
    track_state,
    uniqueness,
)

G = jnp.array([10.0, 20.0, 40.0, 20.0])


def box(x, y, w, h):
    return jnp.array([x, y, w, h], float)


@pytest.mark.parametrize(
    "estimate", [box(20, 25, 0, 10), box(20, 25, -10, -10), box(jnp.nan, 25, 10, 10)]
)
def test_a_box_without_area_or_place_tracks_nothing(estimate):
    assert not track_state(estimate, G)
    assert precision(estimate, G) == recall(estimate, G) == 0


def test_areas_are_those_of_counted_pixels():
    rng = np.random.default_rng(0)
    corners, sizes = rng.integers(0, 30, (50, 2, 2)), rng.integers(1, 25, (50, 2, 2))
    boxes = np.concatenate([corners, sizes], axis=2)
    masks = np.zeros((50, 2, 60, 60), bool)
    for k in range(50):
        for i in range(2):
            x, y, w, h = boxes[k, i]
            masks[k, i, y : y + h, x : x + w] = True
    shared = (masks[:, 0] & masks[:, 1]).sum(axis=(1, 2))
    estimates, truth = jnp.asarray(boxes[:, 0], float), jnp.asarray(boxes[:, 1], float)
    area = masks.sum(axis=(2, 3))
    np.testing.assert_array_equal(track_state(estimates, truth), shared > 0)
    np.testing.assert_allclose(precision(estimates, truth), shared / area[:, 0], rtol=1e-6)
    np.testing.assert_allclose(recall(estimates, truth), shared / area[:, 1], rtol=1e-6)


# Four runs of five frames: throughout, lost and back, lost for good, back only just.
STATES = jnp.array([[1, 1, 1, 1, 1], [1, 0, 0, 1, 1], [1, 1, 0, 0, 0], [1, 0, 0, 0, 1]], bool)


def test_rates_by_hand():
    assert float(success_rate(STATES)) == 0.25
    assert float(recovery_rate(STATES)) == 0.75
    assert float(recovery_rate(STATES, num_last=2)) == 0.5
    both = jnp.stack([STATES, ~STATES], axis=2)
    np.testing.assert_array_equal(success_rate(both), [0.25, 0.0])
    np.testing.assert_array_equal(recovery_rate(both), [0.75, 0.25])


def test_hypotheses_differ_where_any_number_does():
    states = np.zeros((6, 3, 2))
    states[:, 0] = np.arange(12).reshape(6, 2)
    states[:, 1, 1] = [1, 2, 1, 2, 1, 9]
    np.testing.assert_allclose(uniqueness(jnp.asarray(states)), [1.0, 3 / 6, 1 / 6], rtol=1e-6)
