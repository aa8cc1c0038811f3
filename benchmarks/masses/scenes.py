"""The scenes: a model, what is observed, and the regions whose masses a filter is asked for."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

import mpfjax
from benchmarks.masses import bearings, corridor, jumps, look_alikes, mirror, terrain
from mpfjax.exact import grid_filter

GRID = jnp.linspace(-5.0, 5.0, 4001)
JUMP_GRID = jnp.linspace(-30.0, 30.0, 2401)


class Scene(NamedTuple):
    """A posterior with several modes.

    - `region`: which region each particle is in, (n,), at the end; there are `num_regions`.
    - `grouping`: the coordinates and units in which components are grouped.
    - `lookahead`: (y_t, states) -> log ν of each particle, for resampling ahead.
    - `exact`: the masses and log Z, where a grid or symmetry tells them; else None.
    - `features`: of a state, by which a look-ahead is learned; None is the state itself.
    - `truth`: the region that the observations come from.
    """

    model: mpfjax.AbstractStateSpaceModel
    observations: np.ndarray
    region: Callable[[PyTree], Array]
    num_regions: int
    max_components: int
    grouping: dict[str, Any]
    lookahead: Callable[[PyTree, PyTree], Array]
    exact: tuple[np.ndarray, float | None] | None = None
    features: Callable[[PyTree], Array] | None = None
    truth: int = 0


def flattened(model: Any, moved: Callable[[PyTree], PyTree]) -> Callable[[PyTree, PyTree], Array]:
    """The root of the likelihood of where a particle is expected: a look-ahead with long tails."""
    return lambda observation, states: 0.5 * model.log_likelihood(observation, moved(states))


def make_corridor(num_steps: int, seed: int) -> Scene:
    """Four doors that look alike: four masses of a quarter."""
    model = corridor.Corridor()
    path, observations = corridor.simulate(model, num_steps, seed)
    return Scene(
        model, observations,
        region=lambda states: corridor.section(model, states, path[-1]),
        num_regions=corridor.NUM_DOORS,
        max_components=8,
        grouping={"scale": 1.0},
        lookahead=flattened(model, lambda states: states + model.speed),
        exact=(np.full(corridor.NUM_DOORS, 1 / corridor.NUM_DOORS), None),
    )  # fmt: skip


def make_quadratic(num_steps: int, seed: int) -> Scene:
    """Section 5.1 of Vermaak et al. (2003), with independent draws of x_0; two masses of a half."""
    rng = np.random.default_rng(seed)
    model = mpfjax.QuadraticModel(initial_draw="independent")
    path = 2 * np.sin(2 * np.pi * np.arange(1, num_steps + 1) / 100)
    observations = (path**2 + 0.1 * rng.normal(size=num_steps)).astype(np.float32)
    grid = grid_filter(model, jnp.asarray(observations), GRID)
    above = float(grid.mass_above(0.0)[-1])
    return Scene(
        model, observations,
        region=lambda states: (states > 0).astype(jnp.int32),
        num_regions=2,
        max_components=2,
        grouping={},
        lookahead=flattened(model, lambda states: states),
        exact=(np.array([1 - above, above]), float(grid.log_marginal_likelihood)),
        truth=int(path[-1] > 0),
    )  # fmt: skip


def make_bearings(num_steps: int, seed: int) -> Scene:
    """A target on either side of two lines of hydrophones."""
    model = bearings.BearingsModel()
    return Scene(
        model, bearings.observations(num_steps, seed),
        region=bearings.is_above,
        num_regions=2,
        max_components=4,
        grouping={"features": bearings.position, "scale": 4.0},
        lookahead=flattened(model, model.transition_mean),
        features=bearings.motion_and_turn,
        truth=1,
    )  # fmt: skip


def make_mirror(num_steps: int, seed: int) -> Scene:
    """Two halves in four dimensions, each the mirror image of the other."""
    model = mirror.MirrorModel()
    return Scene(
        model, mirror.simulate(model, num_steps, seed),
        region=lambda states: (states[:, 1] > 0).astype(jnp.int32),
        num_regions=2,
        max_components=4,
        grouping={"features": lambda states: states[:, :2], "scale": 1.0},
        lookahead=flattened(model, model.transition_mean),
        exact=(np.array([0.5, 0.5]), None),
        truth=1,
    )  # fmt: skip


def make_terrain(num_steps: int, seed: int) -> Scene:
    """A flight over hills: many modes, one of them near the vehicle."""
    model = terrain.make_landscape(seed + 3)
    path, observations = terrain.simulate(model, num_steps, seed + 3)
    place = jnp.asarray(path[-1])
    return Scene(
        model, observations,
        region=lambda states: terrain.is_near(states, place),
        num_regions=2,
        max_components=8,
        grouping={"scale": 1.0},
        lookahead=flattened(model, lambda states: states + model.velocity[None]),
        truth=1,
    )  # fmt: skip


def make_jumps(num_steps: int, seed: int) -> Scene:
    """A target that jumps now and then: two sides, and which of them is settled by and by."""
    model = jumps.JumpModel()
    path, observations = jumps.simulate(model, num_steps, seed + 4)
    grid = grid_filter(model, jnp.asarray(observations), JUMP_GRID)
    above = float(grid.mass_above(0.0)[-1])
    return Scene(
        model, observations,
        region=lambda states: (states > 0).astype(jnp.int32),
        num_regions=2,
        max_components=4,
        grouping={"scale": 1.0},
        lookahead=flattened(model, lambda states: states),
        exact=(np.array([1 - above, above]), float(grid.log_marginal_likelihood)),
        truth=int(path[-1] > 0),
    )  # fmt: skip


def make_look_alikes(num_steps: int, seed: int) -> Scene:
    """Two players in the same kit."""
    scene = look_alikes.LookAlikes(num_steps, seed + 1)
    return Scene(
        scene.model, scene.observations,
        region=scene.nearest,
        num_regions=2,
        max_components=4,
        grouping={"features": look_alikes.place, "scale": 20.0},
        lookahead=flattened(scene.model, lambda states: states),
    )  # fmt: skip


# The scene, and its number of steps.
SCENES: dict[str, tuple[Callable[[int, int], Scene], int]] = {
    "corridor": (make_corridor, 80),
    "quadratic": (make_quadratic, 100),
    "bearings": (make_bearings, 40),
    "mirror": (make_mirror, 40),
    "terrain": (make_terrain, 30),
    "jumps": (make_jumps, 40),
    "look-alikes": (make_look_alikes, 30),
}


def masses(scene: Scene, mixture: mpfjax.ParticleMixture) -> Array:
    """The mass of each region."""
    return mixture.average(jax.nn.one_hot(scene.region(mixture.particles), scene.num_regions))
