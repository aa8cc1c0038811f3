"""The filtering distribution of object 1 alone, by which scenes are judged before any filter runs.

Twice: by 20 000 particles, whose verdict decides, and exactly, on a lattice of places and
velocities (Kitagawa 1987), whole pixels against a step's deviation of two; the likelihood is
constant between pixels. The exact one is mostly back a frame or more before the particles: when
the distracter goes, nothing looks like object 1 but itself, and the likelihood weighs up tails
of 1e-20, which no number of particles reaches.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

import mpfjax
from benchmarks.partitioned_sampling.maps import Window, distance_maps, mapped_model
from benchmarks.partitioned_sampling.rates import NUM_LAST

_FASTEST = 14  # pixels a frame and axis
# Rows and columns of the lattice with less are dropped.
_LEAST_MASS = 1e-24
_TOTAL, _NOTHING = 1e30, 1e-36  # of all mass, and of a cell: within the range of 32 bits
JUDGED_AT = 20.0  # λ
BACK_FROM = 11  # the frame from which on it may be back
NUM_JUDGES = 20_000


class Verdict(NamedTuple):
    """What the posterior of object 1 does, frames counted from 1.

    - `left`: the first frame in which its mean box misses object 1, or None.
    - `back`: the frame from which on it is on object 1 again, or None.
    """

    left: int | None
    back: int | None
    num_frames: int

    @property
    def keeps(self) -> bool:
        """Whether the scene is one: left, back not before frame 11, and there at the end."""
        if self.left is None or self.back is None:
            return False
        return BACK_FROM <= self.back <= self.num_frames - NUM_LAST + 1


def particle_means(
    maps: Float[np.ndarray, "t rows columns"],
    start: Float[np.ndarray, "2"],
    sides: tuple[int, int],
    deviations: tuple[float, float],
    momentum: float = 0.5,
) -> Float[np.ndarray, "t 2"]:
    """E[x_t | y_1 ... y_t] by a particle filter of one object, from its maps of d²."""
    model = mapped_model(np.asarray(start)[None], sides, JUDGED_AT, momentum, deviations)
    filter = mpfjax.particle_filter(model, NUM_JUDGES)
    observations = jnp.asarray(maps)[:, None]
    run = mpfjax.run_filter(jax.random.key(0), filter, observations, _mean_place)
    return np.asarray(run.collected)[:, 0]


def _mean_place(mixture: mpfjax.ParticleMixture):
    return mixture.average(mixture.particles.place)


def posterior_means(
    bins: Int[np.ndarray, "t h w"],
    reference: Float[np.ndarray, "parts bins"],
    start: Float[np.ndarray, "2"],
    sides: tuple[int, int],
    *,
    lambda_: float = JUDGED_AT,
    momentum: float = 0.5,
    deviation: float = 2.0,
) -> Float[np.ndarray, "t 2"]:
    """E[x_t | y_1 ... y_t] exactly, of the centre of the box of an object that starts at `start`.

    p(x, v) is kept for whole corners x and velocities v = x_t - x_{t-1}; it becomes
    L(x) Σ_v' N(v; momentum v', deviation²) p(x - v, v').
    """
    velocities = np.arange(-_FASTEST, _FASTEST + 1)
    noise = velocities[:, None] - momentum * velocities[None]
    kernel = np.exp(-0.5 * (noise / deviation) ** 2)
    kernel = _rounded(kernel / kernel.sum(axis=0))
    corner = np.round(np.asarray(start) - np.array(sides) / 2).astype(int)
    spread = np.exp(-0.5 * (velocities / deviation) ** 2)
    mass = np.zeros((len(velocities),) * 4, np.float32)  # of row, column, their velocities
    mass[:, :, _FASTEST, _FASTEST] = np.outer(spread, spread) * (_TOTAL / spread.sum() ** 2)
    top, left = corner[1] - _FASTEST, corner[0] - _FASTEST
    means = []
    for frame in bins:
        mass = _moved(kernel @ mass @ kernel.T)
        top, left = top - _FASTEST, left - _FASTEST
        window = Window(top, top + mass.shape[0], left, left + mass.shape[1])
        distances = distance_maps(frame, reference[None], sides, window)[0]
        mass *= np.exp(-lambda_ * (distances - distances.min()), dtype=np.float32)[:, :, None, None]
        places = mass.sum(axis=(2, 3), dtype=float)
        total = places.sum()
        places /= total
        rows, columns = top + np.arange(len(places)), left + np.arange(places.shape[1])
        mean = np.array([places.sum(axis=0) @ columns, places.sum(axis=1) @ rows])
        means.append(mean + np.array(sides) / 2)
        first, last = _held(places.sum(axis=1))
        begin, end = _held(places.sum(axis=0))
        mass = _rounded(mass[first:last, begin:end] * np.float32(_TOTAL / total))
        top, left = top + first, left + begin
    return np.array(means)


def judge(means: Float[np.ndarray, "t 2"], truth: Float[np.ndarray, "t 4"]) -> Verdict:
    """Where the mean box, as large as the true one, meets it: T of section 3.1."""
    centres = truth[:, :2] + truth[:, 2:] / 2
    tracked = np.all(np.abs(means - centres) < truth[:, 2:], axis=1)
    lost = np.flatnonzero(~tracked)
    if not len(lost):
        return Verdict(None, None, len(truth))
    back = int(lost[-1]) + 2
    return Verdict(int(lost[0]) + 1, back if back <= len(truth) else None, len(truth))


def _moved(mass: np.ndarray) -> np.ndarray:
    """p(x - v, v) on a lattice that reaches farther by the largest velocity on every side."""
    rows, columns, speeds, _ = mass.shape
    down = np.zeros((rows + speeds - 1, columns, speeds, speeds), mass.dtype)
    for v in range(speeds):
        down[v : v + rows, :, v] = mass[:, :, v]
    across = np.zeros((rows + speeds - 1, columns + speeds - 1, speeds, speeds), mass.dtype)
    for v in range(speeds):
        across[:, v : v + columns, :, v] = down[:, :, :, v]
    return across


def _rounded(values: np.ndarray) -> np.ndarray:
    """In 32 bits, without the numbers that are too small for them to be fast."""
    return np.where(values > _NOTHING, values, 0).astype(np.float32)


def _held(masses: np.ndarray) -> tuple[int, int]:
    held = np.flatnonzero(masses > _LEAST_MASS)
    return int(held[0]), int(held[-1]) + 1
