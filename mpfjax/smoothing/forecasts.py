"""Forecasts: the mixture some steps ahead, with its components, and observations drawn from it."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
from jaxtyping import Array, Key, PyTree

from mpfjax.checks import Count, check_one_each, checked, saying
from mpfjax.filter import Filter
from mpfjax.mixture import ParticleMixture
from mpfjax.models.base import AbstractStateSpaceModel, mapped, with_inputs
from mpfjax.models.observations import steps_of_inputs
from mpfjax.operations.compiling import jit_with_floats_traced


class Forecast(eqx.Module):
    """The predictive distribution of a filter for the next k steps, as weighted draws.

    - `mixtures`: the mixtures at t + 1, ..., t + k, stacked: components keep their labels as far as
      the filter's regrouping allows. `jax.vmap` maps derived quantities over them.
    - `observations`: one simulated observation for each particle, leaves (k, n, ...), which counts
      by the weight of its particle; None where none were asked for.

    The draws are weighted, so take intervals by `ParticleMixture.quantile` and not `jnp.quantile`:
    `jax.vmap(lambda mixture, y: mixture.quantile(y, [0.05, 0.95]))(mixtures, observations)`.
    """

    mixtures: ParticleMixture
    observations: PyTree = None


@checked
def forecast(
    key: Key[Array, ""],
    filter: Filter,
    mixture: ParticleMixture,
    num_steps: Count,
    *,
    simulate_observation: Callable[[Key[Array, ""], PyTree], PyTree] | None = None,
    inputs: PyTree = None,
) -> Forecast:
    """The distribution of x_{t+1}, ..., x_{t+k} given y_1..y_t, from the mixture at t.

    Every step is the filter's `predict`: the particles propagate and regroup, and keep their
    masses, so that a component's mixture weight is the probability of its mode.

    - `simulate_observation(key, states)`: draws y given each of the n states, leaves (n, ...), as
      the model's likelihood would have it, for intervals of what will be observed. If the model is
      wrapped by `per_particle`, it draws y given one state, and gets a key for each.
    - `inputs`: u_{t+1}, ..., u_{t+k}, the known inputs of the steps to come, as for `run_filter`. A
      method of the model, given as `simulate_observation`, sees them too.

    Give a `key` that is used nowhere else. Do not take `jax.random.fold_in(key, 1)` of the run's
    own key, which the run has used.

    Raises `ValueError` for arguments of another kind, for moves that do not say what they do
    without an observation, and for simulated observations that are not one a particle. Use it for
    forecasts with intervals, and to score a filter by its forecasts.
    """
    simulate = mapped(filter.model, simulate_observation, draws=True)
    inputs = steps_of_inputs(inputs, num_steps, filter.model, "forecast")
    return _forecast(key, filter, mixture, inputs, num_steps, simulate)


def _given(simulate_observation: Any, inputs: PyTree) -> Any:
    """The function at a step with these inputs, which every model in it receives."""

    def is_model(node: Any) -> bool:
        return isinstance(node, AbstractStateSpaceModel)

    def give(node: Any) -> Any:
        return with_inputs(node, inputs) if is_model(node) else node

    return jax.tree.map(give, simulate_observation, is_leaf=is_model)


@jit_with_floats_traced
def _forecast(key, filter, mixture, inputs, num_steps, simulate_observation):
    def advance(
        mixture: ParticleMixture, step: tuple[Array, PyTree]
    ) -> tuple[ParticleMixture, Any]:
        key, now = step
        key_step, key_observation = jax.random.split(key)
        mixture, _ = filter.with_inputs(now)._step(key_step, mixture)
        observations = None
        if simulate_observation is not None:
            simulate = _given(simulate_observation, now)
            with saying("simulate_observation", "called with a key and the particles"):
                observations = simulate(key_observation, mixture.particles)
            check_one_each(mixture.num_particles, simulate_observation=observations)
        return mixture, (mixture, observations)

    steps = (jax.random.split(key, num_steps), inputs)
    _, (mixtures, observations) = jax.lax.scan(advance, mixture, steps)
    return Forecast(mixtures, observations)
