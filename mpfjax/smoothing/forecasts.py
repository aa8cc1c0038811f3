"""Forecasts: the mixture several steps ahead, with its components, and simulated observations."""

import equinox as eqx
import jax
from jaxtyping import Array, Key, PyTree

from mpfjax.checks import Count, checked
from mpfjax.filter import Filter
from mpfjax.mixture import ParticleMixture
from mpfjax.models.base import with_inputs
from mpfjax.models.law import law_of
from mpfjax.models.series import steps_of_inputs
from mpfjax.operations.compiling import jit_with_floats_traced
from mpfjax.running.results import FilterRun, after_first


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


@checked
def one_step_predictions(
    key: Key[Array, ""], filter: Filter, run: FilterRun, *, inputs: PyTree = None
) -> Forecast:
    """The distributions of x_t and y_t given y_1..y_{t-1}, for every step t of a run.

    - `run`: of this filter, with its mixtures, as `run_filter(..., collect=None)` returns.
    - `inputs`: u_1, ..., u_t, as the run had them.

    The fields of the `Forecast` have a leading axis t: `observations` are draws of y_t before it
    was observed, if the model has `sample_observation`, and count by the weights of `mixtures`.
    Raises `ValueError` for a run without its mixtures, and as `forecast` does. Use it to compare
    models by their predictions with proper scores (`metrics.crps`), and to check intervals.
    """
    if not isinstance(run.collected, ParticleMixture) or run.collected.log_weights.ndim != 2:
        raise ValueError("run: it has not the mixtures of one run; collect them by collect=None")
    before = jax.tree.map(lambda leaf: leaf[:-1], after_first(run.initial, run.collected))
    inputs = steps_of_inputs(inputs, len(run.degenerate), filter.model, "run")
    return _predictions(key, filter, before, inputs)


@jit_with_floats_traced
def _forecast(key, filter, mixture, inputs, num_steps):
    def advance(mixture: ParticleMixture, step: PyTree) -> tuple[ParticleMixture, Forecast]:
        ahead = _one_ahead(filter, step[0], mixture, step[1])
        return ahead.mixtures, ahead

    return jax.lax.scan(advance, mixture, (jax.random.split(key, num_steps), inputs))[1]


@jit_with_floats_traced
def _predictions(key, filter, mixtures, inputs):
    keys = jax.random.split(key, mixtures.log_weights.shape[0])
    return jax.lax.map(lambda step: _one_ahead(filter, *step), (keys, mixtures, inputs))


def _one_ahead(
    filter: Filter, key: Key[Array, ""], mixture: ParticleMixture, inputs: PyTree
) -> Forecast:
    key_step, key_observation = jax.random.split(key)
    mixture, _ = filter._step(key_step, mixture, inputs=inputs)
    model, observations = with_inputs(filter.model, inputs), None
    if callable(getattr(model, "sample_observation", None)):
        observations = law_of(model).observe(key_observation, mixture.particles)
    return Forecast(mixture, observations)
