"""Smoothing, for one filter and for mixtures: accuracy, modes, posteriors.

    python -m benchmarks.smoothing                     # all parts
    python -m benchmarks.smoothing --parts modes --seeds 50

- accuracy: error and time of genealogies, backward sampling and PaRIS on a linear-Gaussian and the
  quadratic model, against the exact answer.
- modes: the smoothed mass of one of two modes of equal mass, by PF and MPF.
- posteriors: σ_x and σ_y of the quadratic model by PMMH, particle Gibbs and SMC², beside the grid
  filter's; effective samples a second.

Into --out DIR go smoothing.json and posteriors.png.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import mpfjax
from benchmarks import harness
from benchmarks.harness import AtLeast2, Count, Seed, command
from benchmarks.smoothing import posteriors
from benchmarks.smoothing.jobs import FILTERS, JOBS, Job, Quadratic
from mpfjax.console import whole
from mpfjax.operations.compiling import jit_on_wide_vectors
from mpfjax.smoothing import sample_trajectories, smoothed_sums, trace_ancestors

PARTS = ("accuracy", "modes", "posteriors")
NUM_TRAJECTORIES, NUM_MODE_TRAJECTORIES = 100, 1000
# A mode counts as lost by a seed if its smoothed mass is below this at any time 0, ..., T.
LOST = 0.01


@command(
    steps=8, particles=[20], runs=3, mode_particles=20, seeds=3, posterior_steps=20,
    posterior_particles=20,
)  # fmt: skip
def main(
    *,
    parts: Sequence[Annotated[str, (*PARTS,)]] = PARTS,
    steps: AtLeast2 = 100,
    particles: Sequence[AtLeast2] = (100, 1000, 10000),
    runs: AtLeast2 = 20,
    mode_particles: AtLeast2 = 200,
    seeds: Count = 200,
    posterior_particles: AtLeast2 = 100,
    posterior_steps: Annotated[int, whole(20)] = 2000,
    seed: Seed = 0,
    out: Path = Path("results/smoothing"),
) -> None:
    """Part by part; what is finished is written.

    - `steps`: T.
    - `particles`: of accuracy.
    - `runs`: of accuracy, for each N.
    - `seeds`: of modes.
    - `posterior_steps`: of each chain.
    """
    content: dict[str, Any] = {"settings": harness.settings_of(locals())}
    jobs = {name: make(steps, seed) for name, make in JOBS.items()}
    job = Quadratic(steps, seed)

    def finish(part: str, entries: list[dict[str, Any]], title: str, columns: Any = None) -> None:
        content[part] = entries
        harness.data(out / "smoothing.json", **content)
        print(f"\n{title}\n{harness.table(columns, entries)}")

    if "accuracy" in parts:
        entries = [
            {"job": name, **entry}
            for name, each in jobs.items()
            for entry in accuracy(each, particles, runs, seed)
        ]
        title = f"smoothed mean of x_(t-1) x_t, {runs} runs, {steps} steps"
        finish("accuracy", entries, title)
    if "modes" in parts:
        title = f"mass of one of two modes, N = {mode_particles}, {seeds} seeds"
        title += f"\nlost by a seed: a mode whose smoothed mass is below {LOST:.0%} at some time"
        finish("modes", modes(job, mode_particles, seeds, seed), title)
    if "posteriors" in parts:
        truth = posteriors.exact(job)
        found = posteriors.measure(job, posterior_particles, posterior_steps, seed)
        title = f"posterior of two parameters, N = {posterior_particles}, "
        title += f"chains of {posterior_steps} steps"
        finish("posteriors", posteriors.summary(truth, found), title, posteriors.COLUMNS)
        harness.figures(out, dpi=130, posteriors=posteriors.picture(truth, found))
    print(f"written to {out}")


# --- (a) error against time: genealogies, backward sampling and PaRIS ----------------------------


def products(previous_states: Any, states: Any) -> Any:
    """x_{t-1} x_t of each particle."""
    return (previous_states * states).reshape(states.shape[0])


def _genealogy(key: Any, filter: mpfjax.Filter, observations: Any) -> Any:
    run = mpfjax.run_filter(key, filter, observations)
    paths = trace_ancestors(run).trajectories
    paths = paths.reshape(*paths.shape[:2])
    return run.final.average(jnp.mean(paths[:, :-1] * paths[:, 1:], axis=1))


def _backward(method: Literal["exact", "mcmc"]) -> Callable[..., Any]:
    def estimate(key: Any, filter: mpfjax.Filter, observations: Any) -> Any:
        key_run, key_back = jax.random.split(key)
        run = mpfjax.run_filter(key_run, filter, observations)
        paths = sample_trajectories(key_back, filter.model, run, NUM_TRAJECTORIES, method=method)
        paths = paths.reshape(*paths.shape[:2])
        return jnp.mean(paths[:, :-1] * paths[:, 1:])

    return estimate


def _paris(method: Literal["exact", "mcmc"]) -> Callable[..., Any]:
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


def accuracy(job: Job, sizes: Sequence[int], runs: int, seed: int) -> list[dict[str, Any]]:
    """For each method and N the RMS error over runs and the median seconds of one."""
    entries = []
    observations = jnp.asarray(job.seen)
    for size in sizes:
        filter = mpfjax.particle_filter(job.model(), size)
        for name, estimate in OURS.items():
            if name == "PaRIS" and size > 1000:  # it costs N² a step
                continue
            run, found = jit_on_wide_vectors(estimate), []

            def run_once(
                turn: int, run: Any = run, found: list[float] = found, filter: Any = filter
            ) -> None:
                found.append(float(run(jax.random.key(seed + turn), filter, observations)))

            (seconds,) = harness.turns({name: run_once}, runs).values()
            errors = np.array(found[1:]) - job.exact
            bias, bias_error = harness.mean_and_error(errors)
            entries.append({
                "method": name, "N": size, "RMS error": float(np.sqrt(np.mean(errors**2))),
                "bias": bias, "its error": bias_error, "seconds": float(np.median(seconds)),
            })  # fmt: skip
    return entries


# --- (b) two modes of equal mass, smoothed: which methods keep both, at every time ----------------
# The quadratic model does not see the sign of the state, so that the smoothed mass of the positive
# mode is one half at every time, exactly.


def modes(job: Quadratic, num_particles: int, seeds: int, seed: int) -> list[dict[str, Any]]:
    """For each filter and method, the error of a mode's mass, and how many seeds lost a mode."""
    model, observations = job.model(), jnp.asarray(job.seen)
    keys = jax.random.split(jax.random.key(seed), seeds)
    entries = []
    for name, make in FILTERS.items():
        found = _smoothed(keys, make(model, num_particles), observations)
        for method, masses in zip(("genealogy", "backward sampling"), found, strict=True):
            values = np.asarray(masses)
            lost = np.minimum(values, 1 - values) < LOST
            errors = np.sqrt(np.mean((values - 0.5) ** 2, axis=0))
            entries.append({
                "filter and smoother": f"{name}, {method}", "RMS error": float(errors.mean()),
                "at its worst": float(errors.max()),
                "a mode lost": float(lost.any(axis=1).mean()),
                "lost at time 0": float(lost[:, 0].mean()),
            })  # fmt: skip
    return entries


@eqx.filter_jit
def _smoothed(keys: Any, filter: mpfjax.Filter, observations: Any) -> Any:
    def one(key: Any) -> tuple[Any, Any]:
        key_run, key_back = jax.random.split(key)
        run = mpfjax.run_filter(key_run, filter, observations)
        traced = run.final.average(trace_ancestors(run).trajectories > 0)
        paths = sample_trajectories(key_back, filter.model, run, NUM_MODE_TRAJECTORIES)
        return traced, jnp.mean(paths > 0, axis=0)

    return jax.lax.map(one, keys, batch_size=min(10, len(keys)))


if __name__ == "__main__":
    raise SystemExit(main())
