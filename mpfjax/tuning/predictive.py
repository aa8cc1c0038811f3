"""What comes next, over the posterior of parameters and states."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Key, PyTree

from mpfjax.checks import Count, checked
from mpfjax.mixture import ParticleMixture
from mpfjax.models.base import require
from mpfjax.models.observations import steps_of_inputs
from mpfjax.models.trial import steps_ahead
from mpfjax.operations.compiling import jit_on_wide_vectors
from mpfjax.smoothing.backward import draw
from mpfjax.tuning.gibbs import GibbsPosterior
from mpfjax.tuning.metropolis import Posterior
from mpfjax.tuning.sequential import SequentialPosterior

_TOGETHER = 64  # of the draws that share a program's step


class Predictive(NamedTuple):
    """Draws of what comes next, all of equal weight."""

    states: PyTree
    """x_{t+1}, ..., x_{t+k}, leaves (chains, draws, k, ...)."""
    observations: PyTree
    """y_{t+1}, ..., y_{t+k}, leaves (chains, draws, k, ...)."""


@checked
def posterior_predictive(
    key: Key[Array, ""],
    posterior: Posterior | GibbsPosterior | SequentialPosterior,
    num_steps: Count,
    *,
    inputs: PyTree = None,
) -> Predictive:
    """Draw the next k states and observations given y_1..y_t, parameters and states integrated out.

    For each draw of θ there is one of x_t given θ, then the model's own steps and observations:

        p(y_{t+1}, ..., y_{t+k} | y_1..y_t)
            = ∫ p(θ, x_t | y_1..y_t) p(x_{t+1}, y_{t+1}, ..., x_{t+k}, y_{t+k} | θ, x_t).

    The pair (θ, x_t) has the posterior distribution as exactly as θ alone has, for any N:

    - of `metropolis_hastings`, x_t is a particle of the run whose Ẑ was accepted (Andrieu, Doucet
      and Holenstein 2010, section 2.4.2), which is made again with its key;
    - of `particle_gibbs`, the end of the trajectory, which must be kept whole (`collect=None`);
    - of `smc2`, a particle of the sample's own filter. There are as many draws as samples, as one
      chain, resampled by their weights: those of `to_inference_data`.

    - `inputs`: u_{t+1}, ..., u_{t+k}, as for `run_filter`.

    Raises `ValueError` for a model without `sample_observation(key, states)`, for trajectories that
    were not kept, and for a posterior given several sequences.
    Use it for forecasts that count all that is not known; `forecast` is for known parameters.
    """
    problem: Any = posterior.problem
    require(problem.tree.model, "sample_observation", "posterior_predictive")
    inputs = steps_of_inputs(inputs, num_steps, problem.tree.model, "steps")
    values, ends, draw_end = _ends(posterior, problem)
    keys = jax.random.split(key, jax.tree.leaves(ends)[0].shape[:2])
    found = _predict(problem, draw_end, (keys, values, ends), num_steps, inputs)
    return Predictive(*jax.tree.map(np.asarray, found))


@jit_on_wide_vectors
def _predict(problem, draw_end, rows, num_steps, inputs):
    def one(row: tuple[Array, PyTree, PyTree]) -> tuple[PyTree, PyTree]:
        key, values, end = row
        key_end, key_steps = jax.random.split(key)
        filter = problem.having(values)
        state = draw_end(key_end, problem, filter, end)
        return steps_ahead(key_steps, filter.model, state, num_steps, inputs)

    size = min(_TOGETHER, rows[0].shape[1])
    return jax.lax.map(lambda chain: jax.lax.map(one, chain, batch_size=size), rows)


def _ends(posterior: Any, problem: Any) -> tuple[PyTree, PyTree, Callable[..., PyTree]]:
    """Parameters, and what each x_t is drawn from, leaves (chains, draws, ...); and how."""
    values = posterior.parameters
    if isinstance(posterior, SequentialPosterior):
        return *posterior.resampled((values, posterior.mixtures)), _of_mixture
    if isinstance(posterior, GibbsPosterior):
        kept = posterior.trajectories
        if {leaf.shape[2:3] for leaf in jax.tree.leaves(kept)} != {posterior.renewed.shape[2:]}:
            raise ValueError("posterior: its trajectories are not whole, as by collect=None")
        return values, jax.tree.map(lambda leaf: leaf[:, :, -1:], kept), _of_trajectory
    if [group.length for group in problem.objective.groups] != [1]:
        raise ValueError("posterior: it is given several sequences, each with a future of its own")
    return values, posterior.key_data, _of_run


def _of_trajectory(key: Any, problem: Any, filter: Any, last: PyTree) -> PyTree:
    return last


def _of_mixture(key: Any, problem: Any, filter: Any, mixture: ParticleMixture) -> PyTree:
    return mixture.at(draw(key, (1,), mixture.log_weights)).particles


def _of_run(key: Any, problem: Any, filter: Any, key_data: Array) -> PyTree:
    """From the run whose Ẑ was accepted, made again."""
    key_run = jax.random.wrap_key_data(key_data, impl=jax.random.key_impl(key))
    final = jax.tree.map(lambda leaf: leaf[0], problem.objective.runs(key_run, filter)[0].final)
    return _of_mixture(key, problem, filter, final)
