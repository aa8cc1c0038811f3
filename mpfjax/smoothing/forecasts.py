"""Forecasts: the mixture several steps ahead, with its components, and simulated observations."""

from typing import Any

import equinox as eqx
import jax
from jaxtyping import Array, Key, PyTree

from mpfjax.checks import Count, check_one_each, checked
from mpfjax.filter import Filter
from mpfjax.mixture import ParticleMixture
from mpfjax.models.base import with_inputs
from mpfjax.models.observations import steps_of_inputs
from mpfjax.operations.compiling import jit_with_floats_traced


class Forecast(eqx.Module):
    """The predictive distribution of a filter for the next k steps, as weighted draws.

    - `mixtures`: the mixtures at t + 1, ..., t + k, stacked: components keep their labels as far as
      the filter's regrouping allows. `jax.vmap` maps derived quantities over them.
    - `observations`: one simulated observation for each particle, leaves (k, n, ...), weighted by
      its particle; None for a model without `sample_observation`.

    The draws are weighted, so compute intervals by `ParticleMixture.quantile` and not
    `jnp.quantile`: `jax.vmap(lambda mixture, y: mixture.quantile(y, [0.05, 0.95]))(mixtures,
    observations)`.
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
    inputs: PyTree = None,
) -> Forecast:
    """The distribution of x_{t+1}, ..., x_{t+k} given y_1..y_t, from the mixture at t.

    Every step is the filter's `predict`: the particles are propagated and regrouped, and components
    keep their weights, so that a mixture weight is the probability of its mode.

    - `inputs`: u_{t+1}, ..., u_{t+k}, the known inputs of the future steps, as for `run_filter`.

    If the model has `sample_observation(key, states)`, y is drawn given each of the states, for
    intervals of future observations.

    Use a `key` that is used nowhere else, and not `jax.random.fold_in(key, 1)` of the run's key,
    which the run has used.

    Raises `ValueError` for arguments of another kind, for moves whose effect without an observation
    is unknown, and for simulated observations that are not one per particle. Use it for forecasts
    with intervals, and to score a filter by its forecasts.
    """
    inputs = steps_of_inputs(inputs, num_steps, filter.model, "forecast")
    return _forecast(key, filter, mixture, inputs, num_steps)


@jit_with_floats_traced
def _forecast(key, filter, mixture, inputs, num_steps):
    def advance(
        mixture: ParticleMixture, step: tuple[Array, PyTree]
    ) -> tuple[ParticleMixture, Any]:
        key, now = step
        key_step, key_observation = jax.random.split(key)
        mixture, _ = filter._step(key_step, mixture, inputs=now)
        model, observations = with_inputs(filter.model, now), None
        simulate = getattr(model, "sample_observation", None)
        if callable(simulate):
            observations = simulate(key_observation, mixture.particles)
            check_one_each(mixture.num_particles, sample_observation=observations)
        return mixture, (mixture, observations)

    steps = (jax.random.split(key, num_steps), inputs)
    _, (mixtures, observations) = jax.lax.scan(advance, mixture, steps)
    return Forecast(mixtures, observations)
