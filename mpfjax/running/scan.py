"""One run of a filter as one scan."""

import math
from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Key, PyTree

from mpfjax.checks import saying
from mpfjax.filter import Filter
from mpfjax.memory import memories_of
from mpfjax.mixture import ParticleMixture
from mpfjax.models.series import Series
from mpfjax.operations.islands import num_islands
from mpfjax.operations.random import split, split_each
from mpfjax.report import StepInfo
from mpfjax.running.results import FilterRun


def scan(
    key: Key[Array, ""],
    filter: Filter,
    series: Series,
    collect: Callable[[ParticleMixture], PyTree] | None,
    initial: ParticleMixture | None = None,
) -> FilterRun:
    """`run_filter` under the caller's jit, its arguments unchecked, from an `initial` mixture."""
    step_keys = split(split(key, 2)[1], series.length)
    keys = split_each(step_keys, len(filter.moves))

    def advance(mixture: ParticleMixture, step: PyTree) -> tuple[ParticleMixture, PyTree]:
        step_keys, now = step
        mixture, info = step_or_predict(filter, step_keys, mixture, now)
        with saying("collect", "called with the mixture after each step"):
            values = mixture if collect is None else collect(mixture)
        return mixture, (values, report_of(info))

    if initial is None:
        initial = first_mixture(initial_keys(key, filter), filter, series)
    for entry in memories_of(initial.memory).values():
        entry.check_run(series.length)
    final, outputs = jax.lax.scan(advance, initial, (keys, series))
    return run_of(initial, final, *outputs)


def initial_keys(key: Key[Array, ""], filter: Filter) -> Key[Array, " i"]:
    """The keys with which a run with this key draws and moves x_0."""
    return split(split(key, 2)[0], 1 + len(filter.initial_moves))


def first_mixture(key: Key[Array, "*keys"], filter: Filter, series: Series) -> ParticleMixture:
    """The mixture of x_0 that the first step goes on from, given y_1 where it is there.

    On islands it has the share of one of them in the mass of all.
    """
    log_islands = math.log(num_islands())
    first = jax.tree.map(lambda leaf: leaf[0], series)
    chosen = partial(filter._init, key, first.observations, first.inputs)
    if not filter.weighs_initially:
        # Where it is missing, it tells the form of those that follow.
        mixture = chosen()
        return mixture.replace(log_weights=mixture.log_weights - log_islands)

    def unseen() -> ParticleMixture:
        # Room for observations is there in any case.
        return filter._init(key, inputs=first.inputs).replace(memory=chosen().memory)

    mixture = chosen() if first.present is None else jax.lax.cond(first.present, chosen, unseen)
    return mixture.replace(log_scale=mixture.log_scale - log_islands)


_KEPT = ("resampled", "degenerate", "effective_sample_size", "log_evidence_against_start", "alarm")
Report = dict[str, PyTree]
"""What a run keeps of a step's report, or of those of all steps."""


def report_of(info: StepInfo) -> Report:
    """The part of a step's report that a run keeps."""
    report = {name: getattr(info, name) for name in _KEPT}
    return report | {"log_likelihood_increments": info.log_likelihood_increment}


def run_of(
    initial: ParticleMixture, final: ParticleMixture, collected: PyTree, reports: Report
) -> FilterRun:
    """The `FilterRun` of these steps, whose reports are stacked."""
    log_evidence = jnp.sum(reports["log_likelihood_increments"])
    return FilterRun(log_evidence, collected=collected, initial=initial, final=final, **reports)


def step_or_predict(
    filter: Filter, key: Key[Array, "*keys"], mixture: ParticleMixture, now: Series
) -> tuple[ParticleMixture, StepInfo]:
    """A step of the filter, or a prediction where the observation is missing; `now` is of one t."""
    if now.present is None:
        return filter._step(key, mixture, now.observations, now.inputs)
    return jax.lax.cond(
        now.present,
        lambda: filter._step(key, mixture, now.observations, now.inputs),
        lambda: filter._step(key, mixture, inputs=now.inputs),
    )
