"""Conversion of posteriors to ArviZ."""

import inspect
import re
from typing import Any

import jax
import numpy as np
from jaxtyping import PyTree

from mpfjax.checks import optional, shown
from mpfjax.tuning.gibbs import GibbsPosterior
from mpfjax.tuning.metropolis import Posterior
from mpfjax.tuning.predictive import Predictive
from mpfjax.tuning.sequential import SequentialPosterior

Chains = Posterior | GibbsPosterior | SequentialPosterior


def to_inference_data(result: Chains | PyTree, predictive: Predictive | None = None) -> Any:
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
    - of trajectories, as `sample_trajectories` draws them: `posterior` has them as `state`, as
      draws of one chain. They are independent given the run.

    With `predictive`, what `posterior_predictive` made of the same result, there is a group
    `posterior_predictive`: y_{t+1}, ..., y_{t+k} as `observation` and the states as `state_ahead`,
    with a dimension `ahead`, 1 to k.

    Raises `ImportError` where arviz is missing, `ValueError` for anything else. Use it for
    effective sample sizes and R-hat: `arviz.summary(to_inference_data(chains))`.
    """
    arviz: Any = optional("arviz", "arviz")
    stats: dict[str, np.ndarray] = {}
    states: dict[str, np.ndarray] = {}
    parameters = getattr(result, "parameters", {})
    if isinstance(result, Posterior):
        stats["log_marginal_likelihood"] = result.log_marginal_likelihoods
        stats["accepted"] = result.accepted
    elif isinstance(result, GibbsPosterior):
        states = _named("state", result.trajectories)
        stats = {"acceptance_rate": result.accepted, "renewed": result.renewed}
    elif isinstance(result, SequentialPosterior):
        parameters = result.resampled(parameters)
    else:
        states = {name: leaf[None] for name, leaf in _named("state", result).items()}
        stacks = {leaf.shape[:3] if leaf.dtype.kind in "iufc" else () for leaf in states.values()}
        if [len(stack) for stack in stacks] != [3]:
            raise ValueError(f"result: {shown(result)} is no posterior of parameters or states")
    ahead: dict[str, np.ndarray] = {}
    if predictive is not None:
        ahead = _named("observation", predictive.observations)
        ahead |= _named("state_ahead", predictive.states)
    length = stats["renewed"].shape[2] if "renewed" in stats else None
    dims, coords = {}, {}
    for name, leaf in (states | stats | ahead).items():
        if name in ahead or (leaf.ndim > 2 and length in (None, leaf.shape[2])):
            time, first = ("ahead", 1) if name in ahead else ("time", 0)
            dims[name] = [time, *(f"{name}_dim_{k}" for k in range(1, leaf.ndim - 2))]
            coords[time] = first + np.arange(leaf.shape[2])
    groups = {"posterior": parameters | states, "sample_stats": stats}
    groups = {name: own for name, own in (groups | {"posterior_predictive": ahead}).items() if own}
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
