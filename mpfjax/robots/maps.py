"""Occupancy grids: cells, distances to walls, ranges along rays, and maps in files."""

from pathlib import Path
from typing import Annotated, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Shaped
from scipy.ndimage import binary_erosion, distance_transform_edt

from mpfjax.arrays import FINITE, Fitting, check_spacing, to_numbers
from mpfjax.checks import Positive, checked, optional, warn
from mpfjax.models.base import replace_fields
from mpfjax.operations.stored import stored

Poses = Float[Array, "n 3"]
Angles = Float[Array, " b"]
Beams = Float[Array, "n b"]
Cells = Shaped[Array, "rows columns"]

_UNKNOWN = 205  # the grey that map savers write for unknown cells
_TRUE = ("1", "true", "yes")
_CHOICES = {"mode": ("trinary", "scale"), "negate": ("0", "false", "no", *_TRUE)}


class OccupancyGrid(Fitting):
    """A map of cells, each of which is occupied, free or unknown.

    - `occupied`: (rows, columns), from the lowest y up. At least one cell is.
    - `free`: of the same shape; a cell that is neither is unknown, and one that is both occupied.
      None means all cells that are not occupied.
    - `resolution`: the side of a cell in metres.
    - `origin`: (x, y) of the lower left corner of the cell [0, 0].

    `distances` are metres from the centre of each cell to the centre of the nearest occupied cell
    at the edge of a block of them, so that a beam that ends deep inside a block is far from what it
    may have hit. Raises `ValueError` for arrays that do not agree, a map without walls, and an
    origin so far away that float32 cannot resolve the cells. Use `read_map` for a map in a file.
    """

    occupied: Bool[Array, "rows columns"]
    free: Bool[Array, "rows columns"]
    distances: Float[Array, "rows columns"]
    table: Float[Array, "rows columns angles"] | None
    resolution: Positive = eqx.field(static=True)
    origin: Annotated[tuple[float, ...], FINITE] = eqx.field(static=True)

    def __init__(
        self, occupied: Any, free: Any = None, *, resolution: float, origin: Any = (0.0, 0.0)
    ) -> None:
        walls = np.asarray(occupied, bool)
        if not walls.any():
            raise ValueError("occupied: no cell is, so that nothing is at a distance")
        self.occupied = jnp.asarray(walls)
        self.free = ~self.occupied if free is None else jnp.asarray(free, bool) & ~self.occupied
        self.resolution, self.table = resolution, None
        self.origin = to_numbers("origin")(origin)[:2]
        far = np.add(self.origin, resolution * np.array(walls.shape[::-1]))
        check_spacing("origin", np.stack([self.origin, far]), resolution, "the side of a cell is")
        edges = walls & ~np.asarray(binary_erosion(walls, np.ones((3, 3))), bool)
        self.distances = jnp.asarray(resolution * np.asarray(distance_transform_edt(~edges)), float)

    def cells(self, places: Float[Array, "*n 2"]) -> tuple[Array, Array, Array]:
        """Row and column of each position, or of the nearest cell, and whether it is on the map."""
        shares = ((places[..., k] - self.origin[k]) / self.resolution for k in (1, 0))
        return self._clip(*(jnp.floor(share).astype(jnp.int32) for share in shares))

    def _clip(self, rows: Array, columns: Array) -> tuple[Array, Array, Array]:
        height, width = self.occupied.shape
        inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
        return jnp.clip(rows, 0, height - 1), jnp.clip(columns, 0, width - 1), inside

    def at(self, places: Float[Array, "*n 2"], values: Cells, outside: Any) -> Shaped[Array, "*n"]:
        """The value of the cell of each position, such as of `grid.free`, or another off it."""
        rows, columns, inside = self.cells(places)
        return jnp.where(inside, values[rows, columns], outside)

    def ranges(self, poses: Poses, angles: Angles, max_range: float) -> Beams:
        """Metres from each pose to the border of the first occupied cell along each angle.

        At most `max_range`; zero from within an occupied cell. The angles are relative to the
        heading. A ray proceeds from border to border of the cells on its path (Amanatides and Woo
        1987), so that it passes through no wall, not even between two cells that share a corner; if
        all walls are far, it advances by the field of distances (sphere tracing: Hart 1996).
        Unknown cells do not stop it, and there are no walls beyond the map. With a table, see
        `tabulated`, a range is looked up.
        """
        if self.table is not None:
            return self._look_up(poses, angles, max_range)
        # The loop has no derivative in reverse, and a range none that is of use.
        poses, limit = jax.lax.stop_gradient(poses), max_range / self.resolution
        safe = jnp.where(self.occupied, -1.0, self.distances / self.resolution)
        # From anywhere in a cell to anywhere in another is a diagonal less than between centres;
        # and a part of a cell for what is rounded.
        margin = np.sqrt(2) + 0.01
        headings = poses[:, 2:] + angles[None]
        axes = []
        for k, way in ((0, jnp.cos(headings)), (1, jnp.sin(headings))):
            place = (poses[:, k, None] - self.origin[k]) / self.resolution
            start = jnp.broadcast_to(place, way.shape)
            # To the first border, and between borders, along the ray.
            between = jnp.where(way == 0, jnp.inf, 1 / jnp.where(way == 0, 1.0, jnp.abs(way)))
            axes.append((start, way, between, jnp.where(way > 0, 1.0, 0.0)))

        def border(axis: tuple[Array, ...], cell: Array) -> Array:
            start, way, between, ahead = axis
            gap = (cell + ahead - start) * jnp.where(way > 0, 1.0, -1.0)
            return jnp.where(way == 0, jnp.inf, gap * between)

        def advance(carry: tuple[Array, ...]) -> tuple[Array, ...]:
            reach, x, y, going = carry
            rows, columns, inside = self._clip(y.astype(jnp.int32), x.astype(jnp.int32))
            gaps = jnp.where(inside, safe[rows, columns], jnp.inf)
            of_x, of_y = border(axes[0], x), border(axes[1], y)
            nearest = jnp.maximum(jnp.minimum(of_x, of_y), reach)
            far = jnp.minimum(reach + gaps - margin, limit)
            leaps, going = far > nearest, going & (gaps >= 0) & (reach < limit)
            moved = []
            for axis, cell, is_next in ((axes[0], x, of_x <= of_y), (axes[1], y, of_y < of_x)):
                start, way, _, ahead = axis
                stepped = cell + jnp.where(is_next, 2 * ahead - 1, 0.0)
                landed = jnp.where(leaps, jnp.floor(start + far * way), stepped)
                moved.append(jnp.where(going, landed, cell))
            return jnp.where(going, jnp.where(leaps, far, nearest), reach), *moved, going

        first = [jnp.floor(start) for start, *_ in axes]
        carry = jnp.zeros_like(headings), *first, jnp.ones(headings.shape, bool)
        reach = jax.lax.while_loop(lambda carry: jnp.any(carry[-1]), advance, carry)[0]
        return self.resolution * jnp.minimum(reach, limit)

    def tabulated(self, num_angles: int) -> "OccupancyGrid":
        """The map with a table of ranges from each cell's centre at several angles, for `ranges`.

        It has rows · columns · num_angles numbers. A range is the tabulated one along the nearest
        angle from the cell's centre, minus the distance of the position ahead of the centre. It is
        approximate: on a map of cells of 5 cm with thin pillars, half of the errors with 120 angles
        are below 1 cm, but six in a hundred beams of up to 3.5 m are off by more than 10 cm, at the
        edges of what they hit or miss, and the mean error is 7 cm (5.5 cm with 240 angles). Use it
        with a `BeamModel`, whose `z_rand` and `z_short` allow for such beams; its step then takes a
        small part of the time.
        """
        angles = jnp.arange(num_angles, dtype=float) * (2 * np.pi / num_angles)
        rows, columns = self.resolution * (np.indices(self.occupied.shape) + 0.5)
        x, y = self.origin[0] + columns, self.origin[1] + rows
        poses = jnp.asarray(np.stack([x, y, 0 * x], axis=-1), float)
        farthest = self.resolution * sum(self.occupied.shape)
        ranges = jax.lax.map(lambda row: self.ranges(row, angles, farthest), poses)
        return replace_fields(self, table=jnp.where(ranges < farthest, ranges, jnp.inf))

    def _look_up(self, poses: Poses, angles: Angles, max_range: float) -> Beams:
        table = self.table
        assert table is not None
        rows, columns, _ = self.cells(poses[:, None, :2])
        turn = 2 * np.pi / table.shape[2]
        nearest = jnp.round((poses[:, 2:] + angles[None]) / turn).astype(jnp.int32) % table.shape[2]
        ways = turn * jnp.arange(table.shape[2], dtype=poses.dtype)
        cos, sin = (stored(way(ways))[nearest] for way in (jnp.cos, jnp.sin))
        centres = (self.resolution * (cells.astype(poses.dtype) + 0.5) for cells in (columns, rows))
        x, y = (poses[:, None, k] - self.origin[k] - centre for k, centre in enumerate(centres))
        return jnp.clip(table[rows, columns, nearest] - (cos * x + sin * y), 0.0, max_range)


def ends_of(poses: Poses, angles: Angles, ranges: Float[Array, "#n b"]) -> Float[Array, "n b 2"]:
    """Where beams of these ranges end."""
    # Stored, since XLA would compute them again for every beam.
    cos, sin = (stored(way(poses[:, 2]))[:, None] for way in (jnp.cos, jnp.sin))
    ahead, across = (stored(ranges * way(angles)[None]) for way in (jnp.cos, jnp.sin))
    x, y = cos * ahead - sin * across, sin * ahead + cos * across
    return poses[:, None, :2] + jnp.stack([x, y], axis=-1)


@checked
def read_map(path: str | Path, *, resolution: Positive | None = None) -> OccupancyGrid:
    """The map in ROS's `map.yaml`, with the image that it names, or in an image alone.

    A pixel of value v in 0..255, the mean of its colours, is occupied with p = (255 - v) / 255, or
    v / 255 if the file has `negate`. Its cell is occupied if p > `occupied_thresh`, free if p <
    `free_thresh`, by default .65 and .196, and unknown between and if the pixel is transparent.
    Images of 16 bits are read as of eight. An image alone needs `resolution`, metres per pixel, and
    its lower left corner is the origin.

    A `RuntimeWarning` reports a `free_thresh`, such as .25, that makes the grey free that map
    savers write for unknown cells, which happens in ROS as well. Raises `ImportError` without
    Pillow and PyYAML, which the extra `robots` installs, and `ValueError` for a mode other than
    trinary and scale, an origin that is rotated, an entry that is not a number, and a missing
    resolution. Use it with maps of `slam_toolbox` or `map_saver`, and with a drawn plan.
    """
    from mpfjax.vision.files.frames import read_image

    entries: dict[str, Any] = {
        "image": path, "mode": "trinary", "resolution": resolution, "origin": (0.0, 0.0),
        "negate": False, "occupied_thresh": 0.65, "free_thresh": 0.196,
    }  # fmt: skip
    if Path(path).suffix in (".yaml", ".yml"):
        entries |= optional("yaml", "pyyaml").safe_load(Path(path).read_text("utf-8"))
    for name, choices in _CHOICES.items():
        if str(entries[name]).lower() not in choices:
            raise ValueError(f"{name}: {entries[name]!r} of {path} is none of {', '.join(choices)}")
    if entries["resolution"] is None:
        raise ValueError(f"resolution: {path} does not say the side of a pixel in metres")
    negated = str(entries["negate"]).lower() in _TRUE
    names = ("resolution", "occupied_thresh", "free_thresh")
    side, walls_from, free_to = (_number(name, entries[name], path) for name in names)
    origin = tuple(_number("origin", value, path) for value in entries["origin"])
    if any(origin[2:]):
        raise ValueError(f"origin: {entries['origin']} of {path} is turned; turn the image instead")
    # From the lowest row up: an image begins at the top.
    pixels = read_image(Path(path).parent / entries["image"], "RGBA")[::-1]
    grey, opaque = pixels[..., :3].mean(axis=-1), pixels[..., 3] == 255
    probabilities = (grey if negated else 255 - grey) / 255
    occupied = opaque & (probabilities > walls_from)
    free = opaque & (probabilities < free_to)
    unknown = 255 - _UNKNOWN if negated else _UNKNOWN
    if number := int(np.sum(free & (grey == unknown))):
        grey_of = f"{number} pixels of {unknown}, which map savers write for unknown cells"
        warn(f"free_thresh: {free_to:g} of {path} makes {grey_of}, free; .196 does not")
    return OccupancyGrid(occupied, free, resolution=side, origin=origin)


def _number(name: str, value: Any, path: Any) -> float:
    """An entry of a file; YAML reads numbers such as 5e-2 as text."""
    try:
        return float(value)
    except (TypeError, ValueError):
        raise ValueError(f"{name}: {value!r} of {path} is no number") from None
