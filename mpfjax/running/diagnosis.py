"""What a finished run says against itself: errors and warnings, outside of the program."""

import warnings

import numpy as np
from jax.core import Tracer
from jaxtyping import Bool, Float

from mpfjax.checks import warn
from mpfjax.filter import Filter
from mpfjax.moves.initial import SelectInitial
from mpfjax.report import with_densities
from mpfjax.running.results import FilterRun

# The effective number of fewer particles tells nothing.
_NEARLY_ALL, _FEWEST_TOLD = 0.9, 8
# A run is lost if so many of the last steps have fewer than two effective particles; or if their
# increments are lower than the highest ones by this many nats, and this many times the spread of
# these, at an effective sample size below this share of N. Chosen on fifteen models, about 25 rules
# tried: 1 of 3 399 good runs is reported, and 563 of 1 745 lost ones.
_LAST, _LAST_ALONE, _LEAST_FALL, _FALLS, _LARGE = 10, 8, 20.0, 10.0, 0.6
_MOST_LOOKED_AT = 16  # runs, for what is told of their start


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
        which = _in_how_many(alarm[..., -1])
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
