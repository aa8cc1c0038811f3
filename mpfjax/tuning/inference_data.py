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
from mpfjax.tuning.sequential import SequentialPosterior

Chains = Posterior | GibbsPosterior | SequentialPosterior


def to_inference_data(result: Chains | PyTree) -> Any:
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
        states = _states(result.trajectories)
        stats = {"acceptance_rate": result.accepted, "renewed": result.renewed}
    elif isinstance(result, SequentialPosterior):
        # Systematic resampling. In their own order copies would look like a chain that sticks.
        num, cumulative = len(result.weights), np.cumsum(result.weights, dtype=float)
        quantiles = (np.arange(num) + 0.5) / num * cumulative[-1]
        draws = np.minimum(np.searchsorted(cumulative, quantiles, side="right"), num - 1)
        draws = np.random.default_rng(0).permutation(draws)
        parameters = {name: values[draws][None] for name, values in parameters.items()}
    else:
        states = {name: leaf[None] for name, leaf in _states(result).items()}
        stacks = {leaf.shape[:3] if leaf.dtype.kind in "iufc" else () for leaf in states.values()}
        if [len(stack) for stack in stacks] != [3]:
            raise ValueError(f"result: {shown(result)} is no posterior of parameters or states")
    length = stats["renewed"].shape[2] if "renewed" in stats else None
    dims, coords = {}, {}
    for name, leaf in (states | stats).items():
        if leaf.ndim > 2 and length in (None, leaf.shape[2]):
            dims[name] = ["time", *(f"{name}_dim_{k}" for k in range(1, leaf.ndim - 2))]
            coords = {"time": np.arange(leaf.shape[2])}
    groups = {"posterior": parameters | states} | ({"sample_stats": stats} if stats else {})
    if "posterior" in inspect.signature(arviz.from_dict).parameters:
        return arviz.from_dict(**groups, dims=dims, coords=coords)
    return arviz.from_dict(groups, dims=dims, coords=coords)


def _states(trajectories: PyTree) -> dict[str, np.ndarray]:
    """The leaves by name: "state", and where they are several, what each is called."""
    named = jax.tree_util.tree_leaves_with_path(trajectories)
    return {
        "state" + re.sub(r"[^\w]+", "_", jax.tree_util.keystr(path)).rstrip("_"): np.asarray(leaf)
        for path, leaf in named
    }
