"""(b) Two modes of equal mass, smoothed: which methods keep both, at every time.

The quadratic model does not see the sign of the state, so that the smoothed mass of the positive
mode is one half at every time, exactly.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import mpfjax
from benchmarks import figures as plotting
from benchmarks.smoothing.filters import FILTERS, make_model, observations_of
from benchmarks.smoothing.jobs import Quadratic
from mpfjax.console import format_table
from mpfjax.smoothing import sample_trajectories, trace_ancestors

NUM_TRAJECTORIES = 1000
# Drawn in the picture, where there is room for four names.
_DRAWN = ("PF", "auxiliary MPF")
# A mode counts as lost by a seed if its smoothed mass is below this at any time 0, ..., T.
LOST = 0.01
_TOGETHER = 10  # seeds at once


def masses(job: Quadratic, num_particles: int, seeds: int, seed: int) -> dict[str, np.ndarray]:
    """The mass of the positive mode by each filter and method, (seeds, T + 1)."""
    model, observations = make_model(job), jnp.asarray(observations_of(job))
    keys = jax.random.split(jax.random.key(seed), seeds)
    found = {}
    for name, make in FILTERS.items():
        filter = make(model, num_particles)
        traced, sampled = _smoothed(keys, filter, observations)
        found[f"{name}, genealogy"] = np.asarray(traced)
        found[f"{name}, backward sampling"] = np.asarray(sampled)
    return found


@eqx.filter_jit
def _smoothed(keys: Any, filter: mpfjax.Filter, observations: Any) -> Any:
    def one(key: Any) -> tuple[Any, Any]:
        key_run, key_back = jax.random.split(key)
        run = mpfjax.run_filter(key_run, filter, observations)
        traced = run.final.average(trace_ancestors(run).trajectories > 0)
        paths = sample_trajectories(key_back, filter.model, run, NUM_TRAJECTORIES)
        return traced, jnp.mean(paths > 0, axis=0)

    return jax.lax.map(one, keys, batch_size=min(_TOGETHER, len(keys)))


def summary(found: dict[str, np.ndarray]) -> dict[str, dict[str, float]]:
    """The RMS error of the mass at its worst time, and how many seeds lost a mode."""
    result = {}
    for name, values in found.items():
        lost = np.minimum(values, 1 - values) < LOST
        errors = np.sqrt(np.mean((values - 0.5) ** 2, axis=0))
        result[name] = {
            "worst_rms_error": float(errors.max()),
            "mean_rms_error": float(errors.mean()),
            "lost_at_some_time": float(lost.any(axis=1).mean()),
            "lost_at_the_start": float(lost[:, 0].mean()),
        }
    return result


def table(results: dict[str, dict[str, float]]) -> str:
    """A row for each filter and method."""
    return format_table(
        ["filter and smoother", "RMS error", "at its worst", "a mode lost", "lost at time 0"],
        [
            [
                name,
                f"{entry['mean_rms_error']:.3f}",
                f"{entry['worst_rms_error']:.3f}",
                f"{entry['lost_at_some_time']:.1%}",
                f"{entry['lost_at_the_start']:.1%}",
            ]
            for name, entry in results.items()
        ],
    )


def picture(found: dict[str, np.ndarray]) -> Any:
    """How far from one half the mass of one mode is over time, for the PF and the best mixture."""
    curves = {
        f"{name.split()[-1]} {method.split()[0]}": np.abs(found[f"{name}, {method}"] - 0.5)
        for name in _DRAWN
        for method in ("genealogy", "backward sampling")
    }
    return plotting.draw_curves(
        curves, 0, xlabel="time t", ylabel="|mass - 1/2|",
        title="smoothed mass of one mode: mean and deviation over seeds",
    )  # fmt: skip
