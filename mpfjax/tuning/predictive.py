"""Future states and observations, over the posterior of parameters and states."""

from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Key, PyTree

from mpfjax.checks import Count, checked
from mpfjax.models.base import require
from mpfjax.models.observations import steps_of_inputs
from mpfjax.models.simulation import steps_ahead
from mpfjax.operations.compiling import jit_on_wide_vectors
from mpfjax.tuning.happened import Chains, drawn_states


class Predictive(NamedTuple):
    """Draws of future states and observations, all of equal weight."""

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
    """Draw the next k states and observations, with parameters and states integrated out.

    For each draw of θ there is one of x_t given θ, then the model's own steps and observations:

        p(y_{t+1}, ..., y_{t+k} | y_1..y_t)
            = ∫ p(θ, x_t | y_1..y_t) p(x_{t+1}, y_{t+1}, ..., x_{t+k}, y_{t+k} | θ, x_t).

    The pair (θ, x_t) has the posterior distribution as exactly as θ alone, for any N:

    - for `metropolis_hastings`, x_t is a particle of the run whose Ẑ was accepted (Andrieu, Doucet
      and Holenstein 2010, section 2.4.2), which is repeated with its key, once for all draws that
      share it;
    - for `particle_gibbs`, the end of the trajectory, which must be stored completely
      (`collect=None`);
    - for `smc2`, a particle of the sample's own filter. There are as many draws as samples, as one
      chain, resampled by their weights.

    - `num_trajectories`, as for `posterior_trajectories`: a few hundred of each chain are enough
      for bands, and for `metropolis_hastings` each requires a run of the filter.
    - `inputs`: u_{t+1}, ..., u_{t+k}, as for `run_filter`.

    Raises `ValueError` for a model without `sample_observation(key, states)`, for trajectories that
    were not stored, and for a posterior of several sequences. Use it for forecasts that include all
    uncertainty; `forecast` is for known parameters, and `posterior_trajectories` for the past.
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
