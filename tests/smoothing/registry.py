"""Every smoother by name: what is listed here inherits the contracts of `test_contracts.py`.

A smoother is tried on chains of `tests/registry.py` and on models whose smoothing distribution is
known. A new smoother is one new entry below; the tests then find it.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import mpfjax
from mpfjax import Series
from mpfjax.smoothing import (
    FixedLagSmoother,
    conditional_filter,
    sample_trajectories,
    smoothed_sums,
    trace_ancestors,
)
from tests.registry import CHAINS

NUM_TRAJECTORIES, LAG = 4, 2


def statistics_for(model):
    """Means, second moments and pairs of one object, or the first one of several.

    x_{t-1}, x_t, x_t x_tᵀ and x_{t-1} x_tᵀ, side by side: a function of n states and n more.
    """
    one = model.object_at(0) if isinstance(model, mpfjax.MultiObjectModel) else model
    d = jax.eval_shape(lambda key: one.sample_initial(key, 1), jax.random.key(0)).size

    def statistics(previous_states, states):
        n = states.shape[0]
        earlier, later = (leaf.reshape(n, -1)[:, :d] for leaf in (previous_states, states))
        products = [left[:, :, None] * later[:, None, :] for left in (later, earlier)]
        rows = [product.reshape(n, -1) for product in products]
        return jnp.concatenate([earlier, later, *rows], axis=1)

    return statistics


def _of_paths(model, paths, weights):
    """The statistics of each step, (t, s), from trajectories (k, t + 1, ...)."""
    each = jax.vmap(statistics_for(model))(paths[:, :-1], paths[:, 1:])
    return jnp.sum(weights[:, None, None] * each, axis=0)


def _genealogy(key, filter, run, inputs=None):
    return _of_paths(filter.model, trace_ancestors(run).trajectories, run.final.weights)


def _backward(**options):
    def smooth(key, filter, run, inputs=None):
        paths = sample_trajectories(key, filter, run, NUM_TRAJECTORIES, inputs=inputs, **options)
        return _of_paths(filter.model, paths, jnp.full(NUM_TRAJECTORIES, 1 / NUM_TRAJECTORIES))

    return smooth


def _online(**options):
    def smooth(key, filter, observations, inputs=None):
        series, function = Series.skipping(observations, inputs), statistics_for(filter.model)
        found = smoothed_sums(key, filter, series, function, **options)
        return found.run.log_likelihood_increments, found.sums

    return smooth


def _stepwise(key, filter, observations, inputs=None):
    """The terms at t - L, and after the last step those that are left; NaN is missing."""
    smoother = FixedLagSmoother(filter, statistics_for(filter.model), LAG, "mcmc")
    key, *keys = jax.random.split(key, 1 + len(observations))
    window, rows, increments = smoother.init(filter.init(key)), [], []
    for t, seen in enumerate(np.asarray(observations)):
        seen, given = None if np.isnan(seen).all() else seen, None if inputs is None else inputs[t]
        window, found, info = smoother.step(keys[t], window, seen, inputs=given)
        rows.append(found[0])
        increments.append(info.log_likelihood_increment)
    return jnp.stack(increments), jnp.stack([*rows[LAG:], *found[-min(LAG, len(rows)) :]])


def _conditional(key, filter, observations, trajectory, inputs=None):
    series = Series.skipping(observations, inputs)
    found = conditional_filter(key, filter, series, trajectory).trajectory
    return _of_paths(filter.model, found[None], jnp.ones(1))


class Smoother(NamedTuple):
    """A smoother in one of three forms, and what its rows are estimates of.

    - `of_run`: (key, filter, run, inputs) -> (t, s).
    - `online`: (key, filter, observations, inputs) -> the increments of log Ẑ, and (t, s).
    - `kernel`: (key, filter, observations, trajectory, inputs) -> (t, s), of another trajectory
      with the law of the given one.

    Row r is the term r given all observations; with a `lag`, given those up to r + lag; with
    `summed`, the sum of the terms up to r given the observations up to r.
    """

    of_run: Callable | None = None
    online: Callable | None = None
    kernel: Callable | None = None
    lag: int | None = None
    summed: bool = False


SMOOTHERS = {
    "genealogy": Smoother(of_run=_genealogy),
    "backward sampling": Smoother(of_run=_backward()),
    "backward sampling, MCMC": Smoother(of_run=_backward(method="mcmc")),
    "PaRIS": Smoother(online=_online(), summed=True),
    "PaRIS, MCMC": Smoother(online=_online(method="mcmc"), summed=True),
    "fixed lag": Smoother(online=_stepwise, lag=LAG),
    "conditional filter": Smoother(kernel=_conditional),
}

ONE = mpfjax.LinearGaussianModel(
    A=[[0.9]], Q=[[0.3]], H=[[1.0]], R=[[0.4]], m0=[0.5], P0=[[1.0]], B=[[1.0]]
)
FOUR = mpfjax.LinearGaussianModel(
    A=0.9 * np.eye(4) + 0.1 * np.eye(4, k=1), Q=0.2 * np.eye(4) + 0.1, B=np.eye(4, 1),
    H=np.eye(2, 4), R=0.5 * np.eye(2), m0=np.full(4, 0.3), P0=np.eye(4),
)  # fmt: skip
QUADRATIC = mpfjax.QuadraticModel(0.3, 0.4, -2.0, 2.0)
NAN = np.nan
MODELS = {
    "one dimension": (ONE, np.array([[0.8], [NAN], [0.1], [-0.4], [0.9]], np.float32)),
    "four dimensions": (
        FOUR, np.array([[0.8, 0.1], [NAN, NAN], [0.5, -1.0], [1.2, 0.3]], np.float32)
    ),
    "two modes": (QUADRATIC, np.array([1.2, 0.8, NAN, 1.5, 1.0], np.float32)),
}  # fmt: skip
# u_t, each unlike the others, so that one of another step is seen.
INPUTS = {
    "one dimension": np.array([[0.5], [-0.4], [0.3], [-0.9], [0.7]], np.float32),
    "four dimensions": np.array([[0.6], [-0.5], [0.9], [-0.2]], np.float32),
    "two modes": None,
}

# One of each kind of filter that knows its own evidence, for the smoothers of a run.
SMOOTHED_CHAINS = (
    "pf", "pf adaptive", "guided pf", "mpf", "auxiliary mpf", "ps adaptive, another order", "dps",
)  # fmt: skip
# The others run a filter of their own, and are compiled one by one.
ONLINE_CHAINS = ("pf", "mpf", "dps")
# Those that can keep a trajectory: see `check_conditional`.
KERNEL_CHAINS = ("pf", "guided pf", "mpf")
assert set(SMOOTHED_CHAINS) <= set(CHAINS)


def chains_of(smoother):
    """The chains that a smoother is tried on."""
    if smoother.of_run:
        return SMOOTHED_CHAINS
    return ONLINE_CHAINS if smoother.online else KERNEL_CHAINS


CASES = [
    (name, chain, model)
    for name, smoother in SMOOTHERS.items()
    for chain in chains_of(smoother)
    for model in MODELS
]
# What takes a way of its own; the smoothers of a run share one program.
QUICK_CASES = [
    *((name, "pf", "four dimensions") for name in SMOOTHERS if SMOOTHERS[name].of_run),
    ("PaRIS", "mpf", "two modes"),
    ("fixed lag", "mpf", "one dimension"),
    ("conditional filter", "mpf", "one dimension"),
]  # fmt: skip
