"""Runs of every filter at every λ, on one scene after the other."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array

import mpfjax
from benchmarks.partitioned_sampling.rates import measure
from benchmarks.partitioned_sampling.scenes import Kept, Scene

Order = tuple[int, ...] | None
# A new filter is one more line: name -> (model, number of particles, order) -> filter.
METHODS: dict[str, Callable[[mpfjax.MultiObjectModel, int, Order], mpfjax.Filter]] = {
    "joint": lambda model, n, _: mpfjax.particle_filter(model, n),
    "ps": lambda model, n, order: mpfjax.partitioned_sampling(model, n, order),
    "dps": lambda model, n, _: mpfjax.distributed_partitioned_sampling(model, n),
    "dps_evidence": lambda model, n, _: mpfjax.distributed_partitioned_sampling(
        model, n, reassembly="evidence"
    ),
    "independent": lambda model, n, _: mpfjax.independent_particle_filters(model, n),
    "clusters": lambda model, n, _: mpfjax.clustered_particle_filter(model, n),
}
ORDERED = ("ps",)
SHOWN = ("joint", "ps", "dps")  # in figure 4 or 8 and in the animation
CYCLE = "cycle"  # a row of PS in an order that is no circular shift of the others
NUM_CYCLES = 20


class Row(NamedTuple):
    """All runs of one filter on one scene at one λ."""

    scene: int | str
    lambda_: float
    method: str
    order: Order
    kept: Kept  # leading axes runs, t; of the centres only two runs, see `shown`
    shown: dict[bool, int | None]  # a run that recovers, and one that does not


def circular_orders(num_objects: int) -> list[tuple[int, ...]]:
    """0, 1, ..., J-1 and its circular shifts."""
    return [tuple(np.roll(np.arange(num_objects), -s).tolist()) for s in range(num_objects)]


def other_cycles(num_objects: int, most: int = NUM_CYCLES) -> list[tuple[int, ...]]:
    """A sample of the (J-1)! - 1 cycles that are no circular shift of 0, ..., J-1, from 0 on."""
    rng, natural = np.random.default_rng(0), tuple(range(num_objects))
    others = int(np.prod(np.arange(1, num_objects), dtype=float)) - 1
    found: dict[tuple[int, ...], None] = {}
    while len(found) < min(most, others):
        order = (0, *(1 + rng.permutation(num_objects - 1)).tolist())
        if order != natural:
            found[order] = None
    return list(found)


def filters(
    scene: Scene, lambda_: float, num_particles: int, methods: Iterable[str]
) -> dict[tuple[str, Order], mpfjax.Filter]:
    """Every filter at one λ, PS once for each circular order."""
    model = scene.model_at(lambda_)
    return {
        (name, order): METHODS[name](model, num_particles, order)
        for name in methods
        for order in (circular_orders(scene.num_objects) if name in ORDERED else [None])
    }


def study(
    scene: Scene,
    number: int,
    lambdas: Sequence[float],
    num_particles: int,
    methods: Sequence[str],
    num_runs: int,
    seed: int,
    *,
    cycles: bool = False,
) -> Iterator[Row]:
    """All runs of every filter on the scene of this number, a row's under one vmap.

    Of the filters that are shown everything is kept at the first λ, and otherwise the boxes.
    With `cycles`, PS in other orders as well, at the first λ.
    """
    for lambda_ in lambdas:
        made = filters(scene, lambda_, num_particles, methods)
        if cycles and lambda_ == lambdas[0]:
            model = scene.model_at(lambda_)
            made |= {
                (CYCLE, order): METHODS["ps"](model, num_particles, order)
                for order in other_cycles(scene.num_objects)
            }
        for place, ((method, order), filter) in enumerate(made.items()):
            everything = lambda_ == lambdas[0] and method in SHOWN
            keys = row_keys(seed, number, lambda_, place, num_runs)
            run = mpfjax.monte_carlo(keys, filter, scene.observations, scene.collector(everything))
            kept = jax.tree.map(np.asarray, run.collected)
            yield _reduced(Row(scene.key, lambda_, method, order, kept, {}), scene)


def row_keys(seed: int, scene: int, lambda_: float, place: int, num_runs: int) -> Array:
    """Keys of one row's runs: no two rows have any in common, whatever other λ there are."""
    key = jax.random.fold_in(jax.random.key(seed), scene)
    key = jax.random.fold_in(key, round(1000 * lambda_))
    return jax.random.split(jax.random.fold_in(key, place), num_runs)


def _reduced(row: Row, scene: Scene) -> Row:
    """The particles of one run that recovers and of one that does not, and no others'."""
    if row.kept.centres is None:
        return row
    hard = [scene.hard]
    recovered = measure(row.kept.boxes[:, :, hard], scene.truth[:, hard]).recovered
    shown = {
        wanted: next((k for k, found in enumerate(recovered[:, 0]) if found == wanted), None)
        for wanted in (True, False)
    }
    runs = [0 if k is None else k for k in shown.values()]
    return row._replace(kept=row.kept._replace(centres=row.kept.centres[runs]), shown=shown)
