"""The scenes: a model, what is observed, and the regions whose masses a filter is asked for."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

import mpfjax
from benchmarks.masses import models
from mpfjax.exact import grid_filter

GRID = jnp.linspace(-30.0, 30.0, 2401)


class Scene(NamedTuple):
    """A posterior with several modes.

    - `region`: which region each particle is in, (n,), at the end; there are `num_regions`.
    - `grouping`: the coordinates and units in which components are grouped.
    - `exact`: the masses, by a grid or symmetry, and log Z, None without a grid.
    - `truth`: the region that the observations come from.
    """

    model: Any
    observations: np.ndarray
    region: Callable[[PyTree], Array]
    max_components: int
    grouping: dict[str, Any]
    exact: tuple[np.ndarray, float | None]
    truth: int = 0
    num_regions: int = 2

    def masses(self, mixture: mpfjax.ParticleMixture) -> Array:
        """The mass of each region."""
        return mixture.expectation(jax.nn.one_hot(self.region(mixture.particles), self.num_regions))


def by_sign(states: Array) -> Array:
    """On which side of zero."""
    return (states > 0).astype(jnp.int32)


def of_grid(model: Any, observations: np.ndarray, grid: Array) -> tuple[np.ndarray, float]:
    """The exact masses of the two sides of zero, and log Z."""
    run = grid_filter(model, jnp.asarray(observations), grid)
    above = float(run.mass_above(0.0)[-1])
    return np.array([1 - above, above]), float(run.log_marginal_likelihood)


def corridor(num_steps: int, seed: int) -> Scene:
    """Four doors that look alike: four masses of a quarter."""
    model = models.Corridor()
    path, observations = model.simulate(num_steps, seed)
    return Scene(
        model, observations, lambda states: model.section(states, path[-1]), 8, {"scale": 1.0},
        exact=(np.full(4, 1 / 4), None), num_regions=4,
    )  # fmt: skip


def mirror(num_steps: int, seed: int) -> Scene:
    """Two halves in four dimensions, each the mirror image of the other."""
    model = models.Mirror()
    return Scene(
        model, model.simulate(num_steps, seed), lambda states: by_sign(states[:, 1]), 4,
        {"features": lambda states: states[:, :2], "scale": 1.0},
        exact=(np.array([0.5, 0.5]), None), truth=1,
    )  # fmt: skip


def jumps(num_steps: int, seed: int) -> Scene:
    """A target that jumps now and then: two sides, and which of them is settled by and by."""
    model = models.Jumps()
    path, observations = model.simulate(num_steps, seed + 4)
    exact = of_grid(model, observations, GRID)
    return Scene(
        model, observations, by_sign, 4, {"scale": 1.0}, exact=exact,
        truth=int(path[-1] > 0),
    )  # fmt: skip


# The scene, and its number of steps.
SCENES: dict[str, tuple[Callable[[int, int], Scene], int]] = {
    "corridor": (corridor, 80),
    "mirror": (mirror, 40),
    "jumps": (jumps, 40),
}
