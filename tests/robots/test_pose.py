"""Where a robot is said to be, and how probably it is not there."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax import robots
from tests.examples import make_mixture
from tests.robots.test_robots import ANGLES, GRID, MOST


def test_localised_is_the_mass_near_the_heaviest_component():
    """.5 in one component, of which .1 is far away, .3 near it in another, .2 elsewhere."""
    states = jnp.array([[0.0, 0, 0], [0.2, 0, 0], [0.1, 0.9, 1], [5.0, 0, 0]])
    mixture = make_mixture(states, np.log([0.25, 0.25, 0.3, 0.2]), [0, 0, 1, 2], 3)
    assert robots.localised(mixture) == pytest.approx(0.8)
    assert robots.localised(mixture, 0.5) == pytest.approx(0.5)


def test_lost_is_the_probability_of_a_change():
    """Beside the sum over all times at which the robot may have been carried away."""
    rng = np.random.default_rng(0)
    evidences, shares, p = 2 * rng.normal(size=6), rng.uniform(size=6), 1e-3
    lost = robots.lost(shares, evidences)
    for t in range(6):
        # At the start, or before any scan since.
        odds = sum(p * np.exp(evidences[k : t + 1].sum()) for k in (0, *range(t + 1)))
        assert lost[t] == pytest.approx(1 - shares[t] / (1 + odds))
    both = robots.lost(np.stack([shares, shares]), np.stack([evidences, evidences]))
    assert both == pytest.approx(np.stack([lost, lost]))
    with pytest.raises(ValueError, match="localised, log_evidence_against_start"):
        robots.lost(shares[1:], evidences)


@pytest.mark.exactness
def test_a_robot_that_is_carried_away_is_lost():
    sensor = robots.LikelihoodField(ANGLES, laser_max_range=MOST, sigma_hit=0.1, z_rand=0.1)
    start = (-0.5, 3.0, 0.0)
    motion = robots.OdometryMotion(alpha1=0.02, alpha2=0.02, alpha3=0.02, alpha4=0.02)
    model = robots.RobotModel(GRID, motion, sensor, clearance=0.1)
    poses = np.array(start) + np.outer(0.1 * np.arange(9), [1, 0, 0])
    elsewhere = poses + np.array([1.3, 1.2, 2.5])
    steps = np.tile(robots.odometry_steps(poses), (2, 1))
    places = jnp.asarray(np.concatenate([poses[1:], elsewhere[1:]]), jnp.float32)
    pairs = list(zip(steps, np.asarray(GRID.ranges(places, ANGLES, MOST)), strict=True))
    filter = mpfjax.with_alarm(mpfjax.particle_filter(model, 3000))
    estimates = list(robots.follow(jax.random.key(0), filter, pairs, radius=0.5))
    assert [len(estimates), estimates[7].lost < 0.3, estimates[-1].lost > 0.9] == [16, True, True]
    here = estimates[7]
    assert here.pose == pytest.approx(poses[-1], abs=0.2)
    assert np.linalg.eigvalsh(here.covariance).min() > 0
    assert all(each.lost >= 1 - each.localised - 1e-6 for each in estimates)
    plain = mpfjax.particle_filter(model, 10)
    with pytest.raises(ValueError, match="filter: it has no alarm"):
        next(robots.follow(jax.random.key(0), plain, pairs))
