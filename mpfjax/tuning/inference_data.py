"""Conversion of posteriors to ArviZ."""

import importlib
import inspect
from types import ModuleType
from typing import Any

import jax
import numpy as np
from jaxtyping import PyTree

from mpfjax.checks import shown
from mpfjax.tuning.gibbs import GibbsPosterior
from mpfjax.tuning.metropolis import Posterior
from mpfjax.tuning.sequential import SequentialPosterior

_NEEDED = (
    "what metropolis_hastings, particle_gibbs or smc2 returns, nor trajectories, leaves"
    " (trajectories, times, ...)"
)
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
    arviz = _arviz()
    if isinstance(result, Posterior):
        stats = {
            "log_marginal_likelihood": result.log_marginal_likelihoods,
            "accepted": result.accepted,
        }
        return _convert(arviz, result.parameters, stats, {})
    if isinstance(result, GibbsPosterior):
        states = _states(result.trajectories)
        length = result.renewed.shape[2]
        times = {
            name: ["time"]
            for name, leaf in states.items()
            if leaf.ndim > 2 and leaf.shape[2] == length
        }
        for name in set(states) & set(result.parameters):
            raise ValueError(f"result: a parameter is called {name}, as are the states")
        stats = {"acceptance_rate": result.accepted, "renewed": result.renewed}
        dims = times | {"renewed": ["time"]}
        return _convert(arviz, result.parameters | states, stats, dims)
    if isinstance(result, SequentialPosterior):
        draws = _of_equal_weight(result.weights)
        posterior = {name: values[draws][None] for name, values in result.parameters.items()}
        return _convert(arviz, posterior, {}, {})
    leaves = jax.tree.leaves(result)
    if not leaves or not all(map(_is_stack, leaves)):
        raise ValueError(f"result: {shown(result)} is not {_NEEDED}")
    if len({leaf.shape[:2] for leaf in leaves}) > 1:
        shapes = [leaf.shape for leaf in leaves]
        raise ValueError(f"result: leaves of shapes {shapes} are not {_NEEDED}")
    states = {name: leaf[None] for name, leaf in _states(result).items()}
    return _convert(arviz, states, {}, {name: ["time"] for name in states})


def _of_equal_weight(weights: np.ndarray) -> np.ndarray:
    """Indices of samples by systematic resampling, the same in every call.

    In their own order, copies would stand side by side and look like a chain that sticks.
    """
    num = len(weights)
    cumulative = np.cumsum(weights, dtype=float)
    quantiles = (np.arange(num) + 0.5) / num * cumulative[-1]
    indices = np.minimum(np.searchsorted(cumulative, quantiles, side="right"), num - 1)
    return np.random.default_rng(0).permutation(indices)


def _is_stack(leaf: Any) -> bool:
    is_array = isinstance(leaf, jax.Array | np.ndarray)
    return is_array and leaf.ndim >= 2 and np.issubdtype(leaf.dtype, np.number)


def _states(trajectories: PyTree) -> dict[str, np.ndarray]:
    """The leaves by name."""
    named = jax.tree_util.tree_leaves_with_path(trajectories)
    return {"_".join(["state", *map(_part, path)]): np.asarray(leaf) for path, leaf in named}


def _part(key: Any) -> str:
    """What a step of a path is called, without brackets and dots."""
    return str(next(getattr(key, name) for name in ("key", "idx", "name") if hasattr(key, name)))


def _convert(
    arviz: ModuleType,
    posterior: dict[str, np.ndarray],
    stats: dict[str, np.ndarray],
    names: dict[str, list[str]],
) -> Any:
    """Groups of arrays (chains, draws, ...), with the names of their first further dimension."""
    groups = {"posterior": posterior} | ({"sample_stats": stats} if stats else {})
    arrays = posterior | stats
    dims = {
        name: own + [f"{name}_dim_{k}" for k in range(len(own), arrays[name].ndim - 2)]
        for name, own in names.items()
    }
    lengths = [arrays[name].shape[2] for name in names]
    coords = {"time": np.arange(lengths[0])} if lengths else {}
    if "posterior" in inspect.signature(arviz.from_dict).parameters:
        return arviz.from_dict(**groups, dims=dims, coords=coords)
    return arviz.from_dict(groups, dims=dims, coords=coords)


def _arviz() -> ModuleType:
    try:
        return importlib.import_module("arviz")
    except ImportError as error:
        raise ImportError("to_inference_data needs arviz: pip install arviz") from error
