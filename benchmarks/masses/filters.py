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


def _auxiliary(scene: Scene, num_particles: int) -> mpfjax.Filter:
    return mpfjax.auxiliary_particle_filter(scene.model, num_particles, scene.lookahead)


def _mixture(**options: Any) -> Make:
    return lambda scene, num_particles: mpfjax.mixture_particle_filter(
        scene.model, num_particles, scene.max_components, **scene.grouping, **options
    )


def _changed(make: Make, *changes: Callable[[mpfjax.Filter], mpfjax.Filter]) -> Make:
    """The filters of another row after some changes, one after the other."""

    def changed(scene: Scene, num_particles: int) -> mpfjax.Filter:
        filter = make(scene, num_particles)
        for change in changes:
            filter = change(filter)
        return filter

    return changed


def _with_equal_slots(filter: mpfjax.Filter) -> mpfjax.Filter:
    return mpfjax.with_resampling(filter, mpfjax.Resample(allocation="equal"))


def _with_four_draws(filter: mpfjax.Filter) -> mpfjax.Filter:
    return mpfjax.with_proposals_per_particle(filter, 4)


def _ahead(make: Make) -> Make:
    """The filters of another row with the look-ahead of their scene."""
    return lambda scene, num_particles: mpfjax.with_lookahead(
        make(scene, num_particles), scene.lookahead
    )


def _tempered(scene: Scene, num_particles: int) -> mpfjax.Filter:
    """The mixture filter with a tempered propagation in place of its own."""
    plain = _mixture()(scene, num_particles)
    moves = [
        mpfjax.PropagateTempered(scene.model) if isinstance(move, mpfjax.Propagate) else move
        for move in plain.moves
    ]
    return plain.replace(moves=moves)


def _learned(scene: Scene, num_particles: int) -> mpfjax.Filter:
    """The mixture filter, which knows the whole series from five earlier runs."""
    plain = _mixture()(scene, num_particles)
    return learn_lookahead(jax.random.key(0), plain, scene.observations, features=scene.features)


FILTERS: dict[str, Make] = {
    "PF": _plain(),
    "PF, rqmc": _plain(noise="rqmc"),
    "APF": _auxiliary,
    "APF, rqmc": _changed(_auxiliary, mpfjax.with_point_sets),
    "MPF": _mixture(),
    "MPF, equal slots": _changed(_mixture(), _with_equal_slots),
    "MPF, rqmc": _mixture(noise="rqmc"),
    "MPF, rqmc, no look-ahead": _changed(_mixture(), mpfjax.with_point_sets),
    "MPF, 4 draws": _changed(_mixture(), _with_four_draws),
    "MPF, rqmc, 4 draws": _changed(_mixture(noise="rqmc"), _with_four_draws),
    "MPF, look-ahead": _ahead(_mixture()),
    "MPF, rqmc, look-ahead": _ahead(_mixture(noise="rqmc")),
    "MPF, pilot look-ahead": _changed(_mixture(), mpfjax.with_lookahead),
    "MPF, tempered": _tempered,
    "MPF, learned look-ahead": _learned,
}
