"""Runs of every filter at every λ, on one scene after the other."""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

import mpfjax
from benchmarks.partitioned_sampling.rates import measure
from benchmarks.partitioned_sampling.scenes import Scene
from benchmarks.tracking_quality import uniqueness

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
SHOWN = ("joint", "ps", "dps")  # in figure 4 or 8
CYCLE = "cycle"  # a row of PS in an order that is no circular shift of the others


class Collect(eqx.Module):
    """What is kept of every step: the mean boxes, and how poor the particles of an object are.

    The variance of each object's place is over its particles, whatever their weights: section 3.1
    measures how far the search reaches, and not the posterior.
    """

    model: mpfjax.MultiObjectModel
    boxes_of: Callable = eqx.field(static=True)
    everything: bool = eqx.field(static=True)

    def __call__(self, mixture: mpfjax.ParticleMixture) -> dict[str, Any]:
        """Of each object."""
        summary = {"boxes": mixture.expectation(self.boxes_of(self.model, mixture.particles))}
        if self.everything:
            summary["uniqueness"] = uniqueness(mixture.particles.box)
            summary["variance"] = jnp.var(mixture.particles.box[:, :, :2], axis=0)
        return summary


def circular_orders(num_objects: int) -> list[tuple[int, ...]]:
    """0, 1, ..., J-1 and its circular shifts."""
    return [tuple(np.roll(np.arange(num_objects), -s).tolist()) for s in range(num_objects)]


def other_cycles(num_objects: int, most: int = 20) -> list[tuple[int, ...]]:
    """A sample of the (J-1)! - 1 cycles that are no circular shift of 0, ..., J-1, from 0 on."""
    rng, natural = np.random.default_rng(0), tuple(range(num_objects))
    others = int(np.prod(np.arange(1, num_objects), dtype=float)) - 1
    orders: dict[tuple[int, ...], None] = {}
    while len(orders) < min(most, others):
        order = (0, *(1 + rng.permutation(num_objects - 1)).tolist())
        if order != natural:
            orders[order] = None
    return list(orders)


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
) -> list[dict[str, Any]]:
    """A row for every filter and λ on the scene of this number, its runs under one vmap.

    With `cycles`, PS in other orders as well, at the first λ. A row has the rates of each table.
    """
    rows = []
    for lambda_ in lambdas:
        model = scene.model_at(lambda_)
        circular = circular_orders(scene.truth.shape[1])
        chosen = [(name, order) for name in methods
                  for order in (circular if name == "ps" else [None])]  # fmt: skip
        if cycles and lambda_ == lambdas[0]:
            chosen += [(CYCLE, order) for order in other_cycles(scene.truth.shape[1])]
        # Numbers that do not fit come to light here, before anything compiles.
        filters = [METHODS["ps" if name == CYCLE else name](model, num_particles, order)
                for name, order in chosen]  # fmt: skip
        # No two rows have keys in common, whatever other λ there are.
        key = jax.random.fold_in(jax.random.key(seed), number)
        key = jax.random.fold_in(key, round(1000 * lambda_))
        bar = tqdm(filters, desc=f"{scene.name}, λ = {lambda_:g}", unit="row", disable=None)
        for place, filter in enumerate(bar):
            name, order = chosen[place]
            keys = jax.random.split(jax.random.fold_in(key, place), num_runs)
            everything = lambda_ == lambdas[0] and name in SHOWN
            collect = Collect(model, scene.boxes_of, everything)
            run = mpfjax.monte_carlo(keys, filter, scene.observations, collect)
            summary = jax.tree.map(np.asarray, run.collected)
            rows.append({
                "scene": scene.key, "lambda": lambda_, "method": name,
                "order": None if order is None else [j + 1 for j in order], "kept": summary,
                "rates": {
                    table: measure(summary["boxes"][:, :, objects], scene.truth[:, objects])
                    for table, objects in scene.tables.items()
                },
            })  # fmt: skip
    return rows
