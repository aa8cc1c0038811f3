"""Every smoother by name: what is listed here inherits the contracts of `test_contracts.py`.

A smoother is tried on chains of `tests/registry.py` and on a model of two modes, on a grid; those
whose law is Gaussian are in `tests/matrix`. A new smoother is one new entry below.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import mpfjax
from mpfjax import Series, smoothing
from tests.registry import CHAINS

NUM_TRAJECTORIES, LAG = 4, 2


def statistics(previous_states, states):
    """Of n states and n more, x_{t-1}, x_t, x_t² and x_{t-1} x_t of the first object: (n, 4)."""
    earlier, later = (x.reshape(x.shape[0], -1)[:, 0] for x in (previous_states, states))
    return jnp.stack([earlier, later, later**2, earlier * later], axis=1)


def _of_paths(paths, weights):
    """The statistics of each step, (t, 4), from trajectories (k, t + 1, ...)."""
    each = jax.vmap(statistics)(paths[:, :-1], paths[:, 1:])
    return jnp.sum(weights[:, None, None] * each, axis=0)


def _genealogy(key, filter, run):
    return _of_paths(smoothing.trace_ancestors(run).trajectories, run.final.weights)


def _backward(**options):
    def smooth(key, filter, run):
        paths = smoothing.sample_trajectories(key, filter, run, NUM_TRAJECTORIES, **options)
        return _of_paths(paths, jnp.full(NUM_TRAJECTORIES, 1 / NUM_TRAJECTORIES))

    return smooth


def _online(**options):
    def smooth(key, filter, observations):
        series = Series.skipping(observations)
        found = smoothing.smoothed_sums(key, filter, series, statistics, **options)
        return found.run.log_likelihood_increments, found.sums

    return smooth


def _stepwise(key, filter, observations):
    """The terms at t - L, and after the last step those that are left; NaN is missing."""
    smoother = smoothing.FixedLagSmoother(filter, statistics, LAG, "mcmc")
    key, *keys = jax.random.split(key, 1 + len(observations))
    window, rows, increments = smoother.init(filter.init(key)), [], []
    for own, seen in zip(keys, np.asarray(observations), strict=True):
        observation = None if np.isnan(seen).all() else seen
        window, found, info = smoother.step(own, window, observation)
        rows.append(found[0])
        increments.append(info.log_likelihood_increment)
    return jnp.stack(increments), jnp.stack([*rows[LAG:], *found[-min(LAG, len(rows)) :]])


def _conditional(key, filter, observations, trajectory):
    found = smoothing.conditional_filter(key, filter, Series.skipping(observations), trajectory)
    return _of_paths(found.trajectory[None], jnp.ones(1))


class Smoother(NamedTuple):
    """A smoother in one of three forms, and what its rows are estimates of.

    - `of_run`: (key, filter, run) -> (t, 4).
    - `online`: (key, filter, observations) -> the increments of log Ẑ, and (t, 4).
    - `kernel`: (key, filter, observations, trajectory) -> (t, 4), of another trajectory with the
      law of the given one.

    Row r is the term r given all observations; with a `lag`, given those up to r + lag; with
    `summed`, the sum of the terms up to r given the observations up to r.
    """

    of_run: Callable | None = None
    online: Callable | None = None
    kernel: Callable | None = None
    lag: int | None = None
    summed: bool = False

    def rows(self, key, filter, observations, trajectory=None):
        """The increments of log Ẑ, which a kernel has not, and the rows."""
        if self.of_run:
            run = mpfjax.run_filter(key, filter, Series.skipping(observations))
            own = jax.random.fold_in(key, 1)
            return run.log_likelihood_increments, self.of_run(own, filter, run)
        if self.online:
            return self.online(key, filter, observations)
        rows = self.kernel(key, filter, observations, trajectory)
        return jnp.zeros(len(observations)), rows


SMOOTHERS = {
    "genealogy": Smoother(of_run=_genealogy),
    "backward sampling": Smoother(of_run=_backward()),
    "backward sampling, MCMC": Smoother(of_run=_backward(method="mcmc")),
    "PaRIS": Smoother(online=_online(), summed=True),
    "PaRIS, MCMC": Smoother(online=_online(method="mcmc"), summed=True),
    "fixed lag": Smoother(online=_stepwise, lag=LAG),
    "conditional filter": Smoother(kernel=_conditional),
}

QUADRATIC = mpfjax.QuadraticModel(0.3, 0.4, -2.0, 2.0)
OBSERVATIONS = np.array([1.2, 0.8, np.nan, 1.5, 1.0], np.float32)

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


CASES = [(name, chain) for name, smoother in SMOOTHERS.items() for chain in chains_of(smoother)]
# What takes a way of its own; the smoothers of a run share one program.
QUICK_CASES = [
    *((name, "pf") for name in SMOOTHERS if SMOOTHERS[name].of_run),
    *((name, "mpf") for name in ("PaRIS", "fixed lag", "conditional filter")),
]
