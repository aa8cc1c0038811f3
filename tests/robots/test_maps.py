"""Maps: what a cell is, rays through walls, files of other tools, coordinates too far away."""

import jax.numpy as jnp
import numpy as np
import pytest
import yaml
from PIL import Image

from mpfjax import robots
from mpfjax.models.targets import Box, Disc

SOLID = np.zeros((60, 60), bool)
SOLID[[0, -1]] = SOLID[:, [0, -1]] = SOLID[20:40, 20:40] = True


def test_distances_are_from_the_edges_of_blocks():
    """Deep inside a block a beam has met nothing."""
    grid = robots.OccupancyGrid(SOLID, resolution=0.1)
    distances = np.asarray(grid.distances)
    assert not robots.OccupancyGrid(SOLID, SOLID, resolution=0.1).free.any()
    assert distances[30, 30] == pytest.approx(0.9)
    assert distances[20, 30] == 0
    assert distances[10, 30] == pytest.approx(1.0)


def exact_range(walls, place, angle, most):
    """Amanatides and Woo (1987), in units of cells and double precision."""
    way, cell, reach = np.array([np.cos(angle), np.sin(angle)]), np.floor(place).astype(int), 0.0
    while reach < most and not walls[cell[1], cell[0]]:
        borders = (cell + (way > 0) - place) / way
        axis = int(np.argmin(borders))
        reach, cell[axis] = borders[axis], cell[axis] + (1 if way[axis] > 0 else -1)
    return min(reach, most)


def test_no_ray_passes_a_diagonal_wall():
    """Its cells share corners alone."""
    walls = np.eye(60, dtype=bool)
    walls[[0, -1]] = walls[:, [0, -1]] = True
    rng = np.random.default_rng(0)
    places = rng.choice(np.argwhere(~walls), 300)[:, ::-1] + rng.uniform(0.05, 0.95, (300, 2))
    angles = rng.uniform(-np.pi, np.pi, 4)
    poses = jnp.asarray(np.column_stack([0.1 * places, 0 * places[:, 0]]), jnp.float32)
    ranges = robots.OccupancyGrid(walls, resolution=0.1).ranges(poses, jnp.asarray(angles), 4.0)
    expected = [[exact_range(walls, place, angle, 40) for angle in angles] for place in places]
    assert np.asarray(ranges) == pytest.approx(0.1 * np.array(expected), abs=1e-3)


def test_a_table_of_ranges_knows_the_place_within_a_cell():
    """Straight ahead it is exact."""
    grid = robots.OccupancyGrid(SOLID, resolution=0.1)
    poses = jnp.array([[1.01, 1.51, 0.0], [1.09, 1.59, 0.0]])
    ranges = grid.tabulated(4).ranges(poses, jnp.array([0.0, np.pi / 2]), 9.0)
    assert np.asarray(ranges) == pytest.approx(np.array([[4.89, 4.39], [4.81, 4.31]]), abs=1e-4)


def written(folder, pixels, **entries):
    Image.fromarray(pixels).save(folder / "map.png")
    entries = {"image": "map.png", "resolution": 0.05, "origin": [0, 0, 0]} | entries
    (folder / "map.yaml").write_text(yaml.safe_dump(entries))
    return folder / "map.yaml"


GREYS = np.array([[0, 205], [254, 100]], np.uint8)


def read_states(path, **options):
    grid = robots.read_map(path, **options)
    return np.where(grid.occupied, "#", np.where(grid.free, ".", "?"))[::-1].tolist()


READ, NEGATED = [["#", "?"], [".", "?"]], [[".", "#"], ["#", "?"]]
# For ROS green and red are a third of white, and yellow two thirds, whatever an eye says.
COLOURS = np.array([[[0, 255, 0], [255, 0, 0], [255, 255, 0], [255, 255, 255]]], np.uint8)


@pytest.mark.parametrize(
    ("pixels", "entries", "expected"),
    [
        (GREYS, {}, READ),
        (GREYS.astype(np.uint16) * 257, {}, READ),
        (GREYS, {"negate": "0"}, READ),
        (GREYS, {"negate": False}, READ),
        (GREYS, {"negate": "1"}, NEGATED),
        (COLOURS, {}, [["#", "#", "?", "."]]),
    ],
)
def test_pixels_are_read_whatever_their_kind(tmp_path, pixels, entries, expected):
    assert read_states(written(tmp_path, pixels, **entries)) == expected


def test_words_of_a_grey_map_have_their_high_byte_first(tmp_path):
    words = (GREYS.astype(">u2") * 257).tobytes()
    (tmp_path / "wide.pgm").write_bytes(b"P5\n2 2\n65535\n" + words)
    assert read_states(tmp_path / "wide.pgm", resolution=0.05) == READ


def test_numbers_of_a_file_may_be_text(tmp_path):
    """YAML 1.1 reads 5e-2 as text."""
    path = written(tmp_path, GREYS)
    path.write_text("image: map.png\nresolution: 5e-2\norigin: [1e-1, 0, 0]\n")
    assert robots.read_map(path).resolution == 0.05
    for name, value in (("resolution", "wide"), ("negate", "perhaps"), ("occupied_thresh", None)):
        with pytest.raises(ValueError, match=f"{name}: "):
            robots.read_map(written(tmp_path, GREYS, **{name: value}))


def test_unknown_grey_that_becomes_free_is_a_warning(tmp_path):
    with pytest.warns(RuntimeWarning, match=r"free_thresh: 0\.25"):
        states = read_states(written(tmp_path, GREYS, free_thresh=0.25))
    assert states == [["#", "."], [".", "?"]]


@pytest.mark.parametrize("corner", [5_412_345.0, -5_412_345.0])
def test_places_that_float32_cannot_tell_apart_are_refused(corner):
    with pytest.raises(ValueError, match="origin: "):
        robots.OccupancyGrid(SOLID, resolution=0.05, origin=(0.0, corner))
    assert robots.OccupancyGrid(SOLID, resolution=0.05, origin=(4_000.0, 0.0)).origin[0] == 4_000
    with pytest.raises(ValueError, match="centre: "):
        Disc(np.array([0.0, corner]), 2.0)
    with pytest.raises(ValueError, match="high: "):
        Box(np.array([0.0, corner]), np.array([9.0, corner + 5.0]))
