"""Conditional SMC: a filter that retains one trajectory, and a new trajectory drawn from it."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, Key, PyTree

from mpfjax.checks import checked, kinds
from mpfjax.filter import Filter
from mpfjax.models.base import AbstractStateSpaceModel, require
from mpfjax.models.law import law_of, refuse_marginalised
from mpfjax.models.observations import refuse_where
from mpfjax.models.series import Series, as_series, rows_of
from mpfjax.moves.conditional import REFERENCE, ConditionalPropagation, Reference, at, put
from mpfjax.operations.compiling import jit_with_floats_traced
from mpfjax.operations.random import split, uniform
from mpfjax.running.diagnosis import sound
from mpfjax.running.results import FilterRun
from mpfjax.running.scan import initial_keys, scan
from mpfjax.smoothing.backward import log_transitions
from mpfjax.smoothing.trajectories import draw_trajectory

_IMPOSSIBLE = "trajectory: its density beside the observations is zero or NaN"


class ConditionalRun(eqx.Module):
    """The result of a conditional filter.

    - `trajectory`: the new one, leaves (t + 1, ...).
    - `run`: the run with all its mixtures, with the retained trajectory among their particles. Its
      marginal likelihood is NOT unbiased, because one particle was not drawn.
    - `slots`: (t + 1,), the slot of the retained trajectory in the mixture of each time.
    - `possible`: (t + 1,), whether the retained trajectory has a positive density.
    """

    trajectory: PyTree
    run: FilterRun
    slots: Int[Array, " t"]
    possible: Bool[Array, " t"]


@checked
def conditional_filter(
    key: Key[Array, ""], filter: Filter, observations: PyTree, trajectory: PyTree
) -> ConditionalRun:
    """Run a filter conditionally on a trajectory, and draw a new one from all its particles.

    Conditional SMC (Andrieu, Doucet and Holenstein 2010) with backward sampling (Whiteley 2010;
    Lindsten, Jordan and Schön 2014, section 5). It leaves p(x_0, ..., x_t | y_1..y_t) invariant for
    every N of at least 2: if `trajectory` is a draw from it, so is the new one. So a chain of
    calls, each with the trajectory of the last, is an MCMC sampler of whole trajectories.

    Why this holds for mixtures. Let Q be the distribution of all random variables of an ordinary
    run: particles, ancestors, indicators. A run and one of its trajectories (slots b_0, ..., b_t),
    with density Ẑ W_t^{b_t} Q / Z, have p(x_0, ..., x_t | y) as the distribution of the states at
    these slots. For a particle that is resampled within component m, with k_m slots, the weight π_m
    / k_m of the offspring times the probability w_i of the ancestor i is W_i / k_m. So the weights
    cancel along the trajectory, and it remains that b_0 is any of N slots, b_s any of the k_m slots
    of the trajectory's component, and all else is drawn from Q. Regrouping is part of Q. Indicators
    are functions of the particles (of all of them, including the retained one) and of independent
    random numbers, so that given the particles their distribution is the same for any retained
    slot, and cancels. K-means, merging and splitting move the trajectory from one component to
    another like any particle. Backward sampling then draws from the run alone,
    regardless of which of its trajectories was retained.

    - `trajectory`: x_0, ..., x_t, leaves (t + 1, ...), such as one of `sample_trajectories`.
    - `observations`: arrays, or a `Series`.

    x_0 is drawn independently for each particle, even if the model would draw it in strata, and no
    `SelectInitial` selects it. The model's `sample_transition` must draw particles independently of
    each other.

    Raises `ValueError` for a filter that is not a chain of regrouping moves, `Resample`,
    `AuxiliaryResample`, `Propagate`, `Predict`, `Reweight` and `Every` of these, also initially; a
    conditionally linear model; a proposal without `log_density`; noise that is not independent; a
    model without `log_transition`; a trajectory of other shapes or types than the model's states,
    or of density zero (NaN within jit). Use it in your own Gibbs
    sampler; `mpfjax.tuning.particle_gibbs` is one for parameters.
    """
    check_conditional(filter, "conditional_filter")
    series = as_series(observations, filter.model)
    trajectory = _as_states(trajectory, filter.model, series.length + 1)
    # Checked before the run: backward sampling could not recover an impossible trajectory.
    possible = eqx.filter_jit(possible_times)(filter.model, trajectory, series.inputs)
    trajectory = refuse_where(~possible, trajectory, _IMPOSSIBLE)
    result = _run(key, filter, series, trajectory)
    result = eqx.tree_at(lambda result: result.run, result, sound(result.run, free=False))
    return refuse_where(~result.possible, result, _IMPOSSIBLE)


def renew(
    key: Key[Array, ""], filter: Filter, series: Series, trajectory: PyTree
) -> ConditionalRun:
    """`conditional_filter` under the caller's jit, its arguments unchecked.

    Backward sampling may find no past: look at `possible_times` of the new trajectory.
    """
    key_slot, key_initial, key_run, key_back = split(key, 4)
    n = filter.num_particles
    first_slot = jnp.clip(jnp.floor(uniform(key_slot, ()) * n).astype(jnp.int32), 0, n - 1)
    # x_0 of every particle, drawn separately: a model may draw many of them in strata.
    draws = jax.vmap(lambda key: law_of(filter.model).sample_initial(key, 1))(split(key_initial, n))
    particles = jax.tree.map(lambda leaf: leaf[:, 0], draws)
    start = jax.tree.map(lambda leaf, draws: put(leaf, draws[0], first_slot), particles, trajectory)
    reference = Reference(trajectory, first_slot)
    around = filter.replace(
        moves=[move.around(reference) for move in filter.moves],
        # x_0 is one of N draws of the model's.
        initial_moves=[move for move in filter.initial_moves if not move.weighs],
    )
    initial = around._init(initial_keys(key_run, around), particles=start)
    run = scan(key_run, around, series, None, initial=initial)
    slots = run.collected.memory[REFERENCE].slot
    is_alive = (jax.vmap(at)(run.collected.log_weights, slots) > -jnp.inf) & ~run.degenerate
    return ConditionalRun(
        trajectory=draw_trajectory(key_back, filter.model, run, series.inputs),
        run=run,
        slots=jnp.concatenate([first_slot[None], slots]),
        possible=possible_times(filter.model, trajectory, series.inputs).at[1:].min(is_alive),
    )


_run = jit_with_floats_traced(renew)


def possible_times(model: Any, trajectory: PyTree, inputs: PyTree) -> Bool[Array, " t"]:
    """At which times a trajectory has a density above zero, as far as the densities tell.

    The observations have no part in it.
    """
    start = jnp.ones(1, bool)
    if callable(getattr(model, "log_initial", None)):
        start = model.log_initial(jax.tree.map(lambda leaf: leaf[:1], trajectory)) > -jnp.inf
    return jnp.concatenate([start, log_transitions(model, trajectory, inputs) > -jnp.inf])


def check_conditional(filter: Filter, needed_by: str) -> None:
    """Raise a `ValueError` for a filter that cannot keep a trajectory."""
    refuse_marginalised(filter.model, needed_by, "metropolis_hastings and smc2 take it as it is")
    require(filter.model, "log_transition", needed_by)
    reference = Reference(None, jnp.zeros((), jnp.int32))
    for move in filter.initial_moves:
        # What selects x_0 exactly is left out.
        if move.approximate or not move.weighs:
            move.around(reference)
    moves = [move.around(reference) for move in filter.moves]
    number = sum(isinstance(move, ConditionalPropagation) for move in moves)
    if number != 1:
        raise ValueError(f"filter: {needed_by} needs one Propagate or Predict, not {number}")


def shape_of_trajectory(model: Any, length: int) -> PyTree:
    """The shapes and types of x_0, ..., x_t of a model, t + 1 being the length."""
    law = law_of(model)
    return jax.eval_shape(lambda key: law.sample_initial(key, length), jax.random.key(0))


def _as_states(trajectory: Any, model: AbstractStateSpaceModel, length: int) -> PyTree:
    """The trajectory as arrays; a `ValueError` for one of other shapes or types than the states."""
    like, arrays = shape_of_trajectory(model, length), rows_of(trajectory, "trajectory")
    if kinds(arrays) != kinds(like):
        states = f"{kinds(like)}, x_0 and a state per step"
        raise ValueError(f"trajectory: {kinds(arrays)} is not {states}")
    return jax.tree.map(jnp.asarray, arrays)
