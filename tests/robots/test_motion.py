"""Odometry: steps thinned by motion, poses at other times, headings in degrees."""

import numpy as np
import pytest

from mpfjax import robots


def test_steps_of_poses_that_moved_far_enough():
    """The way is the same, whatever the rate, and a robot at rest makes no steps."""
    rng = np.random.default_rng(0)
    way = np.concatenate([np.linspace(0, 2, 81), np.full(100, 2.0)])
    poses = np.column_stack([way, 0 * way, 0 * way])
    poses[81:] += 0.002 * rng.normal(size=(100, 3))
    steps, stay = robots.odometry_steps(poses, 0.25, 0.2)
    assert stay.tolist() == list(range(9, 80, 10))
    assert steps == pytest.approx(np.tile([0.25, 0, 0], (8, 1)), abs=1e-9)
    every, all_stay = robots.odometry_steps(poses, 0.0, 0.0)
    assert every == pytest.approx(robots.odometry_steps(poses))
    assert all_stay.tolist() == list(range(180))
    turning = np.column_stack([np.zeros((9, 2)), 3 + 0.07 * np.arange(9)])
    assert robots.odometry_steps(turning, 0.25, 0.2)[1].tolist() == [2, 5]


def test_a_way_along_headings_in_degrees_is_refused():
    """Each turn is less than 2π; in radians the same way passes, however often it goes round."""
    turns = np.linspace(0, 6 * np.pi, 600)
    circle = np.column_stack([np.sin(turns), -np.cos(turns), turns])
    assert len(robots.odometry_steps(circle)) == 599
    with pytest.raises(ValueError, match="fit the way in degrees"):
        robots.odometry_steps(circle * [1, 1, 180 / np.pi])


def test_poses_at_the_times_of_scans():
    """Headings go the shorter way."""
    poses = np.array([[0.0, 0.0, 3.1], [1.0, 2.0, -3.1], [1.0, 4.0, -3.0]])
    between = robots.interpolated_poses([0.5, 1.0, 2.5], [0.0, 1.0, 3.0], poses)
    halfway = 3.1 + (2 * np.pi - 6.2) / 2
    assert between[0] == pytest.approx([0.5, 1.0, halfway - 2 * np.pi])
    assert between[1:] == pytest.approx(np.array([[1, 2, -3.1], [1, 3.5, -3.025]]))
