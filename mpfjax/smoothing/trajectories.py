"""Backward sampling: whole trajectories from their distribution given all observations."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Key, PyTree

from mpfjax.checks import check_key, check_one_of, check_whole, given
from mpfjax.mixture import ParticleMixture
from mpfjax.models.base import AbstractStateSpaceModel, require, require_model
from mpfjax.models.conditionally_linear import is_marginalised, is_mixed
from mpfjax.models.inputs import saying_that_none_were_given, with_inputs
from mpfjax.observations import as_arrays, steps_of_inputs
from mpfjax.operations.compiling import jit_on_wide_vectors
from mpfjax.operations.random import split_keys
from mpfjax.operations.stored import take
from mpfjax.running.scan import FilterRun
from mpfjax.smoothing.backward import draw, draw_exactly, propose, walk
from mpfjax.smoothing.distinct import warn_of_few
from mpfjax.smoothing.history import mixtures_of, with_parents
from mpfjax.smoothing.marginalised import check_marginalised, sample_marginalised


def sample_trajectories(
    key: Key[Array, ""],
    model: AbstractStateSpaceModel,
    mixtures: FilterRun | ParticleMixture,
    num_trajectories: int,
    *,
    component: int | None = None,
    method: str = "exact",
    num_steps: int | None = None,
    inputs: PyTree = None,
    observations: PyTree = None,
) -> PyTree:
    """Draw trajectories x_0, ..., x_t from their smoothing distribution p(x_0, ..., x_t | y).

    Backward sampling (Godsill, Doucet and West 2004): x_t is drawn by the weights of the last
    mixture, then each x_{s} by W_s^i D(x_{s+1} | x_s^i), W_s the joint weights of the mixture at s.
    Component indicators have no part in it, since the weights are joint: a mixture filter is
    smoothed like any other.

    - `mixtures`: a run of `run_filter(..., collect=None)`, or the mixtures that it collected.
    - `num_trajectories`: k. Leaves of the result are (k, t + 1, ...); (k, t, ...), without x_0, for
      mixtures alone.
    - `component`: draw x_t from this component of the last mixture alone: the past of one mode.
    - `method`: "exact" weighs all N particles, O(N) for a trajectory and step. "mcmc" (Dau and
      Chopin 2023) starts at the ancestor of x_{s+1} and makes `num_steps` steps of independent
      Metropolis-Hastings, with proposals by W_s: O(1) for a trajectory and step. It is as exact as
      N grows.
    - `num_steps`: of "mcmc"; None is one.
    - `inputs`: u_1, ..., u_t, the known inputs that the run had.
    - `observations`: y_1..y_t, which a conditionally linear model needs and no other takes.
      Backward sampling is then that of Lindsten, Bunch, Särkkä, Schön and Godsill (2016): latents
      are drawn, and the result is a `MarginalisedState` of them with the mean and the covariance of
      each x_s given these and y_1..y_t. It needs a whole run, with x_0, and method "exact".

    Raises `ValueError` for a model without `log_transition`, mixtures of another kind, a component
    that is not there or dead, for `num_steps` with "exact", and for "mcmc" where particles have no
    single ancestors (index -1; RuntimeError within jit); a RuntimeError where no particle
    can have moved to the next. If the backward weights degenerate, so that at some time fewer than
    a tenth of the trajectories are distinct, a RuntimeWarning names the share. Use it for estimates
    of the past. The genealogy of the particles (`trace_ancestors`) is exact as well, but has few
    distinct states at early times.
    """
    check_key(key)
    require_model(model, "sample_trajectories")
    if not is_mixed(model):
        require(model, "log_transition", "sample_trajectories")
    check_whole(num_trajectories=num_trajectories)
    check_one_of(("exact", "mcmc"), method=method)
    check_whole(**given(num_steps=num_steps))
    if method == "exact" and num_steps is not None:
        raise ValueError(f"num_steps: {num_steps} does nothing with method 'exact'")
    stacked = mixtures_of(mixtures)
    inputs = _inputs_between(inputs, model, stacked, isinstance(mixtures, FilterRun))
    if component is not None:
        check_whole(0, component=component)
        _check_component(stacked, component)
    if is_marginalised(model) or observations is not None:
        check_marginalised(model, stacked, observations, method)
        observations = as_arrays(observations)
        drawn = sample_marginalised(
            key, model, stacked, observations, inputs, num_trajectories, component
        )
        latents = stacked.particles.latent
        warn_of_few(drawn.latent, latents, stacked.log_weights, "sample_trajectories")
        return drawn
    if method == "exact":
        num_steps = 0
    else:
        stacked = with_parents(stacked, "sample_trajectories with method 'mcmc'")
        num_steps = 1 if num_steps is None else num_steps
    options = (num_trajectories, component, num_steps)
    with saying_that_none_were_given(model):
        drawn = draw_trajectories(key, model, stacked, inputs, *options)
    warn_of_few(drawn, stacked.particles, stacked.log_weights, "sample_trajectories")
    return drawn


def _inputs_between(
    inputs: PyTree, model: Any, mixtures: ParticleMixture, with_initial: bool
) -> PyTree:
    """The inputs of the steps from each of the mixtures to the next."""
    num_mixtures = mixtures.log_weights.shape[0]
    if with_initial:
        return steps_of_inputs(inputs, num_mixtures - 1, model, "run")
    inputs = steps_of_inputs(inputs, num_mixtures, model, "mixtures")
    return jax.tree.map(lambda leaf: leaf[1:], inputs)


def _check_component(mixtures: ParticleMixture, component: int) -> None:
    if component >= mixtures.num_components:
        raise ValueError(f"component: {component} is not one of {mixtures.num_components}")
    final = jax.tree.map(lambda leaf: leaf[-1], mixtures)
    active = final.active
    if not isinstance(active, Tracer) and not np.asarray(active)[component]:
        alive = np.flatnonzero(np.asarray(active)).tolist()
        raise ValueError(f"component: {component} is dead at the end; alive are {alive}")


@jit_on_wide_vectors
def draw_trajectories(
    key, model, mixtures, inputs, num_trajectories, component=None, num_steps=0, checked=True
):
    """`sample_trajectories` without its checks of arguments; `checked` as for `draw_exactly`.

    `inputs` are those of the steps between mixtures.
    """
    key_final, key_steps, key_proposed = split_keys(key, 3)
    final = jax.tree.map(lambda leaf: leaf[-1], mixtures)
    log_weights = final.log_weights
    if component is not None:
        log_weights = jnp.where(final.component_indicators == component, log_weights, -jnp.inf)
    last = draw(key_final, (num_trajectories,), log_weights)
    states = jax.tree.map(lambda leaf: take(leaf, last), final.particles)

    def back(carry: tuple[PyTree, Array], step: Any) -> tuple[tuple[PyTree, Array], PyTree]:
        next_states, next_indices = carry
        step_key, earlier, ancestors, proposed, now = step
        moved_by = with_inputs(model, now)
        if proposed is None:
            indices = draw_exactly(step_key, moved_by, next_states, earlier, checked=checked)[:, 0]
        else:
            start = take(ancestors, next_indices)
            indices = walk(step_key, moved_by, next_states, earlier, start, proposed)[-1]
        states = jax.tree.map(lambda leaf: take(leaf, indices), earlier.particles)
        return (states, indices), states

    num_earlier = mixtures.log_weights.shape[0] - 1
    earlier = jax.tree.map(lambda leaf: leaf[:-1], mixtures)
    ancestors, proposed = mixtures.ancestor_indices[1:], None
    if num_steps > 0:
        # All times in one go, since proposals do not depend on the states after them.
        keys = jax.random.split(key_proposed, num_earlier)
        proposed = jax.vmap(propose, (0, 0, None, None))(keys, earlier, num_steps, num_trajectories)
    keys = jax.random.split(key_steps, num_earlier)
    steps = (keys, earlier, ancestors, proposed, inputs)
    _, past = jax.lax.scan(back, (states, last), steps, reverse=True)
    return jax.tree.map(
        lambda before, end: jnp.concatenate([jnp.moveaxis(before, 0, 1), end[:, None]], axis=1),
        past,
        states,
    )
