"""Online smoothing of sums over a trajectory: PaRIS, and fixed-lag smoothing."""

from collections.abc import Callable
from functools import partial
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key, PyTree

from mpfjax.chain import check_keep_parents
from mpfjax.checks import Count, CountOrZero, check_one_each, checked, saying
from mpfjax.filter import Filter
from mpfjax.mixture import ParticleMixture
from mpfjax.models.base import mapped, require, with_inputs
from mpfjax.models.conditionally_linear import refuse_marginalised
from mpfjax.models.observations import as_series
from mpfjax.operations.compiling import jit_on_wide_vectors, with_floats_traced
from mpfjax.operations.logarithms import as_inexact
from mpfjax.operations.random import split, split_keys
from mpfjax.operations.stored import take
from mpfjax.running.scan import (
    FilterRun,
    first_mixture,
    report_of,
    run_of,
    sound,
    step_or_predict,
)
from mpfjax.smoothing.backward import draw, draw_exactly, log_transition_from, walk


class SmoothedSums(eqx.Module):
    """Smoothed expectations of a sum over the trajectory, as of each step.

    - `sums`: leaves (t, ...), at step s the estimate of E[Σ_{r <= s} h(x_{r-1}, x_r) | y_1..y_s].
      With a lag, each term is that of `terms`, as far as s goes.
    - `terms`: leaves (t, ...), the estimates of E[h(x_{r-1}, x_r) | y_1..y_{min(r + lag, t)}] for
      every r; None without a lag.
    - `run`: the `FilterRun`, with nothing collected.
    """

    sums: PyTree
    terms: PyTree
    run: FilterRun


@checked
def smoothed_sums(
    key: Key[Array, ""],
    filter: Filter,
    observations: PyTree,
    function: Callable[[PyTree, PyTree], PyTree],
    *,
    lag: CountOrZero | None = None,
    method: Literal["exact", "mcmc"] = "exact",
    num_draws: Count = 2,
) -> SmoothedSums:
    """E[Σ_t h(x_{t-1}, x_t) | y], online: PaRIS, in memory that does not grow with t.

    Olsson and Westerborn (2017): each particle i of step t carries τ_t^i, the expected sum over the
    trajectories that end in it. Some particles J of step t - 1 are drawn by the backward kernel,
    W_{t-1}^J D(x_t^i | x_{t-1}^J), and τ_t^i is the mean of τ_{t-1}^J + h(x_{t-1}^J, x_t^i) over
    them. The estimate is Σ_i W_t^i τ_t^i. W are joint weights, so this holds for a mixture too: a
    particle may come from another component. Times Ẑ, it is unbiased if Ẑ is. The filter's run is
    that of `run_filter` with the same key.

    - `function`: h. It takes x_{t-1} and x_t of n particles, leaves (n, ...), and returns values of
      each, leaves (n, ...); of one particle if the model is wrapped by `per_particle`.
    - `lag`: L. None smooths every term by all observations so far. With a lag, term r is smoothed
      by y_1..y_{r+L} and then kept. Memory is L + 1 times that of None. The bias does not vanish
      with N, but the variance does not grow with t - r. A lag of t or more is one of t - 1.
    - `method`: "exact" weighs all N particles, O(N²) a step. "mcmc" (Dau and Chopin 2023) takes
      the ancestor and goes on by steps of independent Metropolis-Hastings, O(N), and is as exact.
    - `num_draws`: how many particles J are drawn for each particle. With one, few distinct
      particles of early times are left, as in a genealogy. Two are enough.
    - `observations`: arrays, or a `Series`.

    Raises `ValueError` for a model without `log_transition`, values that are not one a particle,
    "mcmc" where a move leaves no single ancestors, and as `run_filter` does; a RuntimeError where
    no particle can have moved to the next. Use it for the sums that scores and EM need, and for
    series too long to keep. `sample_trajectories` needs the mixtures of all steps, and serves every
    function at once.
    """
    refuse_marginalised(filter.model, "smoothed_sums", "take sample_trajectories")
    require(filter.model, "log_transition", "smoothed_sums")
    if method == "mcmc":
        check_keep_parents("filter", filter.moves, "smoothed_sums with method 'mcmc'")
    series = as_series(observations, filter.model)
    if lag is not None:
        lag = min(lag, series.length - 1)
    options = (mapped(filter.model, function), lag, method, num_draws)
    sums = with_floats_traced(lambda filter: _smooth(key, filter, series, options), filter)
    return SmoothedSums(sums.sums, sums.terms, sound(sums.run))


@jit_on_wide_vectors
def _smooth(key, filter, series, options):
    function, lag, method, num_draws = options
    # The first two are those of `run_filter`.
    key_initial, key_steps, key_backward = split_keys(key, 3)
    length = series.length
    step_keys = jax.random.split(key_steps, length)
    initial = first_mixture(key_initial, filter, series)
    num_kept = 1 if lag is None else lag + 1
    states = initial.particles
    shapes = jax.eval_shape(partial(_of_states, function), states, states)
    kept = jax.tree.map(lambda leaf: jnp.zeros((num_kept, *leaf.shape), leaf.dtype), shapes)
    settled = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape[1:], leaf.dtype), shapes)

    def advance(carry: tuple[ParticleMixture, PyTree, PyTree], step: PyTree) -> Any:
        mixture, kept, settled = carry
        t, step_key, draw_key, now = step
        moved, info = step_or_predict(filter, step_key, mixture, now)
        model = with_inputs(filter.model, now.inputs)
        needed, start = moved.occupied, moved.ancestor_indices
        if method == "exact":
            log_density = log_transition_from(model, mixture)
            futures = moved.particles
            indices = draw_exactly(draw_key, log_density, futures, mixture, num_draws, needed)
        else:
            key_proposed, key_walk = split(draw_key, 2)
            # The start counts as a draw, unless it would be the only one.
            shape = (max(num_draws - 1, 1), start.shape[0])
            proposed = draw(key_proposed, shape, mixture.log_weights)
            later = walk(key_walk, model, moved.particles, mixture, start, proposed, needed).T
            both = [start[:, None], later]
            indices = later if num_draws == 1 else jnp.concatenate(both, axis=1)
        places = indices.reshape(-1)
        earlier = jax.tree.map(lambda leaf: take(leaf, places), mixture.particles)
        repeat = lambda leaf: jnp.repeat(leaf, num_draws, axis=0)  # noqa: E731
        values = _of_states(function, earlier, jax.tree.map(repeat, moved.particles))
        values = jax.tree.map(lambda leaf: _mean_of_pasts(leaf, num_draws), values)
        of_pasts = jax.vmap(lambda rows: _mean_of_pasts(take(rows, places), num_draws))
        kept = jax.tree.map(of_pasts, kept)
        if lag is None:
            kept = jax.tree.map(lambda old, new: old + new[None], kept, values)
        else:
            kept = jax.tree.map(lambda old, new: old.at[t % num_kept].set(new), kept, values)
        averages = jax.tree.map(jax.vmap(moved.average), kept)
        sums = jax.tree.map(lambda done, own: done + jnp.sum(own, axis=0), settled, averages)
        # The next step overwrites term t - lag; zero while there is none yet.
        oldest = jax.tree.map(lambda own: own[(t + 1) % num_kept], averages)
        if lag is not None:
            settled = jax.tree.map(jnp.add, settled, oldest)
        return (moved, kept, settled), (sums, oldest, report_of(info))

    keys = step_keys, jax.random.split(key_backward, length)
    steps = (jnp.arange(length, dtype=jnp.int32), *keys, series)
    carry, outputs = jax.lax.scan(advance, (initial, kept, settled), steps)
    final, kept, _ = carry
    sums, oldest, reports = outputs
    terms = None
    if lag is not None:
        last = np.arange(length - lag, length) % num_kept
        open_terms = jax.tree.map(lambda leaf: jax.vmap(final.average)(leaf[last]), kept)
        terms = jax.tree.map(
            lambda done, rest: jnp.concatenate([done[lag:], rest]), oldest, open_terms
        )
    return SmoothedSums(sums, terms, run_of(initial, final, None, reports))


def _mean_of_pasts(values: Array, num_draws: int) -> Array:
    """For each particle the mean of its draws, which stand side by side."""
    return jnp.mean(values.reshape(-1, num_draws, *values.shape[1:]), axis=1)


def _of_states(
    function: Callable[[PyTree, PyTree], PyTree], previous: PyTree, states: PyTree
) -> PyTree:
    """h of these states; a `ValueError` unless it is one value a particle."""
    with saying("in function, which is called with x_{t-1} and x_t of all particles"):
        values = function(previous, states)
    check_one_each(jax.tree.leaves(states)[0].shape[0], function=values)
    return jax.tree.map(as_inexact, values)
