"""Likelihoods read off a map: every object's distance from its template, at every place.

Objects of the synthetic sequence do not change in size, so that a frame holds only as many
different likelihoods of an object as it has pixels. Worked out once a scene, they serve all
filters, runs, orders and λ, at a tenth of the cost. The scale, which would drift by one per cent
in 25 frames, is left at one.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

import mpfjax


class PlaceState(eqx.Module):
    """Where an object is, and was one frame before: the centre of its box, in pixels."""

    place: Float[Array, "*n 2"]
    previous: Float[Array, "*n 2"]


class MappedModel(mpfjax.AbstractStateSpaceModel):
    """An object of a `joint_colour_model` that does not change in size: L(y | x) ∝ exp(-λ d²).

    An observation is the object's map of d² summed over the bands, from `distance_maps`. The
    pixels in a box are those whose centres it holds, so that d² is constant between them, and
    reading it off the map is exact.

    - `start`: the place in the first frame, about which x_0 scatters as a step does.
    - `sides`: width and height, whole pixels.
    - `deviations`: of a step in x and y, in pixels.
    """

    start: Float[Array, "2"]
    sides: Float[Array, "2"]
    deviations: Float[Array, "2"]
    lambda_: Float[Array, ""]
    dynamics: mpfjax.Autoregression

    def sample_initial(self, key: Key[Array, ""], num_particles: int) -> PlaceState:
        """x_0 about the start, at rest."""
        noise = mpfjax.normal(key, (num_particles, 2))
        place = self.start[None] + self.deviations[None] * noise
        return PlaceState(place, place)

    def sample_transition(self, key: Key[Array, ""], states: PlaceState) -> PlaceState:
        """x_t given x_{t-1} and x_{t-2}."""
        return PlaceState(self.dynamics.sample(key, states.place, states.previous), states.place)

    def log_likelihood(
        self, observation: Float[Array, "rows columns"], states: PlaceState
    ) -> Float[Array, " n"]:
        """-λ d² of each box; of one outside the map, that of the map's border, where d² is P."""
        sides = self.sides[None]
        corners = jnp.ceil(states.place - 0.5 * sides - 0.5) + sides
        height, width = observation.shape
        # Bounded before it is an integer: a place may be anything.
        column = jnp.clip(corners[:, 0], 0, width - 1).astype(jnp.int32)
        row = jnp.clip(corners[:, 1], 0, height - 1).astype(jnp.int32)
        return -self.lambda_ * observation[row, column]


def mapped_model(
    starts: Float[np.ndarray, "objects 2"],
    sides: tuple[int, int],
    lambda_: float,
    momentum: float,
    deviations: tuple[float, float],
) -> mpfjax.MultiObjectModel:
    """All objects, each of which sees its own map."""
    one = mpfjax.Autoregression.with_momentum(momentum, jnp.asarray(deviations, float))
    each = lambda leaf: jnp.broadcast_to(leaf, (len(starts), *jnp.shape(leaf)))  # noqa: E731
    objects = MappedModel(
        jnp.asarray(starts, float),
        each(jnp.asarray(sides, float)),
        each(jnp.asarray(deviations, float)),
        each(jnp.asarray(lambda_, float)),
        jax.tree.map(each, one),
    )
    return mpfjax.MultiObjectModel(objects, len(starts), per_object=True)


class Window(NamedTuple):
    """The places of a map: a box's top row and left column, from the first to before the end."""

    top: int
    bottom: int
    left: int
    right: int

    @classmethod
    def whole(cls, bins: Int[np.ndarray, "h w"], sides: tuple[int, int]) -> "Window":
        """Every place from which a box reaches the frame, and one more on each side."""
        return cls(-sides[1], bins.shape[0] + 1, -sides[0], bins.shape[1] + 1)


def distance_maps(
    bins: Int[np.ndarray, "h w"],
    references: Float[np.ndarray, "objects parts bins"],
    sides: tuple[int, int],
    window: Window,
) -> Float[np.ndarray, "objects rows columns"]:
    """Σ over the bands of B² between each reference and the box at every place of a window.

    `bins`: the colour of each pixel. Raises `ValueError` for a height that the bands do not share
    equally, where a band's rows would depend on the fraction of a pixel.
    """
    width, height = sides
    num_objects, num_parts, _ = references.shape
    if height % num_parts:
        raise ValueError(f"sides: {num_parts} bands of a height of {height} end within pixels")
    band = height // num_parts
    rows, columns = window.bottom - window.top, window.right - window.left
    seen = np.full((rows + height - 1, columns + width - 1), -1)
    inside = [
        slice(max(start, 0), min(start + size, limit))
        for start, size, limit in zip(
            (window.top, window.left), seen.shape, bins.shape, strict=True
        )
    ]
    places = [
        slice(part.start - start, max(part.stop, part.start) - start)
        for part, start in zip(inside, (window.top, window.left), strict=True)
    ]
    seen[tuple(places)] = bins[tuple(inside)]
    roots = np.sqrt(references).astype(np.float32)
    alike = np.zeros((num_objects, num_parts, len(seen) - band + 1, columns), np.float32)
    for colour in np.flatnonzero(roots.any(axis=(0, 1))):
        if not (seen == colour).any():
            continue
        counts = np.sqrt(_box_sums(seen == colour, band, width), dtype=np.float32)
        for j, part in np.argwhere(roots[:, :, colour]):
            alike[j, part] += roots[j, part, colour] * counts
    pixels = np.maximum(_box_sums(seen >= 0, band, width), 1).astype(np.float32)
    alike /= np.sqrt(pixels)
    maps = np.full((num_objects, rows, columns), float(num_parts), np.float32)
    for part in range(num_parts):
        maps -= alike[:, part, part * band : part * band + rows]
    return np.maximum(maps, 0.0)


def _box_sums(chosen: np.ndarray, height: int, width: int) -> np.ndarray:
    """How many of the chosen pixels each box of this size holds, by its first row and column."""
    for axis, size in enumerate((height, width)):
        sums = np.cumsum(chosen, axis=axis, dtype=np.int32)
        sums = np.insert(sums, 0, 0, axis=axis)
        count = sums.shape[axis] - size
        chosen = np.take(sums, range(size, size + count), axis) - np.take(sums, range(count), axis)
    return chosen
