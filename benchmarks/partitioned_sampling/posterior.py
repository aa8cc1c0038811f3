"""Likelihoods read off a map, and the posterior of object 1 alone, by which scenes are judged.

Objects of the synthetic sequence do not change in size, so that a frame holds only as many
different likelihoods of an object as it has pixels. Worked out once a scene, they serve all
filters, runs, orders and λ, at a tenth of the cost. The scale, which would drift by one per cent
in 25 frames, is left at one.

The posterior is that before any filter of the study runs, by 20 000 particles. The exact one is
mostly back a frame or more before: when the distracter goes, nothing looks like object 1 but
itself, and the likelihood weighs up tails of 1e-20, which no number of particles reaches.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

import mpfjax
from benchmarks.partitioned_sampling.rates import NUM_LAST

JUDGED_AT, MOMENTUM = 20.0, 0.5  # λ, and the tracker's
BACK_FROM = 11  # the frame from which on it may be back
NUM_JUDGES = 20_000


class PlaceState(eqx.Module):
    """Where an object is, and was one frame before: the centre of its box, in pixels."""

    box: Float[Array, "*n 2"]
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
        return PlaceState(self.dynamics.sample(key, states.box, states.previous), states.box)

    def log_likelihood(
        self, observation: Float[Array, "rows columns"], states: PlaceState
    ) -> Float[Array, " n"]:
        """-λ d² of each box; of one outside the map, that of the map's border, where d² is P."""
        sides = self.sides[None]
        corners = jnp.ceil(states.box - 0.5 * sides - 0.5) + sides
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
    numbers = (jnp.asarray(value, float) for value in (sides, deviations, lambda_))
    size, steps, sharpness = numbers
    make = lambda start: MappedModel(start, size, steps, sharpness, one)  # noqa: E731
    objects = jax.vmap(make)(jnp.asarray(starts, float))
    return mpfjax.MultiObjectModel(objects, len(starts), per_object=True)


def mapped_boxes(model: mpfjax.MultiObjectModel, states: PlaceState) -> Float[Array, "n objects 4"]:
    """(x, y, w, h) of every object of every particle, as those of a `joint_colour_model`."""
    sizes = jnp.broadcast_to(model.object_model.sides, states.box.shape)  # pyright: ignore
    return jnp.concatenate([states.box - sizes / 2, sizes], axis=-1)


def distance_maps(
    bins: Int[np.ndarray, "h w"],
    references: Float[np.ndarray, "objects parts bins"],
    sides: tuple[int, int],
) -> Float[np.ndarray, "objects rows columns"]:
    """Σ over the bands of B² between each reference and the box at every place.

    Places are those from which a box reaches the frame, and one more on each side. `bins`: the
    colour of each pixel. Raises `ValueError` for a height that the bands do not share
    equally, where a band's rows would depend on the fraction of a pixel.
    """
    width, height = sides
    num_objects, num_parts, _ = references.shape
    if height % num_parts:
        raise ValueError(f"sides: {num_parts} bands of a height of {height} end within pixels")
    band = height // num_parts
    rows, columns = bins.shape[0] + height + 1, bins.shape[1] + width + 1
    # The pixels that the boxes hold, -1 outside the frame.
    padded = np.pad(bins, ((height, height), (width, width)), constant_values=-1)
    roots = np.sqrt(references).astype(np.float32)
    alike = np.zeros((num_objects, num_parts, len(padded) - band + 1, columns), np.float32)
    for colour in np.flatnonzero(roots.any(axis=(0, 1))):
        if not (padded == colour).any():
            continue
        counts = np.sqrt(_box_sums(padded == colour, band, width), dtype=np.float32)
        for j, part in np.argwhere(roots[:, :, colour]):
            alike[j, part] += roots[j, part, colour] * counts
    pixels = np.maximum(_box_sums(padded >= 0, band, width), 1).astype(np.float32)
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


# The first frame in which the posterior's mean box misses object 1, and the one from which on it is
# there again; None for never.
Verdict = tuple[int | None, int | None]


def judge(means: Float[np.ndarray, "t 2"], truth: Float[np.ndarray, "t 4"]) -> Verdict:
    """Where the mean box, as large as the true one, meets it: T of section 3.1."""
    centres = truth[:, :2] + truth[:, 2:] / 2
    lost = np.flatnonzero(np.any(np.abs(means - centres) >= truth[:, 2:], axis=1))
    if not len(lost):
        return None, None
    back = int(lost[-1]) + 2
    return int(lost[0]) + 1, back if back <= len(truth) else None


def keeps(verdict: Verdict, num_frames: int) -> bool:
    """Whether the scene is one: left, back not before frame 11, and there at the end."""
    _, back = verdict
    return back is not None and BACK_FROM <= back <= num_frames - NUM_LAST + 1


def particle_means(
    maps: Float[np.ndarray, "t 1 rows columns"],
    start: Float[np.ndarray, "2"],
    sides: tuple[int, int],
    deviations: tuple[float, float],
) -> Float[np.ndarray, "t 2"]:
    """E[x_t | y_1 ... y_t] by a particle filter of one object, from its maps of d²."""
    model = mapped_model(np.asarray(start)[None], sides, JUDGED_AT, MOMENTUM, deviations)
    filter = mpfjax.particle_filter(model, NUM_JUDGES)
    run = mpfjax.run_filter(jax.random.key(0), filter, jnp.asarray(maps), _mean_place)
    return np.asarray(run.collected)[:, 0]


def _mean_place(mixture: mpfjax.ParticleMixture):
    return mixture.expectation(mixture.particles.box)
