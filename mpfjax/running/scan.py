"""One run of a filter as one scan."""

import inspect
import math
import warnings
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Key, PyTree

from mpfjax.checks import saying, warn
from mpfjax.filter import Filter, with_densities
from mpfjax.memory import check_run, warnings_of
from mpfjax.mixture import ParticleMixture
from mpfjax.models.observations import Series
from mpfjax.moves.initial import SelectInitial
from mpfjax.operations.islands import num_islands
from mpfjax.operations.random import split, split_for_run
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
    num_initial, num_moves = 1 + len(filter.initial_moves), len(filter.moves)
    keys_initial, keys = split_for_run(key, num_initial, series.length, num_moves)

    def advance(
        mixture: ParticleMixture, step: tuple[Array, Series, Array | None]
    ) -> tuple[ParticleMixture, PyTree]:
        step_keys, now, t = step
        mixture, info = step_or_predict(filter, step_keys, mixture, now)
        with saying("collect", "called with the mixture after each step"):
            arguments: tuple[Any, ...] = (mixture,) if t is None else (mixture, t, now.inputs)
            values = mixture if collect is None else collect(*arguments)
        return mixture, (values, report_of(info))

    if initial is None:
        initial = first_mixture(keys_initial, filter, series)
    check_run(initial.memory, series.length)
    times = jnp.arange(1, series.length + 1) if takes_time(collect) else None
    final, outputs = jax.lax.scan(advance, initial, (keys, series, times))
    return run_of(initial, final, *outputs)


def takes_time(collect: Any) -> bool:
    """Whether `collect` takes (mixture, t, u_t), and not the mixture alone."""
    try:
        inspect.signature(collect).bind(None)
    except TypeError:
        return collect is not None
    except ValueError:  # functions not written in Python cannot be inspected
        pass
    return False


def initial_keys(key: Key[Array, ""], filter: Filter) -> Key[Array, " i"]:
    """The keys with which a run with this key draws and moves x_0."""
    return split(split(key, 2)[0], 1 + len(filter.initial_moves))


def first_mixture(key: Key[Array, "*keys"], filter: Filter, series: Series) -> ParticleMixture:
    """The mixture of x_0 that the first step goes on from, given y_1 where it is there.

    On islands it has the share of one of them in the mass of all.
    """
    log_islands = math.log(num_islands())
    first = jax.tree.map(lambda leaf: leaf[0], series)
    if not filter.weighs_initially:
        # Where it is missing, it tells the form of those that follow.
        mixture = filter._init(key, first.observations, first.inputs)
        return mixture.replace(log_weights=mixture.log_weights - log_islands)
    if first.present is None:
        mixture = filter._init(key, first.observations, first.inputs)
    else:
        chosen = partial(filter._init, key, first.observations, first.inputs)
        # Room for observations is there in any case.
        mixture = jax.lax.cond(
            first.present,
            chosen,
            lambda: filter._init(key, inputs=first.inputs).replace(memory=chosen().memory),
        )
    return mixture.replace(log_scale=mixture.log_scale - log_islands)


_KEPT = (
    "resampled",
    "degenerate",
    "effective_sample_size",
    "log_evidence_against_start",
    "alarm",
)
# The effective number of fewer particles tells nothing.
_NEARLY_ALL, _FEWEST_TOLD = 0.9, 8
# A run is lost if so many of the last steps have fewer than two effective particles; or if their
# increments are lower than the highest ones by this many nats, and this many times the spread of
# these, at an effective sample size below this share of N. Chosen on fifteen models, about 25 rules
# tried: 1 of 3 399 good runs is reported, and 563 of 1 745 lost ones.
_LAST, _LAST_ALONE, _LEAST_FALL, _FALLS, _LARGE = 10, 8, 20.0, 10.0, 0.6
_MOST_LOOKED_AT = 16  # runs, for what is told of their start
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
    return FilterRun(
        log_marginal_likelihood=jnp.sum(reports["log_likelihood_increments"]),
        collected=collected,
        initial=initial,
        final=final,
        **reports,
    )


def step_or_predict(
    filter: Filter,
    key: Key[Array, "*keys"],
    mixture: ParticleMixture,
    now: Series,
) -> tuple[ParticleMixture, StepInfo]:
    """A step of the filter, or a prediction where the observation is missing; `now` is of one t."""
    if now.present is None:
        return filter._step(key, mixture, now.observations, now.inputs)
    return jax.lax.cond(
        now.present,
        lambda: filter._step(key, mixture, now.observations, now.inputs),
        lambda: filter._step(key, mixture, inputs=now.inputs),
    )


def sound(run: FilterRun, free: bool = True) -> FilterRun:
    """The run, or an error where a density of the model was NaN or infinite.

    A RuntimeWarning, one for all runs, where no step of a run had any likelihood, where one
    particle had all weight in nearly all steps of a `free` run, which keeps no given trajectory,
    and where at the end all hypotheses seem wrong.
    """
    increments = run.log_likelihood_increments
    run = with_densities(run, increments)
    if isinstance(increments, Tracer):
        return run
    for text in warnings_of(run.final.memory):
        warn(text)
    degenerate = np.asarray(run.degenerate)
    is_blind = degenerate.any(axis=-1) & (degenerate | (np.asarray(increments) == 0)).all(axis=-1)
    if is_blind.any():
        which = _in_how_many(is_blind)
        cause = f"every step with an observation was degenerate{which}: every particle had zero"
        cause += " likelihood; mpfjax.check_model tests a model"
        warn(cause)
    weighed = (np.asarray(increments) != 0) & ~degenerate
    num_weighed, is_alone = weighed.sum(axis=-1), np.asarray(run.effective_sample_size) < 2
    is_poor = (weighed & is_alone).sum(axis=-1) >= np.maximum(_NEARLY_ALL * num_weighed, 2)
    # Wrong units show in most runs; a few that lost the state tell nothing of the model.
    filled = np.asarray(run.initial.log_weights) > -np.inf
    if free and is_poor.mean() > 0.5 and filled.sum(axis=-1).min() >= _FEWEST_TOLD:
        cause = "one particle had nearly all weight in nearly all steps with an observation"
        cause += f"{_in_how_many(is_poor)}: run.effective_sample_size is below 2. Are y and the"
        warn(f"{cause} model in the same units, and is its observation noise not too small?")
    elif free and run.alarm is None:
        sizes = np.asarray(run.effective_sample_size) / filled.sum(axis=-1)[..., None]
        _warn_of_lost(sizes, is_alone | degenerate, weighed | degenerate, np.asarray(increments))
    if run.alarm is not None and np.any(run.alarm[..., -1]):
        alarm = np.asarray(run.alarm)
        is_lost = alarm[..., -1]
        which = _in_how_many(is_lost)
        first = int(np.argmax(alarm.reshape(-1, alarm.shape[-1]).any(axis=0)))
        cause = f"at the end, the observations speak against all hypotheses{which}, first at"
        cause += f" index {first} of the steps: run.alarm; mpfjax.with_restarts lets the state"
        warn(f"{cause} restart")
    return run


def _warn_of_lost(
    sizes: Float[np.ndarray, "*runs t"],
    is_alone: Bool[np.ndarray, "*runs t"],
    is_weighed: Bool[np.ndarray, "*runs t"],
    increments: Float[np.ndarray, "*runs t"],
) -> None:
    """A RuntimeWarning for runs that end with one particle, or far from what is observed.

    `sizes` are the effective sample sizes as shares of N. The increments at the end are compared
    with the highest of the run.
    """
    from_the_end = np.cumsum(is_weighed[..., ::-1], axis=-1)[..., ::-1]
    recent = is_weighed & (from_the_end <= _LAST)
    with warnings.catch_warnings(), np.errstate(invalid="ignore"):
        warnings.simplefilter("ignore", RuntimeWarning)  # a run without a weighed step
        at_steps = np.where(is_weighed, increments, np.nan)
        high, usual = np.nanquantile(at_steps, (0.9, 0.8), axis=-1)
        least = high - _LEAST_FALL - _FALLS * (high - usual)
        is_far = np.nanmedian(np.where(recent, increments, np.nan), axis=-1) < least
        is_far &= np.nanmedian(np.where(recent, sizes, np.nan), axis=-1) < _LARGE
    is_lost = is_far | ((recent & is_alone).sum(axis=-1) >= _LAST_ALONE)
    is_lost &= from_the_end[..., 0] >= 2 * _LAST
    if is_lost.any():
        is_bad = is_weighed & (is_alone | (increments < least[..., None]))
        bad_from_the_end = np.cumsum(is_bad[..., ::-1], axis=-1)[..., ::-1]
        is_after = is_bad & (bad_from_the_end >= _LAST_ALONE / _LAST * from_the_end)
        first = 1 + int(np.argmax(is_after, axis=-1)[is_lost].min())
        who = f"{is_lost.sum()} of {is_lost.size} runs" if is_lost.ndim else "the run"
        warn(
            f"{who} lost the state, from step {first} on: the particles are far from what is"
            " observed, or one has nearly all weight. mpfjax.with_alarm tells when all hypotheses"
            " are wrong, and mpfjax.with_restarts restarts them; see Running and diagnosing"
        )


def _in_how_many(which: np.ndarray | np.bool_) -> str:
    """In how many of several runs, and nothing for one run."""
    return f" in {which.sum()} of {which.size} runs" if which.ndim else ""


def warn_of_start(run: FilterRun, filter: Filter) -> FilterRun:
    """The run, after a RuntimeWarning where few draws of x_0 fit y_1, in most of the first runs."""
    weights = run.initial.log_weights
    chosen = [move for move in filter.initial_moves if isinstance(move, SelectInitial)]
    if not chosen or isinstance(weights, Tracer):
        return run
    looked_at = np.asarray(weights).reshape(-1, weights.shape[-1])[:_MOST_LOOKED_AT]
    if np.mean([chosen[0].is_wide(each) for each in looked_at]) > 0.5:
        cause = f"hardly any draw of x_0 fits the first observation, of {chosen[0].num_draws} for"
        cause += " each particle, so that chance decides which modes survive and their weights."
        cause += " mpfjax.with_initialisation samples x_0 given the first observations; it"
        warn(f"{cause} needs the density of x_0, log_initial, in the model")
    return run
