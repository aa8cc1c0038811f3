"""What is compared: the plain filter, the mixture filter, and each option on top of it."""

from collections.abc import Callable
from functools import partial
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


def _mixture(**options: Any) -> Make:
    return lambda scene, num_particles: mpfjax.mixture_particle_filter(
        scene.model, num_particles, scene.max_components, **scene.grouping, **options
    )


def _change(make: Make, change: Callable[[mpfjax.Filter], mpfjax.Filter]) -> Make:
    """The filters of another row after a change."""
    return lambda scene, num_particles: change(make(scene, num_particles))


def _learn(scene: Scene, num_particles: int) -> mpfjax.Filter:
    """The mixture filter, which knows the whole series from five earlier runs."""
    plain = _mixture()(scene, num_particles)
    return learn_lookahead(jax.random.key(0), plain, scene.observations)


_EQUAL_SLOTS = partial(mpfjax.with_resampling, resample=mpfjax.Resample(allocation="equal"))
_FOUR_DRAWS = partial(mpfjax.with_proposals_per_particle, num_draws=4)

FILTERS: dict[str, Make] = {
    "PF": _plain(),
    "PF, rqmc": _plain(noise="rqmc"),
    "MPF": _mixture(),
    "MPF, equal slots": _change(_mixture(), _EQUAL_SLOTS),
    "MPF, rqmc": _mixture(noise="rqmc"),
    "MPF, rqmc, no look-ahead": _change(_mixture(), mpfjax.with_quasi_monte_carlo),
    "MPF, 4 draws": _change(_mixture(), _FOUR_DRAWS),
    "MPF, rqmc, 4 draws": _change(_mixture(noise="rqmc"), _FOUR_DRAWS),
    "MPF, learned look-ahead": _learn,
}
