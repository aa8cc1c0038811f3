"""What comes of a posterior: draws of what is next, and the type in which ArviZ has both."""

import inspect
import re
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Key, PyTree

from mpfjax.checks import Count, checked, optional, shown
from mpfjax.models.base import require
from mpfjax.models.observations import steps_of_inputs, with_gaps
from mpfjax.models.trial import steps_ahead
from mpfjax.operations.compiling import jit_on_wide_vectors
from mpfjax.tuning.gibbs import GibbsPosterior
from mpfjax.tuning.happened import Chains, PosteriorTrajectories, drawn_states
from mpfjax.tuning.metropolis import Posterior
from mpfjax.tuning.sequential import SequentialPosterior


class Predictive(NamedTuple):
    """Draws of what comes next, all of equal weight."""

    states: PyTree
    """x_{t+1}, ..., x_{t+k}, leaves (chains, draws, k, ...)."""
    observations: PyTree
    """y_{t+1}, ..., y_{t+k}, leaves (chains, draws, k, ...)."""


@checked
def posterior_predictive(
    key: Key[Array, ""],
    posterior: Chains,
    num_steps: Count,
    *,
    num_trajectories: Count | None = None,
    inputs: PyTree = None,
) -> Predictive:
    """Draw the next k states and observations given y_1..y_t, parameters and states integrated out.

    For each draw of θ there is one of x_t given θ, then the model's own steps and observations:

        p(y_{t+1}, ..., y_{t+k} | y_1..y_t)
            = ∫ p(θ, x_t | y_1..y_t) p(x_{t+1}, y_{t+1}, ..., x_{t+k}, y_{t+k} | θ, x_t).

    The pair (θ, x_t) has the posterior distribution as exactly as θ alone has, for any N:

    - of `metropolis_hastings`, x_t is a particle of the run whose Ẑ was accepted (Andrieu, Doucet
      and Holenstein 2010, section 2.4.2), which is made again with its key, once for all draws
      that share it;
    - of `particle_gibbs`, the end of the trajectory, which must be kept whole (`collect=None`);
    - of `smc2`, a particle of the sample's own filter. There are as many draws as samples, as one
      chain, resampled by their weights: those of `to_inference_data`.

    - `num_trajectories`, as for `posterior_trajectories`: a few hundred of each chain do for
      bands, and of `metropolis_hastings` each costs a run of the filter.
    - `inputs`: u_{t+1}, ..., u_{t+k}, as for `run_filter`.

    Raises `ValueError` for a model without `sample_observation(key, states)`, for trajectories that
    were not kept, and for a posterior given several sequences.
    Use it for forecasts that count all that is not known; `forecast` is for known parameters, and
    `posterior_trajectories` for what happened.
    """
    problem: Any = posterior.problem
    require(problem.tree.model, "sample_observation", "posterior_predictive")
    inputs = steps_of_inputs(inputs, num_steps, problem.tree.model, "steps")
    key_ends, key_steps = jax.random.split(key)
    problem, values, ends = drawn_states(key_ends, posterior, num_trajectories, whole=False)
    keys = jax.random.split(key_steps, jax.tree.leaves(ends)[0].shape[:2])
    found = _predict(problem, keys, values, ends, num_steps, inputs)
    return Predictive(*jax.tree.map(np.asarray, found))


# Compiling takes nearly all of the time.
@partial(jit_on_wide_vectors, soon=True)
def _predict(problem, keys, values, ends, num_steps, inputs):
    def one(key: Array, values: PyTree, end: PyTree) -> tuple[PyTree, PyTree]:
        state = jax.tree.map(lambda leaf: leaf[None], end)
        return steps_ahead(key, problem.having(values).model, state, num_steps, inputs)

    return jax.vmap(jax.vmap(one))(keys, values, ends)


def to_inference_data(
    result: Chains | PosteriorTrajectories | PyTree, predictive: Predictive | None = None
) -> Any:
    """A posterior as ArviZ's own type, for its diagnostics and plots.

    It is an `InferenceData` with ArviZ before 1, and a `DataTree` of xarray from 1 on.

    - of `metropolis_hastings`: group `posterior` has the parameters by name; `sample_stats` has
      `log_marginal_likelihood` and `accepted`.
    - of `particle_gibbs`: `posterior` has the parameters, and the trajectories as `state`, with a
      dimension `time`; for states that are several arrays, `state_` and the name of each. What
      `collect` made of trajectories has the same name. `sample_stats` has `acceptance_rate`, and
      `renewed`, which states changed in a step.
    - of `smc2`: `posterior` has as many draws of its weighted samples as there are samples, of
      equal weight (systematic resampling), in an order without meaning, as one chain. Samples of
      large weight are there several times, which ArviZ's effective sample size does not know:
      take `effective_sample_sizes`.
    - of `posterior_trajectories`: `posterior` has the parameters and the trajectories as `state`,
      `posterior_predictive` the new observations as `observation`, with a dimension
      `observation_time`, and `observed_data` those that there were, NaN where missing: what
      `arviz.plot_ppc` takes.
    - of trajectories, as `sample_trajectories` draws them: `posterior` has them as `state`, as
      draws of one chain. They are independent given the run.

    With `predictive`, what `posterior_predictive` made of the same result, the group
    `posterior_predictive` has y_{t+1}, ..., y_{t+k} as `observation_ahead` and the states as
    `state_ahead`, with a dimension `ahead`, 1 to k.

    Raises `ImportError` where arviz is missing, `ValueError` for anything else. Use it for
    effective sample sizes and R-hat: `arviz.summary(to_inference_data(chains))`.
    """
    arviz: Any = optional("arviz", "arviz")
    stats: dict[str, np.ndarray] = {}
    states: dict[str, np.ndarray] = {}
    again: dict[str, np.ndarray] = {}
    seen: dict[str, np.ndarray] = {}
    parameters = getattr(result, "parameters", {})
    if isinstance(result, Posterior):
        stats["log_marginal_likelihood"] = result.log_marginal_likelihoods
        stats["accepted"] = result.accepted
    elif isinstance(result, GibbsPosterior):
        states = _named("state", result.trajectories)
        stats = {"acceptance_rate": result.accepted, "renewed": result.renewed}
    elif isinstance(result, SequentialPosterior):
        parameters = result.resampled(parameters)
    elif isinstance(result, PosteriorTrajectories):
        states = _named("state", result.states)
        again = _named("observation", result.observations)
        observed = result.observed
        seen = _named("observation", with_gaps(observed.observations, observed.present))
    else:
        states = {name: leaf[None] for name, leaf in _named("state", result).items()}
        stacks = {leaf.shape[:3] if leaf.dtype.kind in "iufc" else () for leaf in states.values()}
        if [len(stack) for stack in stacks] != [3]:
            raise ValueError(f"result: {shown(result)} is no posterior of parameters or states")
    ahead: dict[str, np.ndarray] = {}
    if predictive is not None:
        ahead = _named("observation_ahead", predictive.observations)
        ahead |= _named("state_ahead", predictive.states)
    length = stats["renewed"].shape[2] if "renewed" in stats else None
    dims, coords = {}, {}
    times = dict.fromkeys(ahead, "ahead") | dict.fromkeys(again, "observation_time")
    for name, leaf in (states | stats | again | ahead).items():
        if name in times or (leaf.ndim > 2 and length in (None, leaf.shape[2])):
            time, first = (times[name], 1) if name in times else ("time", 0)
            dims[name] = [time, *(f"{name}_dim_{k}" for k in range(1, leaf.ndim - 2))]
            coords[time] = first + np.arange(leaf.shape[2])
    groups = {
        "posterior": parameters | states, "sample_stats": stats,
        "posterior_predictive": again | ahead, "observed_data": seen,
    }  # fmt: skip
    groups = {name: own for name, own in groups.items() if own}
    if "posterior" in inspect.signature(arviz.from_dict).parameters:
        return arviz.from_dict(**groups, dims=dims, coords=coords)
    return arviz.from_dict(groups, dims=dims, coords=coords)


def _named(whole: str, tree: PyTree) -> dict[str, np.ndarray]:
    """The leaves by name: that of the whole, and where they are several, what each is called."""
    named = jax.tree_util.tree_leaves_with_path(tree)
    return {
        whole + re.sub(r"[^\w]+", "_", jax.tree_util.keystr(path)).rstrip("_"): np.asarray(leaf)
        for path, leaf in named
    }
