"""The questions of the matrix: each asks one thing of a model, its data and a filter.

A `Row` is a model and a filter; its questions share programs and runs.
"""

import copy
import dataclasses
import functools
import pickle
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

import mpfjax
from mpfjax import smoothing, tuning
from mpfjax.moves.base import all_of
from tests.matrix import law as exact
from tests.matrix.data import Y, case
from tests.matrix.filters import FILTERS, OF_ANOTHER_LAW, OF_OTHER_EVIDENCE, N
from tests.matrix.models import FORMS, moments_of
from tests.unbiased import assert_unbiased

NUM_RUNS = 1000
KEYS = jax.random.split(jax.random.key(0), NUM_RUNS)
# What rounding may do to log Z: a shift of a million leaves a sixteenth of a step.
SLACK = {"shift up": 0.13, "shift down": 0.13}
LEAST, OF_APPROXIMATE = 4e-3, 0.1


def unit_of(case):
    return float(np.sqrt(case.answer.variances[-1]))


class Row:
    """A form of the model and a filter."""

    def __init__(self, form: str, filter: str) -> None:
        self.form, self.name, self.make = FORMS[form], filter, FILTERS[filter]
        self.moments = moments_of(self.form)
        self.case = functools.cache(lambda data: case(form, data))
        self.filter = functools.cache(lambda data: self.make(self.case(data).model))
        self._runs = functools.cache(self._of_runs)

    def runs(self, data: str, slots: int | None = None):
        """A thousand runs, with their warnings each time that they are asked for."""
        run, caught = self._runs(data, slots)
        for warning in caught:
            warnings.warn(warning.message, stacklevel=2)
        return run

    def _of_runs(self, data: str, slots: int | None):
        filter, series = self.filter(data), self.case(data).series
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            return mpfjax.monte_carlo(KEYS, filter, series, self.moments, num_slots=slots), caught

    def ratios(self, data, increments):
        """Ẑ/Z of each run, but for the steps without any likelihood."""
        case = self.case(data)
        gaps = np.asarray(increments, float) - case.answer.increments
        return np.exp(np.where(np.isfinite(gaps), gaps, 0.0).sum(axis=-1))

    def check(self, data, ratios, first=None, second=None, expected=None):
        """The estimates of all runs are those of the answer, within four standard errors."""
        case, approximate = self.case(data), self.filter(data).approximate
        if approximate and self.name in OF_ANOTHER_LAW:
            return
        slack = SLACK.get(data, LEAST) + OF_APPROXIMATE * approximate
        if first is None:
            assert_unbiased(ratios, loosest=0.7 if data == "wide prior" else 0.06, slack=slack)
            return
        mean, variance = expected or (case.answer.means[-1], case.answer.variances[-1])
        # In standard deviations of x about its mean, so that no digit is lost to large numbers.
        gaps = (np.asarray(first, float) - mean) / np.sqrt(variance)
        weights = np.ones_like(ratios) if approximate else ratios
        assert_unbiased(weights * gaps, 0.0, loosest=0.06, slack=slack)
        if second is not None:
            shares = np.asarray(second, float) / variance + gaps**2
            assert_unbiased(weights * (shares - 1), 0.0, loosest=0.12, slack=2 * slack)


def evidence(row, data):
    run = row.runs(data)
    if row.name in OF_OTHER_EVIDENCE:
        return
    row.check(data, row.ratios(data, run.log_likelihood_increments))
    blind = np.arange(len(Y)) == (1 if data == "zero likelihood" else -1)
    np.testing.assert_array_equal(run.degenerate, np.broadcast_to(blind, run.degenerate.shape))


def moments(row, data):
    run = row.runs(data)
    first, second = run.collected
    ratios = row.ratios(data, run.log_likelihood_increments)
    row.check(data, ratios, first[:, -1], second[:, -1])


def slots(row, data):
    run = row.runs(data, N + 24)
    ratios = row.ratios(data, run.log_likelihood_increments)
    row.check(data, ratios)
    row.check(data, ratios, *(moment[:, -1] for moment in run.collected))


def islands(row, data):
    filter, series = row.filter(data), row.case(data).series

    def run(key):
        run = mpfjax.run_islands(
            key, filter, series, row.moments, num_islands=2
        )  # fmt: skip
        sums = [moment[-1].sum() for moment in run.collected]
        return run.log_likelihood_increments, row.moments(run.final), sums

    increments, found, sums = jax.jit(jax.vmap(run))(KEYS)
    ratios = row.ratios(data, increments)
    row.check(data, ratios)
    row.check(data, ratios, *found)
    row.check(data, ratios, *sums)


def data_of_steps(case):
    """y_1, None where it is missing, and u_1; and of every step."""
    series = mpfjax.models.series.as_series(case.series, case.model)

    def at(tree, t):
        return jax.tree.map(lambda leaf: jnp.asarray(leaf[t]), tree)

    is_there = np.ones(len(Y), bool) if series.present is None else np.asarray(series.present)
    return [
        (at(series.observations, t) if is_there[t] else None, at(series.inputs, t))
        for t in range(len(Y))
    ]


def stepped(row, data, after=lambda filter, mixture: (filter, mixture)):
    """The mixtures and increments of one run, step by step."""
    filter, steps = row.filter(data), data_of_steps(row.case(data))
    key_initial, key_steps = jax.random.split(KEYS[0])
    mixture, increments = filter.init(key_initial, steps[0][0], inputs=steps[0][1]), []
    for t, (key, (seen, now)) in enumerate(
        zip(jax.random.split(key_steps, len(Y)), steps, strict=True)
    ):
        if seen is None:
            mixture, info = filter.predict(key, mixture, inputs=now)
        else:
            mixture, info = filter.step(key, mixture, seen, inputs=now)
        increments.append(float(info.log_likelihood_increment))
        if t < 2:
            filter, mixture = after(filter, mixture)
    return mixture, np.array(increments)


def same(row, data, found):
    """A run's increments and moments are those of these steps."""
    run = mpfjax.run_filter(KEYS[0], row.filter(data), row.case(data).series, row.moments)
    mixture, increments = found
    slack = SLACK.get(data, 1e-3)
    np.testing.assert_allclose(increments, run.log_likelihood_increments, rtol=1e-3, atol=slack)
    expected = [np.asarray(moment[-1]) for moment in run.collected]
    unit = unit_of(row.case(data))
    np.testing.assert_allclose(row.moments(mixture)[0] / unit, expected[0] / unit, atol=2e-2)


def steps(row, data):
    same(row, data, stepped(row, data))


def checkpoint(row, data):
    def stored(filter, mixture):
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "state.npz"
            mpfjax.save_checkpoint(path, mixture)
            like = jax.tree.map(jnp.zeros_like, mixture)
            return filter, mpfjax.load_checkpoint(path, like)

    same(row, data, stepped(row, data, stored))


def pickled(row, data):
    def there_and_back(filter, mixture):
        filter = copy.deepcopy(pickle.loads(pickle.dumps(filter)))
        return filter, pickle.loads(pickle.dumps(mixture))

    same(row, data, stepped(row, data, there_and_back))


def forecast(row, data):
    case, filter, run = row.case(data), row.filter(data), row.runs(data)
    inputs = case.series.inputs
    if inputs is not None:
        inputs = jax.tree.map(lambda leaf: leaf[:1], inputs)

    def ahead(key, mixture):
        mixtures = mpfjax.forecast(key, filter, mixture, 1, inputs=inputs).mixtures
        return row.moments(jax.tree.map(lambda leaf: leaf[0], mixtures))

    found = jax.jit(jax.vmap(ahead))(KEYS, run.final)
    ratios = row.ratios(data, run.log_likelihood_increments)
    row.check(data, ratios, *found, expected=case.answer.ahead)


def predictions(row, data):
    """x_t given y_1..y_{t-1}, of the last step of a run."""
    case, filter = row.case(data), row.filter(data)

    def before(key):
        run = mpfjax.run_filter(key, filter, case.series)
        inputs = case.series.inputs
        found = mpfjax.one_step_predictions(jax.random.fold_in(key, 7), filter, run, inputs=inputs)
        last = jax.tree.map(lambda leaf: leaf[-1], found.mixtures)
        return run.log_likelihood_increments.at[-1].set(0.0), row.moments(last)

    increments, found = jax.jit(jax.vmap(before))(KEYS)
    answer = row.form.answer(case.law, np.append(case.y[:-1], np.nan), case.u)
    ratios = np.exp(np.asarray(increments, float) - answer.increments).prod(axis=-1)
    row.check(data, ratios, *found, expected=(answer.means[-1], answer.variances[-1]))


def score_with(change):
    """The derivative of log Ẑ of the changed filter, unless it declares that it is biased."""

    def ask(row, data):
        case, filter = row.case(data), change(row.filter(data))
        biased = any(move.biases_score for move in all_of((*filter.initial_moves, *filter.moves)))
        if biased or row.name in OF_OTHER_EVIDENCE:
            return
        names = ("a", "q", "r", "m0")

        def log_evidence(numbers, key):
            law = case.law._replace(**numbers)
            inputs = row.form.inputs and jax.tree.map(jnp.asarray, row.form.inputs(law, case.u))
            filter = change(row.make(row.form.make(law)))
            series = dataclasses.replace(case.series, inputs=inputs)
            run = mpfjax.run_filter(key, filter, series, lambda mixture: None)
            return run.log_marginal_likelihood, run.log_likelihood_increments

        numbers = {name: jnp.asarray(float(getattr(case.law, name))) for name in names}
        slope = jax.jit(jax.vmap(jax.grad(log_evidence, has_aux=True), in_axes=(None, 0)))
        slopes, increments = slope(numbers, KEYS)
        ratios = row.ratios(data, increments)
        slack = 0.02 + 0.3 * filter.approximate
        for name in names:
            expected = exact.score(case.law, case.y, case.u, name, row.form.answer)
            values = ratios * np.asarray(slopes[name], float)
            assert_unbiased(values, expected, loosest=0.5, slack=slack)

    return ask


def terms_of(row):
    """x_{s-1}, x_s and x_{s-1} x_s of all particles, or of one if the model is `per_particle`."""

    def terms(before, now):
        if jax.tree.leaves(now)[0].ndim == 0:
            return terms(before[None], now[None])[0]
        first, second = row.form.value(before), row.form.value(now)
        return jnp.stack([first, second, first * second], axis=-1)

    return terms


def of_paths(row, paths):
    """The terms of the steps of each trajectory, (k, t, 3)."""
    before = jax.tree.map(lambda leaf: leaf[:, :-1], paths)
    return jax.vmap(terms_of(row))(before, jax.tree.map(lambda leaf: leaf[:, 1:], paths))


def smoothed(row, data, smooth, is_average=False):
    """Ẑ/Z times the smoothed terms of the steps 1, ..., t, or times their average over time."""
    case = row.case(data)
    increments, found = jax.jit(jax.vmap(smooth))(KEYS[:300])
    if np.isnan(found).any():  # a program cannot say why
        smooth(KEYS[0])
    if row.name in OF_ANOTHER_LAW:
        return
    means, unit = case.answer.smoothed, unit_of(case)
    expected = np.stack([means[:-1], means[1:], case.answer.pairs], axis=1)
    units = unit * np.array([1, 1, unit + np.abs(means).max()])
    expected = expected.mean(axis=0) if is_average else expected
    gaps = (np.asarray(found, float) - expected) / units
    if hasattr(case.model, "dynamics"):  # particles that are moments: no product is known
        gaps = gaps[..., :2]
    ratios = row.ratios(data, increments).reshape(-1, *[1] * (gaps.ndim - 1))
    assert_unbiased(ratios * gaps, 0.0, loosest=0.1, slack=SLACK.get(data, LEAST))


def of_run(method):
    def ask(row, data):
        case, filter = row.case(data), row.filter(data)

        def smooth(key):
            run = mpfjax.run_filter(key, filter, case.series)
            paths = method(jax.random.fold_in(key, 7), filter, run, case.series)
            return run.log_likelihood_increments, of_paths(row, paths).mean(axis=0)

        smoothed(row, data, smooth)

    return ask


def backward(**options):
    def draw(key, filter, run, series):
        is_linear = hasattr(filter.model, "dynamics")
        data = {"observations": series} if is_linear else {"inputs": series.inputs}
        return smoothing.sample_trajectories(key, filter, run, 8, **data, **options)

    return of_run(draw)


def sums(**options):
    def ask(row, data):
        case, filter = row.case(data), row.filter(data)

        def smooth(key):
            found = smoothing.smoothed_sums(key, filter, case.series, terms_of(row), **options)
            return found.run.log_likelihood_increments, found.sums[-1] / len(Y)

        smoothed(row, data, smooth, is_average=True)

    return ask


def fixed_lag(row, data):
    """The terms of all steps, where the lag is the whole run."""
    filter, steps = row.filter(data), data_of_steps(row.case(data))
    smoother = smoothing.FixedLagSmoother(filter, terms_of(row), len(Y) - 1)

    def smooth(key):
        key, *keys = jax.random.split(key, len(Y) + 1)
        window = smoother.init(filter.init(key, steps[0][0], inputs=steps[0][1]))
        increments = []
        for key, (seen, now) in zip(keys, steps, strict=True):
            window, estimates, info = smoother.step(key, window, seen, inputs=now)
            increments.append(info.log_likelihood_increment)
        return jnp.stack(increments), estimates

    smoothed(row, data, smooth)


def genealogy(row, data):
    case, filter = row.case(data), row.filter(data)

    def smooth(key):
        run = mpfjax.run_filter(key, filter, case.series)
        paths = smoothing.trace_ancestors(run).trajectories
        return run.log_likelihood_increments, run.final.expectation(of_paths(row, paths))

    smoothed(row, data, smooth)


def conditional(row, data):
    """Chains from an ordinary run's trajectory: a draw of theirs has the smoothing law."""
    case, filter = row.case(data), row.filter(data)

    def smooth(key):
        key, own = jax.random.split(key)
        run = mpfjax.run_filter(own, filter, case.series)
        path = jax.tree.map(
            lambda leaf: leaf[0],
            smoothing.sample_trajectories(own, filter, run, 1, inputs=case.series.inputs),
        )

        def renewed(path, own):
            path = smoothing.conditional_filter(own, filter, case.series, path).trajectory
            return path, path

        _, paths = jax.lax.scan(renewed, path, jax.random.split(key, 4))
        return jnp.asarray(case.answer.increments), of_paths(row, paths).mean(axis=0)

    smoothed(row, data, smooth)


def log_prior(parameters):
    return -0.5 * jnp.sum(parameters["c"] ** 2)


def sampler(run):
    """Mean and variance of c under a standard normal prior, over the chains or runs."""

    def ask(row, data):
        case, form = row.case(data), row.form
        shape = jnp.shape(form.offset(case.model))

        def sample_prior(key):
            return {"c": jax.random.normal(key, shape)}

        options = {
            "parameters": {"c": lambda filter: form.offset(filter.model)},
            "sample_prior": sample_prior,
            "progress": False,
        }
        draws, weights = run(row, data, options)
        mean, variance = exact.posterior(case.law, case.y, case.u, answer=form.answer)
        gaps = (np.reshape(draws, weights.shape).astype(float) - mean) / np.sqrt(variance)
        for power, moment in ((1, 0.0), (2, 1.0)):
            values = np.average(gaps**power, axis=1, weights=weights)
            assert_unbiased(values, moment, loosest=0.15 * power)

    return ask


WALK: dict[str, Any] = {"log_prior": log_prior, "proposal_deviations": 0.8}


def of_chains(method, row, data, **options):
    case = row.case(data)
    posterior = method(
        KEYS[0], row.filter(data), case.series, 40, num_chains=60, burn_in=30, **options
    )
    return posterior.parameters["c"], np.ones((60, 40))


@sampler
def metropolis(row, data, options):
    return of_chains(tuning.metropolis_hastings, row, data, **WALK, **options)


@sampler
def gibbs(row, data, options):
    return of_chains(tuning.particle_gibbs, row, data, **WALK, **options)


@sampler
def smc2(row, data, options):
    keys, data = jax.random.split(jax.random.key(1), 8), (row.filter(data), row.case(data).series)
    runs = [tuning.smc2(key, *data, 120, log_prior=log_prior, **options) for key in keys]
    return [run.parameters["c"] for run in runs], np.array([run.weights for run in runs])


def fisher(row, data):
    """A step of `fit` by Fisher's identity: the derivative of log Z in c, where it is not small."""
    case, form, law = row.case(data), row.form, row.case(data).law._replace(c=2.0)
    filter = row.make(form.make(law))
    options = {
        "parameters": {"c": lambda filter: form.offset(filter.model)},
        "score": "fisher",
        "num_seeds": 400,
        "progress": False,
    }

    def slope(key):
        run = tuning.fit(key, filter, case.series, optax.sgd(1.0), 1, **options)
        return float(np.sum(run.parameters["c"] - form.offset(filter.model)))

    slopes = [slope(key) for key in KEYS[:10]]
    if row.name not in OF_ANOTHER_LAW:
        expected = exact.score(law, case.y, case.u, "c", form.answer)
        assert_unbiased(slopes, expected, loosest=0.1, slack=0.02 + 0.3 * filter.approximate)


# The first share one program for all data, and one more where something is missing.
OF_RUNS: dict[str, Callable] = {"log Z": evidence, "moments": moments}
OTHERS: dict[str, Callable] = {
    "steps": steps,
    "checkpoint": checkpoint,
    "pickle": pickled,
    "slots": slots,
    "islands": islands,
    "forecast": forecast,
    "predictions": predictions,
    "derivative": score_with(lambda filter: filter),
    "score": score_with(mpfjax.with_score_gradient),
    "Fisher": fisher,
    "trajectories": backward(),
    "trajectories, mcmc": backward(method="mcmc"),
    "sums": sums(),
    "sums, mcmc": sums(method="mcmc"),
    "fixed lag": fixed_lag,
    "genealogy": genealogy,
    "conditional filter": conditional,
    "Metropolis": metropolis,
    "Gibbs": gibbs,
    "SMC²": smc2,
}
QUESTIONS = OF_RUNS | OTHERS
