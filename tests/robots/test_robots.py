"""A robot's parts beside loops written from the tables of Thrun, Burgard and Fox (2005)."""

import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml
from PIL import Image
from scipy.stats import norm

import mpfjax
from mpfjax import robots

CELL = 0.1
WALLS = np.zeros((30, 40), bool)
WALLS[[0, -1]] = WALLS[:, [0, -1]] = True
WALLS[8:12, 20:25] = WALLS[20:, 12] = True
FREE = ~WALLS
EDGES = WALLS.copy()
EDGES[9:11, 21:24] = False  # within the block
FREE[25:29, 1:12] = False  # unknown
GRID = robots.OccupancyGrid(WALLS, FREE, resolution=CELL, origin=(-1.0, 2.0))
ANGLES = jnp.linspace(-2.0, 2.0, 9)
SCAN = jnp.array([1.1, np.nan, 0.4, np.inf, 0.02, 1.7, 3.0, 0.9, 2.2])
MOUNT, MOST, LEAST = (0.2, -0.1, 0.3), 2.5, 0.05
PLACES = [(0.3, 3.1, 0.4), (2.05, 4.4, -2.9), (-0.5, 2.6, 1.5)]
POSES = jnp.array(PLACES)
SHARED = {"laser_max_range": MOST, "laser_min_range": LEAST, "mount": MOUNT, "exponent": 0.5}
WEIGHTS = {"z_hit": 0.7, "z_rand": 0.2, "sigma_hit": 0.15}


def scanner(pose):
    x, y, heading = pose
    forward, left, turn = MOUNT
    x += np.cos(heading) * forward - np.sin(heading) * left
    y += np.sin(heading) * forward + np.cos(heading) * left
    return x, y, heading + turn


def cell(x, y):
    column, row = int(np.floor((x + 1.0) / CELL)), int(np.floor((y - 2.0) / CELL))
    return (row, column) if 0 <= row < 30 and 0 <= column < 40 else None


def gap(x, y):
    """Metres to the nearest occupied cell at an edge, at most those of the field."""
    column, row = np.floor((x + 1.0) / CELL), np.floor((y - 2.0) / CELL)
    here = np.array([np.clip(row, 0, 29), np.clip(column, 0, 39)])
    if cell(x, y) is None:
        return 0.8
    return min(0.8, CELL * np.min(np.hypot(*(np.argwhere(EDGES) - here).T)))


def beams():
    for z, angle in zip(SCAN.tolist(), ANGLES.tolist(), strict=True):
        if not np.isnan(z):
            yield (MOST if z <= LEAST else min(z, MOST)), angle


@pytest.mark.exactness
def test_likelihood_field_is_table_6_3_and_its_cubes_are_those_of_amcl():
    options = {"laser_likelihood_max_dist": 0.8} | SHARED | WEIGHTS
    product, cubes = (
        robots.LikelihoodField(ANGLES, weighting=name, **options).log_likelihood(SCAN, POSES, GRID)
        for name in ("product", "cubes")
    )
    for k, pose in enumerate(PLACES):
        (x, y, heading), q, weight = scanner(pose), 1.0, 1.0
        for z, angle in beams():
            if z < MOST:
                far = gap(x + z * np.cos(heading + angle), y + z * np.sin(heading + angle))
                q *= (0.7 * norm.pdf(far, 0, 0.15) + 0.2 / MOST) / 0.9
                weight += (0.7 * np.exp(-(far**2) / (2 * 0.15**2)) + 0.2 / MOST) ** 3
        assert product[k] == pytest.approx(0.5 * np.log(q), rel=1e-4)
        assert cubes[k] == pytest.approx(np.log(weight), rel=1e-4)


@pytest.mark.exactness
def test_beam_model_is_table_6_1():
    more = {"z_short": 0.05, "z_max": 0.1, "lambda_short": 0.6}
    sensor = robots.BeamModel(ANGLES, **SHARED, **WEIGHTS, **more)
    for pose, found in zip(PLACES, sensor.log_likelihood(SCAN, POSES, GRID), strict=True):
        (x, y, heading), q = scanner(pose), 1.0
        for z, angle in beams():
            expected = float(
                GRID.ranges(jnp.array([[x, y, heading]]), jnp.array([angle]), MOST)[0, 0]
            )
            inside = norm.cdf(MOST, expected, 0.15) - norm.cdf(0, expected, 0.15)
            p = 0.7 * norm.pdf(z, expected, 0.15) / inside
            if z <= expected:
                p += 0.05 * 0.6 * np.exp(-0.6 * z) / (1 - np.exp(-0.6 * expected))
            p += 0.1 if z == MOST else 0.2 / MOST
            q *= p / 1.05
        assert found == pytest.approx(0.5 * np.log(q), rel=1e-4)


@pytest.mark.parametrize("step", [(0.4, 0.1, 0.5), (-0.3, 0.1, 0.2), (0.001, 0.002, 0.9)])
def test_odometry_is_table_5_6(step):
    noise = np.array([[0.3, -1.2, 0.7], [-0.8, 0.1, 1.9], [0.0, 0.4, -1.1]])
    motion = robots.OdometryMotion(alpha1=0.1, alpha2=0.2, alpha3=0.3, alpha4=0.15)
    found = motion.from_noise(jnp.asarray(noise, jnp.float32), POSES, jnp.asarray(step))
    forward, left, turn = step
    rot1, trans = np.arctan2(left, forward), np.hypot(forward, left)
    if forward < 0:
        rot1, trans = rot1 - np.pi, -trans
    rot2 = turn - rot1
    of1, of2 = (0.0, turn) if abs(trans) < 0.01 else (rot1, rot2)
    deviations = np.sqrt([
        0.1 * of1**2 + 0.2 * trans**2,
        0.3 * trans**2 + 0.15 * (of1**2 + of2**2),
        0.1 * of2**2 + 0.2 * trans**2,
    ])  # fmt: skip
    for (x, y, heading), e, after in zip(PLACES, noise, found, strict=True):
        one, far, other = np.array([rot1, trans, rot2]) + deviations * e
        moved = x + far * np.cos(heading + one), y + far * np.sin(heading + one)
        assert after[:2] == pytest.approx(moved, abs=1e-4)
        turned = after[2] - (heading + one + other)
        assert np.sin(turned / 2) == pytest.approx(0, abs=1e-4)
        assert abs(after[2]) <= np.pi


FIELD, MOTION = robots.LikelihoodField(ANGLES, laser_max_range=MOST), robots.OdometryMotion()


def robot(**options):
    return robots.RobotModel(GRID, MOTION, FIELD, **options)


@pytest.mark.exactness
def test_model_agrees_with_itself():
    mpfjax.check_model(jax.random.key(0), robot(), SCAN, inputs=jnp.array([0.3, 0.0, 0.2]))


@pytest.mark.exactness
def test_first_pose_is_uniform_on_free_cells():
    model = robot(clearance=0.15)
    columns, rows = np.meshgrid(np.arange(-1.05, 3.2, CELL), np.arange(1.95, 5.2, CELL))
    poses = np.stack([columns.ravel(), rows.ravel(), 0 * rows.ravel()], axis=1)
    density = np.exp(model.log_initial(jnp.asarray(poses, jnp.float32)))
    assert density.sum() * CELL**2 * 2 * np.pi == pytest.approx(1, rel=1e-4)
    draws = model.sample_initial(jax.random.key(0), 20_000)
    assert np.isfinite(model.log_initial(draws)).all()
    is_start = FREE & (np.asarray(GRID.distances) > 0.15)
    expected = GRID.resolution * (np.argwhere(is_start)[:, ::-1] + 0.5).mean(axis=0) + [-1.0, 2.0]
    assert draws.mean(axis=0) == pytest.approx([*expected, 0], abs=4 * 1.9 / np.sqrt(20_000))


@pytest.mark.exactness
def test_first_pose_near_a_given_one():
    model = robot(initial_pose=(0.3, 3.1, 3.0), initial_deviations=(0.2, 0.3, 0.4))
    draws = np.asarray(model.sample_initial(jax.random.key(0), 2000))
    turns = (draws[:, 2] - 3.0 + np.pi) % (2 * np.pi) - np.pi
    away = np.stack([*(draws[:, :2] - [0.3, 3.1]).T, turns], axis=1)
    assert model.log_initial(jnp.asarray(draws)) == pytest.approx(
        norm.logpdf(away, 0, [0.2, 0.3, 0.4]).sum(axis=1), abs=1e-3
    )
    assert away.std(axis=0) == pytest.approx([0.2, 0.3, 0.4], rel=4 / np.sqrt(2 * 2000))


def test_map_of_ros(tmp_path):
    """Written and read again: rows from the top, unknown cells, thresholds, origin."""
    grey = np.where(WALLS, 0, np.where(FREE, 254, 205)).astype(np.uint8)[::-1]
    Image.fromarray(grey).save(tmp_path / "map.pgm")
    said = {"image": "map.pgm", "resolution": CELL, "origin": [-1.0, 2.0, 0.0], "negate": 0,
            "occupied_thresh": 0.65, "free_thresh": 0.196, "mode": "trinary"}  # fmt: skip
    (tmp_path / "map.yaml").write_text(yaml.safe_dump(said))
    found = robots.read_map(tmp_path / "map.yaml")
    assert (found.occupied == WALLS).all()
    assert (found.free == FREE).all()
    assert (found.resolution, found.origin) == (CELL, (-1.0, 2.0))
    for name, value in (("mode", "raw"), ("origin", [0, 0, 0.1])):
        (tmp_path / "bad.yaml").write_text(yaml.safe_dump(said | {name: value}))
        with pytest.raises(ValueError, match=name):
            robots.read_map(tmp_path / "bad.yaml")


def test_map_of_an_image(tmp_path, monkeypatch):
    """A transparent pixel is unknown."""
    pixels = np.array([[[0, 255], [255, 255]], [[255, 0], [128, 255]]], np.uint8)
    Image.fromarray(pixels, "LA").save(tmp_path / "plan.png")
    found = robots.read_map(tmp_path / "plan.png", resolution=0.5)
    assert found.occupied.tolist() == [[False, False], [True, False]]
    assert found.free.tolist() == [[False, False], [False, True]]
    with pytest.raises(ValueError, match="resolution"):
        robots.read_map(tmp_path / "plan.png")
    monkeypatch.setitem(sys.modules, "PIL.Image", None)
    with pytest.raises(ImportError, match="pip install pillow"):
        robots.read_map(tmp_path / "plan.png", resolution=0.5)


def test_usable_beams_are_spaced_evenly():
    """Of 283 beams in a row sixty are used, as many of every second one, and of three all."""
    angles = jnp.linspace(-3.0, 3.0, 720)
    sensor = robots.LikelihoodField(angles, laser_max_range=MOST)
    in_a_row = 200 + np.linspace(0, 282, 60).round().astype(int)
    for seen, used, nothing in (
        (np.arange(200, 483), in_a_row, np.inf),
        (np.arange(1, 720, 2), np.arange(1, 720, 2), np.nan),
        ([5, 300, 301], np.array([5, 300, 301]), np.nan),
    ):
        scan = np.full(720, nothing, np.float32)
        scan[seen] = 1.0 + 0.001 * np.arange(len(seen))
        alone = robots.LikelihoodField(angles[used], laser_max_range=MOST)
        expected = alone.log_likelihood(jnp.asarray(scan[used]), POSES, GRID)
        assert sensor.log_likelihood(jnp.asarray(scan), POSES, GRID) == pytest.approx(expected)


def test_too_near_is_not_nothing():
    """REP 117: -inf is a beam that met something too near to be measured."""
    sensor = robots.BeamModel(ANGLES, laser_max_range=MOST)
    near = sensor.log_likelihood(SCAN.at[2].set(-jnp.inf), POSES, GRID)
    left_out = sensor.log_likelihood(SCAN.at[2].set(jnp.nan), POSES, GRID)
    assert near == pytest.approx(left_out)


def test_an_exponent_of_many_beams_is_a_warning():
    angles = jnp.linspace(-1.0, 1.0, 60)
    with pytest.warns(RuntimeWarning, match="exponent: with 1 a scan is worth 60"):
        robots.LikelihoodField(angles, laser_max_range=MOST, exponent=1.0)
    scan = jnp.full(60, 1.5)
    by_default = robots.LikelihoodField(angles, laser_max_range=MOST)
    tenth = robots.LikelihoodField(angles, laser_max_range=MOST, exponent=1 / 6)
    expected = tenth.log_likelihood(scan, POSES, GRID)
    assert by_default.log_likelihood(scan, POSES, GRID) == pytest.approx(expected)


def test_a_robot_is_in_no_wall_and_may_be_where_the_map_is_unknown():
    """Free, unknown, occupied, off the map; a step into a wall or off the map only turns it."""
    poses = jnp.array([[0.5, 2.55, 0], [-0.5, 4.65, 0], [1.2, 3.0, 0], [9.0, 3.0, 0]])
    logs = np.asarray(robot().log_likelihood(SCAN, poses))
    assert np.isfinite(logs).tolist() == [True, True, False, False]
    exact = robots.OdometryMotion(alpha1=1e-4, alpha2=1e-4, alpha3=1e-4, alpha4=1e-4)
    model = robots.RobotModel(
        GRID, exact, robot().sensor, initial_pose=(1.24, 2.7, np.pi / 2),
        initial_deviations=(0.01, 0.01, 0.01),
    )  # fmt: skip
    filter = mpfjax.particle_filter(model, 100)
    mixture = filter.init(jax.random.key(0))
    for forward in (0.3, 0.3, 9.0):
        before, step = mixture.particles, jnp.array([forward, 0.0, 0.1])
        mixture, info = filter.step(jax.random.key(1), mixture, SCAN, inputs=step)
        assert not info.degenerate
        np.testing.assert_allclose(GRID.at(mixture.particles[:, :2], GRID.occupied, True), False)
        places = {tuple(place) for place in np.asarray(before[:, :2])}
        assert {tuple(place) for place in np.asarray(mixture.particles[:, :2])} <= places
        turned = np.mean(mixture.particles[:, 2]) - np.mean(before[:, 2])
        assert turned == pytest.approx(0.1, abs=0.01)


@pytest.mark.parametrize(
    ("named", "make"),
    [
        ("angles: .*radians", lambda: robots.LikelihoodField(
            jnp.arange(360.0), laser_max_range=MOST)),
        ("mount: .*radians", lambda: robots.LikelihoodField(
            ANGLES, laser_max_range=MOST, mount=(0.1, 0.0, 180.0))),
        ("grid: ", lambda: robots.RobotModel(WALLS, MOTION, FIELD)),
        ("motion: ", lambda: robots.RobotModel(GRID, FIELD, FIELD)),
        ("sensor: ", lambda: robots.RobotModel(GRID, MOTION, MOTION)),
        ("occupied: ", lambda: robots.OccupancyGrid(np.zeros((2, 2), bool), resolution=CELL)),
        ("clearance: ", lambda: robot(clearance=9.0)),
        ("initial_pose: .*off the map", lambda: robot(initial_pose=(9.0, 3.0, 0.0))),
        ("initial_pose: .*occupied cell", lambda: robot(initial_pose=(1.2, 3.0, 0.0))),
        ("initial_pose: .*radians", lambda: robot(initial_pose=(0.5, 2.55, 90.0))),
        ("initial_pose: .*finite", lambda: robot(initial_pose=(0.5, 2.55, np.nan))),
        ("poses: a turn of 90 .* in radians", lambda: robots.odometry_steps(90 * np.eye(3))),
        ("poses: a turn of 90 .* in radians", lambda: robots.interpolated_poses(
            [0.5], [0, 1], np.array([[0.0, 0, 0], [0.1, 0, 90]]))),
        ("min_distance, min_turn: ", lambda: robots.odometry_steps(np.eye(3), 0.25)),
        ("times: not all", lambda: robots.interpolated_poses([3.5], [0.0, 1.0, 3.0], np.eye(3))),
        ("pose_times: ", lambda: robots.interpolated_poses([0.5], [0.0, 1.0, 1.0], np.eye(3))),
        ("observation: ", lambda: robot().log_likelihood(SCAN[1:], POSES)),
        ("inputs: None", lambda: robot().sample_transition(jax.random.key(0), POSES)),
    ],
)  # fmt: skip
def test_refusals(named, make):
    with pytest.raises(ValueError, match=named):
        make()


def test_poses_in_place_of_steps_are_a_warning(recwarn):
    turn = np.linspace(0, 3, 20)
    poses = np.stack([np.sin(turn), 3.2 - np.cos(turn), turn], axis=1)
    scans, filter = np.tile(SCAN, (19, 1)), mpfjax.particle_filter(robot(), 10)
    mpfjax.run_filter(jax.random.key(0), filter, scans, inputs=robots.odometry_steps(poses))
    assert not any("odometry_steps" in str(each.message) for each in recwarn)
    with pytest.warns(RuntimeWarning, match="inputs: they look like poses"):
        mpfjax.run_filter(jax.random.key(0), filter, scans, inputs=poses[1:])
