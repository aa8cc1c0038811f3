"""Genealogies: the ancestors at earlier times of the particles at the end."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PyTree

from mpfjax.checks import check_numbered
from mpfjax.mixture import ParticleMixture
from mpfjax.operations.stored import count_places, take
from mpfjax.running.scan import FilterRun
from mpfjax.smoothing.history import mixtures_of, with_parents


class Genealogy(eqx.Module):
    """The ancestors of the particles at the end, at every time of a run.

    - `indices`: (t, n), the slot of each particle's ancestor; at the end its own.
    - `trajectories`: leaves (n, t, ...), the states of the ancestors: a genealogical trajectory has
      the weight of its particle in the final mixture.
    - `share_apart`: (m, t), the number of distinct ancestors of each component's particles, divided
      by the number of particles: 1 where all are distinct, 1/count where one is left, and zero for
      a dead component.
    """

    indices: Int[Array, "t n"]
    trajectories: PyTree
    share_apart: Float[Array, "m t"]


def trace_ancestors(mixtures: FilterRun | ParticleMixture) -> Genealogy:
    """Follow the ancestor indices of a run back from its end.

    `mixtures` is a run of `run_filter(..., collect=None)`, whose first time is then x_0, or the
    mixtures that it collected, whose first time is x_1. Raises `ValueError` for anything else, and
    where particles have no single ancestors (index -1; RuntimeError within jit). Use it to see how
    far back the history of a mode goes. Resampling leaves few ancestors at early
    times; `sample_trajectories` draws new ones.
    """
    return _trace(with_parents(mixtures_of(mixtures), "trace_ancestors"))


@eqx.filter_jit
def _trace(mixtures: ParticleMixture) -> Genealogy:
    final = jax.tree.map(lambda leaf: leaf[-1], mixtures)
    n, m = final.num_particles, final.num_components

    check_numbered("ancestors by component up to", (m + 1) * n, num_particles=n)

    def back(indices: Array, ancestors: Array) -> tuple[Array, Array]:
        return take(ancestors, indices), indices

    own = jnp.arange(n, dtype=jnp.int32)
    first, later = jax.lax.scan(back, own, mixtures.ancestor_indices[1:], reverse=True)
    indices = jnp.concatenate([first[None], later])
    counts = final.component_counts

    def num_ancestors(ancestors: Array) -> Array:
        # Empty slots are counted as a component of their own.
        labels = jnp.where(final.occupied, final.component_indicators, m)
        named = count_places(labels * n + ancestors, (m + 1) * n).reshape(m + 1, n)
        return jnp.sum(named[:m] > 0, axis=1, dtype=jnp.int32)

    apart = jax.lax.map(num_ancestors, indices).T
    share = apart / jnp.maximum(counts, 1)[:, None]
    trajectories = jax.tree.map(
        lambda leaf: jnp.moveaxis(jax.vmap(take)(leaf, indices), 0, 1), mixtures.particles
    )
    return Genealogy(indices, trajectories, share.astype(final.log_weights.dtype))
