"""One filter on many devices: islands of particles that share only their total weight.

If the weights of the islands have become uneven, `IslandInteraction` redistributes the particles.
"""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Key, PyTree

from mpfjax.checks import Count, Share, checked
from mpfjax.filter import Filter
from mpfjax.mixture import ParticleMixture, single_component
from mpfjax.models.series import as_series, series_of
from mpfjax.moves.base import AbstractMove, Step
from mpfjax.operations.compiling import jit_on_wide_vectors, with_floats_traced
from mpfjax.operations.islands import (
    DEVICE_AXIS,
    ISLAND_AXIS,
    island_index,
    num_islands,
    over_islands,
)
from mpfjax.operations.logarithms import softmax
from mpfjax.running.devices import available_devices, over_devices
from mpfjax.running.diagnosis import sound
from mpfjax.running.results import FilterRun
from mpfjax.running.scan import scan


@checked
def run_islands(
    key: Key[Array, ""],
    filter: Filter,
    observations: PyTree,
    collect: Callable[[ParticleMixture], PyTree] | None = None,
    *,
    num_islands: Count,
    inputs: PyTree = None,
    missing: Literal["error", "skip"] = "error",
) -> FilterRun:
    """Run one filter of G islands, each a copy of `filter`, on many devices.

    The islands are parts of ONE mixture of G N particles in G M components. Every island draws its
    own x_0 and moves its own components. This is exact, because the weights are joint. Only the
    normalisation needs all islands: the total weight of a step is the sum of G weights, O(1)
    numbers from each island, for any N (Vermaak et al. 2003, section 2: components "interact only
    through the mixture weights"; Vergé et al. 2015 for islands). If the filter's marginal
    likelihood is unbiased, so is the result.

    - `observations`, `inputs`, `missing`: as for `run_filter`.
    - `filter`: the filter of one island, with its N and M. A standard particle filter makes islands
      of particles. With an `IslandInteraction` among the moves, their weights stay even.
    - `num_islands`: G. The largest number of devices that divides G shares them. The result depends
      on the key and on G, not on the devices. With another number of devices it differs by
      rounding; if rounding changes a draw, it differs like another run.
    - `collect(mixture)` receives one island, whose weights sum to its share. Its results are
      stacked over t and islands, (t, G, ...). The sum over islands of `expectation`, `mean` or
      `variance` is the value for the whole mixture.

    The result is that of `run_filter` on the whole mixture. Slots and component labels of island g
    come after those of island g - 1, ancestors may be on other islands, and only `memory` keeps a
    leading axis of islands. Errors are those of `run_filter`. Also raises `ValueError` for G < 1.
    Use it if one filter is too large or too slow for one device. For many runs of a filter that
    fits on one device, use `monte_carlo`.
    """
    series = as_series(series_of(observations, inputs, missing), filter.model)
    keys = jax.vmap(jax.random.fold_in, (None, 0))(key, jnp.arange(num_islands, dtype=jnp.uint32))

    def run(filter: Filter) -> FilterRun:
        devices = available_devices()
        most = max(d for d in range(1, len(devices) + 1) if num_islands % d == 0)
        arguments = (filter, series, collect)
        return over_devices(_run_block, _run_on_one, keys, arguments, devices[:most])

    return sound(_join(with_floats_traced(run, filter), collect is None))


def _run_block(keys, filter, series, collect):
    """The islands of one device."""
    return jax.vmap(lambda key: scan(key, filter, series, collect), axis_name=ISLAND_AXIS)(keys)


@jit_on_wide_vectors
def _run_on_one(keys, filter, series, collect):
    on_device = partial(_run_block, filter=filter, series=series, collect=collect)
    run = jax.vmap(on_device, axis_name=DEVICE_AXIS)(keys[None])
    return jax.tree.map(lambda leaf: leaf[0], run)


def _join(run: FilterRun, whole: bool) -> FilterRun:
    """The run of the whole mixture, from one whose every leaf has a leading axis of islands."""
    if whole:
        collected = jax.vmap(_whole_mixture, in_axes=1)(run.collected)
    else:
        collected = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, 1), run.collected)
    resampled = jnp.moveaxis(run.resampled, 0, 1)
    # All else is the same on each island.
    return dataclasses.replace(
        jax.tree.map(lambda leaf: leaf[0], run),
        collected=collected,
        initial=_whole_mixture(run.initial),
        final=_whole_mixture(run.final),
        resampled=resampled.reshape(resampled.shape[0], -1),
        effective_sample_size=1 / jnp.sum(1 / run.effective_sample_size, axis=0),
    )


def _whole_mixture(islands: ParticleMixture) -> ParticleMixture:
    """One mixture of the islands' particles, from fields with a leading axis of islands."""
    num_islands, num_components = islands.log_weights.shape[0], islands.num_components
    firsts = num_components * jnp.arange(num_islands, dtype=jnp.int32)

    def side_by_side(leaf: Array) -> Array:
        return leaf.reshape(-1, *leaf.shape[2:])

    particles = jax.tree.map(side_by_side, islands.particles)
    return single_component(particles, num_islands * num_components).replace(
        log_weights=side_by_side(islands.log_weights),
        component_indicators=side_by_side(islands.component_indicators + firsts[:, None]),
        ancestor_indices=side_by_side(islands.ancestor_indices),
        memory=islands.memory,
        t=islands.t[0],
        periods=jax.tree.map(lambda leaf: leaf[0], islands.periods),
    )


class IslandInteraction(AbstractMove):
    """Redistribute the particles over all islands if their weights have become uneven.

    It is for `run_islands`; elsewhere there is one island, and it does nothing. An island resamples
    within itself and keeps its weight. After some time a few islands have all the weight, and the
    computations of the others are wasted. The effective number of islands is (Σ π_g)² / Σ π_g²,
    where π_g is the weight of island g. If it falls below `threshold` times the number of islands
    G, particle i of every island moves to island i mod G, with its joint weight, component label
    and ancestor. All islands then have nearly the same weight. The move is exact: the whole mixture
    has the same particles, in other slots (Whiteley, Lee and Heine 2016, show when islands should
    interact).

    - `threshold`: in [0, 1]; 0 never exchanges.

    No other move sends particles between devices. This one sends all of them at once, but only in
    the steps that require it. Put it before `Resample`, which then distributes the heavy particles
    over the slots of all islands. In a mixture, put it before the moves that regroup, because
    components of the same label are joined. Raises `ValueError` for a threshold out of range, and
    if G does not divide the number of slots of an island.
    """

    threshold: Share = eqx.field(static=True, default=0.5)

    approximate = False
    biases_score = False
    weighs = False
    keeps_mass = True
    """the observation changes no weight."""

    keeps_parents = False
    """those of a particle that was dealt to an island are on another one."""

    def around(self, reference: Any) -> "IslandInteraction":
        """The move itself: on the one island of conditional SMC it does nothing."""
        return self

    def __call__(self, key: Key[Array, ""], mixture: ParticleMixture, now: Step) -> ParticleMixture:
        """Deal the particles if it is due, unless y_t is missing."""
        n, islands = mixture.num_particles, num_islands()
        if islands == 1 or now.is_missing:
            return mixture
        if n % islands:
            raise ValueError(f"num_particles: {n} of an island, for {islands} islands alike")
        weights = softmax(over_islands(mixture.log_mass))  # the same on each island
        is_uneven = 1 / jnp.sum(weights**2) < self.threshold * islands
        return jax.lax.cond(is_uneven, lambda: mixture.map_slots(_deal), lambda: mixture)


def _deal(values: Array) -> Array:
    """Row i of every island to island i mod G; the leading axis must be a multiple of G.

    A second call brings the rows of an island back to it, in another order.
    """
    num_devices, on_device = jax.lax.psum(1, DEVICE_AXIS), jax.lax.psum(1, ISLAND_AXIS)
    # Under vmap, JAX 0.10 gives a wrong shape to a value that is the same on all devices.
    values = jnp.where(island_index() >= 0, values, values)
    dealt = values.reshape(-1, num_devices, on_device, *values.shape[1:])
    dealt = jax.lax.all_to_all(dealt, ISLAND_AXIS, split_axis=2, concat_axis=2)
    dealt = jax.lax.all_to_all(dealt, DEVICE_AXIS, split_axis=1, concat_axis=1)
    return dealt.reshape(values.shape)
