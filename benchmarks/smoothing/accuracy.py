"""(a) Error against time: genealogies, backward sampling and PaRIS, ours and particles'."""

import importlib.util
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import mpfjax
from benchmarks import figures as plotting
from benchmarks.smoothing.filters import make_model, observations_of
from benchmarks.smoothing.jobs import Job
from mpfjax.console import format_table
from mpfjax.operations.compiling import jit_on_wide_vectors
from mpfjax.smoothing import sample_trajectories, smoothed_sums, trace_ancestors

NUM_TRAJECTORIES = 100
# Above these numbers of particles a method that costs N² a step, or a loop in Python, is left out.
MOST_SQUARED, MOST_IN_PYTHON = 1000, 300


def products(previous_states: Any, states: Any) -> Any:
    """x_{t-1} x_t of each particle."""
    return (previous_states * states).reshape(states.shape[0])


def _genealogy(key: Any, filter: mpfjax.Filter, observations: Any) -> Any:
    run = mpfjax.run_filter(key, filter, observations)
    paths = trace_ancestors(run).trajectories
    paths = paths.reshape(*paths.shape[:2])
    return run.final.average(jnp.mean(paths[:, :-1] * paths[:, 1:], axis=1))


def _backward(method: str) -> Callable[..., Any]:
    def estimate(key: Any, filter: mpfjax.Filter, observations: Any) -> Any:
        key_run, key_back = jax.random.split(key)
        run = mpfjax.run_filter(key_run, filter, observations)
        paths = sample_trajectories(key_back, filter.model, run, NUM_TRAJECTORIES, method=method)
        paths = paths.reshape(*paths.shape[:2])
        return jnp.mean(paths[:, :-1] * paths[:, 1:])

    return estimate


def _paris(method: str) -> Callable[..., Any]:
    def estimate(key: Any, filter: mpfjax.Filter, observations: Any) -> Any:
        found = smoothed_sums(key, filter, observations, products, method=method)
        return found.sums[-1] / observations.shape[0]

    return estimate


OURS = {
    "genealogy": _genealogy,
    "backward sampling": _backward("exact"),
    "backward sampling, MCMC": _backward("mcmc"),
    "PaRIS": _paris("exact"),
    "PaRIS, MCMC": _paris("mcmc"),
}
THEIRS = {
    "particles: backward sampling": "exact",
    "particles: backward sampling, MCMC": "mcmc",
    "particles: PaRIS": "paris",
    "particles: online, N² a step": "online",
}


def particles_is_there() -> bool:
    """Whether the rival is installed."""
    return importlib.util.find_spec("particles") is not None


def measure(job: Job, sizes: Sequence[int], runs: int, seed: int) -> list[dict[str, Any]]:
    """For each method and N the RMS error over runs and the median seconds of one."""
    entries = []
    for num_particles in sizes:
        for name, estimate in OURS.items():
            if name == "PaRIS" and num_particles > MOST_SQUARED:
                continue
            once = _ours(estimate, job, num_particles)
            entries.append(_entry(name, num_particles, job, _timed(once, runs, seed)))
        if not particles_is_there():
            continue
        from benchmarks.smoothing import through_particles

        for name, method in THEIRS.items():
            most = {"paris": MOST_IN_PYTHON, "online": MOST_SQUARED}.get(method, num_particles)
            if num_particles > most:
                continue
            once = through_particles.estimator(job, num_particles, method, NUM_TRAJECTORIES)
            try:
                entries.append(_entry(name, num_particles, job, _timed(once, runs, seed)))
            except ValueError as error:  # its PaRIS does not work with every version of numpy
                print(f"{name}: left out, {error}", file=sys.stderr)
    return entries


def _ours(estimate: Callable[..., Any], job: Job, num_particles: int) -> Callable[[int], float]:
    filter = mpfjax.particle_filter(make_model(job), num_particles)
    observations = jnp.asarray(observations_of(job))
    compiled = jit_on_wide_vectors(estimate)
    return lambda seed: float(compiled(jax.random.key(seed), filter, observations))


def _timed(once: Callable[[int], float], runs: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """The estimates of several runs and their seconds, after one that compiles."""
    once(seed)
    estimates, seconds = [], []
    for k in range(1, runs + 1):
        start = time.perf_counter()
        estimates.append(once(seed + k))
        seconds.append(time.perf_counter() - start)
    return np.array(estimates), np.array(seconds)


def _entry(
    name: str, num_particles: int, job: Job, measured: tuple[np.ndarray, np.ndarray]
) -> dict[str, Any]:
    estimates, seconds = measured
    errors = estimates - job.exact
    return {
        "method": name,
        "particles": num_particles,
        "rms_error": float(np.sqrt(np.mean(errors**2))),
        "bias": float(errors.mean()),
        "bias_error": float(errors.std(ddof=1) / np.sqrt(len(errors))),
        "seconds": float(np.median(seconds)),
    }


def table(found: dict[str, list[dict[str, Any]]]) -> str:
    """Errors and times of every method, a row for each N."""
    return "\n\n".join(
        format_table(
            [f"{job}: method", "N", "RMS error", "bias ± error", "seconds"],
            [
                [
                    entry["method"],
                    str(entry["particles"]),
                    f"{entry['rms_error']:.4f}",
                    f"{entry['bias']:+.4f} ± {entry['bias_error']:.4f}",
                    f"{entry['seconds']:.4f}",
                ]
                for entry in entries
            ],
        )
        for job, entries in found.items()
    )


def picture(found: dict[str, list[dict[str, Any]]]) -> Any:
    """Errors above, seconds below, against N."""
    rows = []
    for what, label in (("rms_error", "RMS error"), ("seconds", "seconds a run")):
        panels = []
        for job, entries in found.items():
            lines: dict[str, list[tuple[float, float]]] = {}
            for entry in entries:
                name = entry["method"].replace("backward sampling", "backward")  # to fit
                lines.setdefault(name, []).append((entry["particles"], entry[what]))
            panels.append(plotting.CostPanel(job, "particles N", label, lines))
        rows.append(panels)
    return plotting.draw_costs(rows)
