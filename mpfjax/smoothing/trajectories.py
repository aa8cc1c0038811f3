"""Whole trajectories of a run: the genealogy of its particles, and backward sampling."""

import dataclasses
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int, Key, PyTree

from mpfjax.checks import Count, CountOrZero, checked, warn
from mpfjax.filter import Filter
from mpfjax.memory import check_past
from mpfjax.mixture import MarginalisedState, ParticleMixture
from mpfjax.models.base import AbstractStateSpaceModel, require, with_inputs
from mpfjax.models.conditionally_linear import is_marginalised, is_mixed
from mpfjax.models.observations import refuse_where
from mpfjax.models.series import as_series, series_of, steps_of_inputs, with_gaps
from mpfjax.operations.compiling import jit_on_wide_vectors
from mpfjax.operations.random import split
from mpfjax.operations.stored import count_places, take
from mpfjax.running.results import FilterRun, after_first, append_last
from mpfjax.smoothing import backward
from mpfjax.smoothing.marginalised import check_marginalised, sample_marginalised

NO_PAST = "a state that began anew steps before, as with restarts, has no past among the particles"
# Below this share of distinct states estimates of the past are poor, however many are drawn.
_SMALL_SHARE = 0.1


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
    return after_first(run.initial.replace(memory={}), mixtures)


def with_parents(mixtures: ParticleMixture, needed_by: str) -> ParticleMixture:
    """The mixtures; an error where a particle comes from no single one of the step before."""
    is_orphan = (mixtures.ancestor_indices < 0) & (mixtures.log_weights > -jnp.inf)
    what = "follows ancestors, and particles of index below 0 have no single one, as after restarts"
    return refuse_where(jnp.any(is_orphan[1:]), mixtures, f"mixtures: {needed_by} {what}")


def ancestors_of(particles: Int[Array, " k"], mixtures: ParticleMixture) -> Int[Array, "t k"]:
    """The slots of the ancestors of some particles of the last mixture, at every time."""

    def back(indices: Array, ancestors: Array) -> tuple[Array, Array]:
        return take(ancestors, indices), indices

    first, later = jax.lax.scan(back, particles, mixtures.ancestor_indices[1:], reverse=True)
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
    paths = paths_through(mixtures, indices)
    return Genealogy(indices, paths, share.astype(final.log_weights.dtype))


@checked
def sample_trajectories(
    key: Key[Array, ""],
    filter: Filter | AbstractStateSpaceModel,
    mixtures: FilterRun | ParticleMixture,
    num_trajectories: Count,
    *,
    component: CountOrZero | None = None,
    method: Literal["exact", "mcmc"] = "exact",
    inputs: PyTree = None,
    observations: PyTree = None,
) -> PyTree:
    """Draw trajectories x_0, ..., x_t from their smoothing distribution p(x_0, ..., x_t | y).

    Backward sampling (Godsill, Doucet and West 2004): x_t is drawn by the weights of the last
    mixture, then each x_{s} by W_s^i D(x_{s+1} | x_s^i), W_s the joint weights of the mixture at s.
    Component indicators do not enter, because the weights are joint: a mixture filter is smoothed
    like any other.

    - `filter`: the filter of the run. A model in its place works with a DeprecationWarning.
    - `mixtures`: a run of `run_filter(..., collect=None)`, or the mixtures that it collected.
    - `num_trajectories`: k. Leaves of the result are (k, t + 1, ...); (k, t, ...), without x_0, for
      mixtures alone.
    - `component`: draw x_t from this component of the last mixture only: the past of one mode.
    - `method`: "exact" weights all N particles, O(N) per trajectory and step. "mcmc" (Dau and
      Chopin 2023) starts at the ancestor of x_{s+1} and makes a step of independent
      Metropolis-Hastings, with a proposal by W_s: O(1) per trajectory and step. It becomes as
      accurate as N grows.
    - `inputs`: u_1, ..., u_t, the known inputs of the run, unless a `Series` contains them.
    - `observations`: y_1..y_t, arrays or a `Series`, required by a conditionally linear model and
      by no other; a NaN is a missing number. Backward sampling is then the method of Lindsten,
      Bunch, Särkkä, Schön and Godsill (2016): latents are drawn, and the result is a
      `MarginalisedState` of them with the mean and the covariance of each x_s given these and
      y_1..y_t. It requires a whole run, with x_0, and method "exact".

    Raises `ValueError` for a model without `log_transition`, mixtures of another kind, a component
    that does not exist or is empty, a run with restarts, and for "mcmc" if particles have no single
    ancestors (an index below 0); a RuntimeError if no particle can have moved to the next. Within
    a caller's jit, states are NaN in place of these errors. If the backward weights degenerate, so
    that at some time fewer than a tenth of the trajectories are distinct, a RuntimeWarning reports
    the fraction. Use it for estimates of the past. The genealogy of the particles
    (`trace_ancestors`) is exact as well, but has few distinct states at early times.
    """
    model = filter.model if isinstance(filter, Filter) else filter
    if not isinstance(filter, Filter):
        warn("filter: sample_trajectories now takes the filter, not its model", DeprecationWarning)
    if not is_mixed(model):
        require(model, "log_transition", "sample_trajectories")
    stacked = mixtures_of(mixtures)
    series = series_of(observations, inputs)
    inputs, observations = series.inputs, series.observations
    # Those of the steps from each of the mixtures to the next.
    length = stacked.log_weights.shape[0]
    if isinstance(mixtures, FilterRun):
        inputs = steps_of_inputs(inputs, length - 1, model, "run")
    else:
        inputs = steps_of_inputs(inputs, length, model, "mixtures")
        inputs = jax.tree.map(lambda leaf: leaf[1:], inputs)
    if component is not None:
        stacked = _ending_in(component, stacked)
    if is_marginalised(model) or observations is not None:
        if observations is not None:
            steps = as_series(dataclasses.replace(series, inputs=None), model)
            observations = with_gaps(steps.observations, steps.present)
        check_marginalised(model, stacked, observations, method)
        data = observations, inputs
        paths, indices = sample_marginalised(key, model, stacked, *data, num_trajectories)
    else:
        if method == "mcmc":
            stacked = with_parents(stacked, "sample_trajectories with method 'mcmc', not 'exact',")
        paths, indices = draw_trajectories(key, model, stacked, inputs, num_trajectories, method)
    # Within a caller's jit there are NaN where a state has no past.
    if not isinstance(indices, Tracer) and np.any(np.asarray(indices) < 0):
        raise RuntimeError(backward.NO_TRANSITION)
    _warn_of_few(indices, stacked)
    return paths


def _ending_in(component: int, mixtures: ParticleMixture) -> ParticleMixture:
    """The mixtures, whose last one has no weight outside one component."""
    active = jax.tree.map(lambda leaf: leaf[-1], mixtures).active
    alive = range(component + 1) if isinstance(active, Tracer) else np.flatnonzero(active).tolist()
    if component not in alive:
        raise ValueError(f"component: {component} is empty at the last step; active are {[*alive]}")
    is_member = mixtures.component_indicators[-1] == component
    last = jnp.where(is_member, mixtures.log_weights[-1], -jnp.inf)
    log_weights = mixtures.log_weights.at[-1].set(last)
    return eqx.tree_at(lambda mixtures: mixtures.log_weights, mixtures, log_weights)


@jit_on_wide_vectors
def draw_trajectories(key, model, mixtures, inputs, num_trajectories, method):
    """`sample_trajectories` without its checks of arguments, and the particles' indices, (t, k).

    `inputs` are those of the steps between mixtures; indices are -1 as by `draw_exactly`.
    """
    key_final, key_steps, key_proposed = split(key, 3)
    last, states = backward.draw_ends(key_final, mixtures, num_trajectories)

    def back(carry: tuple[PyTree, Array], step: Any) -> tuple[tuple[PyTree, Array], PyTree]:
        next_states, next_indices = carry
        step_key, earlier, ancestors, proposed, now = step
        model_now = with_inputs(model, now)
        if proposed is None:
            log_kernel = backward.log_kernel_from(model_now, earlier)
            indices = backward.draw_exactly(step_key, log_kernel, next_states, earlier)[:, 0]
        else:
            start = take(ancestors, jnp.maximum(next_indices, 0))
            indices = backward.walk(step_key, model_now, next_states, earlier, start, proposed)
        states = backward.rows_at(indices, earlier.particles)
        return (states, indices), (states, indices)

    num_earlier = mixtures.log_weights.shape[0] - 1
    earlier = jax.tree.map(lambda leaf: leaf[:-1], mixtures)
    ancestors, proposed = mixtures.ancestor_indices[1:], None
    if method == "mcmc":
        # All times in one go, since proposals do not depend on the states after them.
        keys, shape = jax.random.split(key_proposed, num_earlier), (num_trajectories,)
        draw = jax.vmap(lambda key, logs: backward.draw(key, shape, logs))
        proposed = draw(keys, earlier.log_weights)
    keys = jax.random.split(key_steps, num_earlier)
    steps = (keys, earlier, ancestors, proposed, inputs)
    _, past = jax.lax.scan(back, (states, last), steps, reverse=True)
    states, indices = append_last(past, (states, last))
    return jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, 1), states), indices


def draw_trajectory(key: Key[Array, ""], model: Any, run: FilterRun, inputs: PyTree) -> PyTree:
    """One trajectory of a run, leaves (t + 1, ...); from the genealogy without `log_transition`."""
    mixtures = mixtures_of(run)
    if callable(getattr(model, "log_transition", None)):
        paths, _ = draw_trajectories(key, model, mixtures, inputs, 1, "exact")
    else:
        end = backward.draw(key, (1,), mixtures.log_weights[-1])
        paths = paths_through(mixtures, ancestors_of(end, mixtures))
    return jax.tree.map(lambda leaf: leaf[0], paths)


def _warn_of_few(indices: Int[Array, "t k"], mixtures: ParticleMixture) -> None:
    """A RuntimeWarning where few trajectories are distinct because backward weights degenerate.

    The share at a time is the number of distinct particles over the largest possible number: that
    of the trajectories, or of the particles of positive weight where these are fewer. It may be
    small where few particles fit, although each of these has many pasts, and so counts only where
    trajectories that share a particle nearly always share the one before as well. Within the
    caller's own jit there is no warning.
    """
    arrays = indices, mixtures.log_weights
    if any(isinstance(leaf, Tracer) or not leaf.is_fully_addressable for leaf in arrays):
        return
    num_particles = mixtures.log_weights.shape[1]
    drawn = np.asarray(indices, np.int64)[:, :num_particles]
    num_drawn, counts = drawn.shape[1], _num_distinct(drawn)
    few = np.flatnonzero(counts[:-1] < _SMALL_SHARE * num_drawn)
    shared = (num_drawn - counts[1:]).sum()
    own_pasts = _num_distinct(drawn[:-1] * num_particles + drawn[1:]) - counts[1:]
    if few.size == 0 or own_pasts.sum() > _SMALL_SHARE * shared:
        return
    possible = (np.asarray(mixtures.log_weights)[few] > -np.inf).sum(axis=1)
    shares = counts[few] / np.minimum(num_drawn, possible)
    worst = int(np.argmin(shares))
    if shares[worst] < _SMALL_SHARE:
        warn(
            f"sample_trajectories: at index {few[worst]} of the times {counts[few[worst]]} of the"
            f" {num_drawn} trajectories are distinct, a share of {shares[worst]:.2g}: the backward"
            " weights degenerate, see docs/smoothing.md"
        )


def _num_distinct(rows: np.ndarray) -> np.ndarray:
    """How many numbers of each row differ."""
    return np.array([len(np.unique(row)) for row in rows])
