"""The history of a run: its mixtures from x_0 to x_t, and the ancestors of its particles."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PyTree

from mpfjax.checks import checked
from mpfjax.memory import check_past
from mpfjax.mixture import MarginalisedState, ParticleMixture
from mpfjax.models.observations import refuse_where
from mpfjax.operations.stored import count_places, take
from mpfjax.running.results import FilterRun

NO_PAST = "a state that began anew steps before, as with restarts, has no past among the particles"


def mixtures_of(run: FilterRun | ParticleMixture) -> ParticleMixture:
    """The stacked mixtures of a run; with those of a whole `FilterRun` x_0 comes first.

    Raises `ValueError` for anything but a stack of mixtures, for a stack of several runs, and where
    states began anew (NaN within a caller's jit).
    """
    is_run = isinstance(run, FilterRun)
    mixtures = run.collected if is_run else run
    if not isinstance(mixtures, ParticleMixture) or mixtures.log_weights.ndim != 2:
        raise ValueError("mixtures: not those of a whole run; run the filter with collect=None")
    check_past(mixtures.memory)
    # Smoothing does not use the moves' memory, whose leaves may not stack.
    mixtures = jax.vmap(lambda mixture: mixture.replace(memory={}))(mixtures)
    began_anew = jax.vmap(lambda mixture: mixture.began_anew)(mixtures)
    began_anew &= mixtures.log_weights > -jnp.inf
    mixtures = refuse_where(jnp.any(began_anew), mixtures, f"mixtures: {NO_PAST}")
    if not is_run:
        return mixtures
    initial = run.initial.replace(memory={})
    return jax.tree.map(
        lambda first, rest: jnp.concatenate([first[None].astype(rest.dtype), rest]),
        initial,
        mixtures,
    )


def with_parents(mixtures: ParticleMixture, needed_by: str) -> ParticleMixture:
    """The mixtures; an error where a particle comes from no single one of the step before."""
    is_orphan = (mixtures.ancestor_indices < 0) & (mixtures.log_weights > -jnp.inf)
    what = "follows ancestors, and particles of index below 0 have no single one, as after restarts"
    return refuse_where(jnp.any(is_orphan[1:]), mixtures, f"mixtures: {needed_by} {what}")


def ancestors_of(particles: Int[Array, " k"], mixtures: ParticleMixture) -> Int[Array, "t k"]:
    """The slots of the ancestors of some particles of the last mixture, at every time."""

    def back(indices: Array, ancestors: Array) -> tuple[Array, Array]:
        return take(ancestors, indices), indices

    parents = mixtures.ancestor_indices[1:]
    first, later = jax.lax.scan(back, particles, parents, reverse=True)
    return jnp.concatenate([first[None], later])


def paths_through(mixtures: ParticleMixture, indices: Int[Array, "t k"]) -> PyTree:
    """The states in these slots, leaves (k, t, ...); latents of particles that carry moments."""

    def states(mixture: ParticleMixture, slots: Int[Array, " k"]) -> PyTree:
        states = mixture.particles
        states = states.latent if isinstance(states, MarginalisedState) else states
        return jax.tree.map(lambda leaf: take(leaf, slots), states)

    return jax.vmap(states, out_axes=1)(mixtures, indices)


class Genealogy(eqx.Module):
    """The ancestors of the final particles, at every time of a run.

    - `indices`: (t, n), the slot of each particle's ancestor; at the last time its own.
    - `trajectories`: leaves (n, t, ...), the states of the ancestors: a genealogical trajectory has
      the weight of its particle in the final mixture. For a conditionally linear model these are
      the latents, because the moments of an ancestor are filtering moments.
    - `share_apart`: (m, t), the number of distinct ancestors of each component's particles, divided
      by the number of particles: 1 if all are distinct, 1/count if one is left, and zero for an
      empty component.
    """

    indices: Int[Array, "t n"]
    trajectories: PyTree
    share_apart: Float[Array, "m t"]


@checked
def trace_ancestors(mixtures: FilterRun | ParticleMixture) -> Genealogy:
    """Trace the ancestor indices of a run back from its last step.

    `mixtures` is a run of `run_filter(..., collect=None)`, whose first time is then x_0, or the
    mixtures that it collected, whose first time is x_1. Raises `ValueError` for anything else, and
    if particles have no single ancestors, as after restarts (an index below 0; NaN within
    jit). Use it to see how far back the history of a mode reaches. Resampling leaves few ancestors
    at early times; `sample_trajectories` draws new ones.
    """
    return _trace(with_parents(mixtures_of(mixtures), "trace_ancestors"))


@eqx.filter_jit
def _trace(mixtures: ParticleMixture) -> Genealogy:
    final = jax.tree.map(lambda leaf: leaf[-1], mixtures)
    n, m = final.num_particles, final.num_components
    indices = ancestors_of(jnp.arange(n, dtype=jnp.int32), mixtures)

    def num_ancestors(ancestors: Array) -> Array:
        # Empty slots are counted as a component of their own.
        labels = jnp.where(final.occupied, final.component_indicators, m)
        named = count_places(labels * n + ancestors, (m + 1) * n).reshape(m + 1, n)
        return jnp.sum(named[:m] > 0, axis=1, dtype=jnp.int32)

    apart = jax.lax.map(num_ancestors, indices).T
    share = apart / jnp.maximum(final.component_counts, 1)[:, None]
    share = share.astype(final.log_weights.dtype)
    return Genealogy(indices, paths_through(mixtures, indices), share)
