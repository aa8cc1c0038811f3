"""What is compared: the plain filter, the mixture filter, and each option on top of it."""

from collections.abc import Callable
from typing import Any

import jax

import mpfjax
from benchmarks.masses.scenes import Scene
from mpfjax.smoothing import learn_lookahead

Make = Callable[[Scene, int], mpfjax.Filter]


def _plain(**options: Any) -> Make:
    return lambda scene, num_particles: mpfjax.particle_filter(
        scene.model, num_particles, **options
    )


def _auxiliary(**options: Any) -> Make:
    return lambda scene, num_particles: mpfjax.auxiliary_particle_filter(
        scene.model, num_particles, scene.lookahead, **options
    )


def _mixture(ahead: bool = False, **options: Any) -> Make:
    def make(scene: Scene, num_particles: int) -> mpfjax.Filter:
        lookahead = {"lookahead": scene.lookahead} if ahead else {}
        return mpfjax.mixture_particle_filter(
            scene.model, num_particles, scene.max_components,
            **scene.grouping, **lookahead, **options,
        )  # fmt: skip

    return make


def _pilot(scene: Scene, num_particles: int) -> mpfjax.Filter:
    """The mixture filter with independent noise and the look-ahead that point sets bring along."""
    return _mixture(lookahead=mpfjax.PilotLookahead(scene.model))(scene, num_particles)


def _tempered(scene: Scene, num_particles: int) -> mpfjax.Filter:
    """The mixture filter with a tempered propagation in place of its own."""
    plain = _mixture()(scene, num_particles)
    moves = [
        mpfjax.PropagateTempered(scene.model) if isinstance(move, mpfjax.Propagate) else move
        for move in plain.moves
    ]
    return mpfjax.Filter(
        scene.model, moves, num_particles, scene.max_components, initial_moves=plain.initial_moves
    )


def _learned(scene: Scene, num_particles: int) -> mpfjax.Filter:
    """The mixture filter, which knows the whole series from five earlier runs."""
    plain = _mixture()(scene, num_particles)
    return learn_lookahead(jax.random.key(0), plain, scene.observations, features=scene.features)


FILTERS: dict[str, Make] = {
    "PF": _plain(),
    "PF, rqmc": _plain(noise="rqmc"),
    "APF": _auxiliary(),
    "APF, rqmc": _auxiliary(noise="rqmc"),
    "MPF": _mixture(),
    "MPF, equal slots": _mixture(allocation="equal"),
    "MPF, rqmc": _mixture(noise="rqmc"),
    "MPF, rqmc, no look-ahead": _mixture(noise="rqmc", lookahead=None),
    "MPF, 4 draws": _mixture(num_draws=4),
    "MPF, rqmc, 4 draws": _mixture(noise="rqmc", num_draws=4),
    "MPF, look-ahead": _mixture(ahead=True),
    "MPF, rqmc, look-ahead": _mixture(ahead=True, noise="rqmc"),
    "MPF, pilot look-ahead": _pilot,
    "MPF, tempered": _tempered,
    "MPF, learned look-ahead": _learned,
}
