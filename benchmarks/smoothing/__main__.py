"""Smoothing, for one filter and for mixtures: accuracy, modes, variance of log Ẑ, posteriors.

    python -m benchmarks.smoothing                     # all parts
    python -m benchmarks.smoothing --parts modes --seeds 50

- accuracy: error and time of genealogies, backward sampling and PaRIS on a linear-Gaussian and the
  quadratic model, against the exact answer; beside particles, where that is installed.
- modes: the smoothed mass of one of two modes of equal mass, by PF and MPF.
- variance: the variance of log Ẑ that a single run estimates, against that of many.

- posteriors: σ_x and σ_y of the quadratic model by PMMH, particle Gibbs and SMC², beside the grid
  filter's; effective samples a second.

Into --out DIR go smoothing.json, accuracy.png, modes.png and posteriors.png.
"""

import importlib.util
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import mpfjax
from benchmarks import figures as plotting
from benchmarks import harness
from benchmarks.harness import AtLeast2, Count, Seed, command, nothing
from benchmarks.smoothing import posteriors
from benchmarks.smoothing.jobs import FILTERS, JOBS, Job, Quadratic
from mpfjax.console import whole
from mpfjax.operations.compiling import jit_on_wide_vectors
from mpfjax.running.scan import FilterRun
from mpfjax.smoothing import (
    sample_trajectories,
    smoothed_sums,
    trace_ancestors,
    with_first_ancestors,
)
from mpfjax.smoothing.variance import log_marginal_likelihood_variance, mixture_weight_errors

PARTS = ("accuracy", "modes", "variance", "posteriors")
# The only scheme for which a single run tells the variance.
SCHEMES = ("multinomial",)
NUM_TRAJECTORIES, NUM_MODE_TRAJECTORIES = 100, 1000
# Above these numbers of particles a method that costs N² a step, or a loop in Python, is left out.
MOST_SQUARED, MOST_IN_PYTHON = 1000, 300
# A mode counts as lost by a seed if its smoothed mass is below this at any time 0, ..., T.
LOST = 0.01
# Drawn in the picture of modes, where there is room for four names.
_DRAWN = ("PF", "auxiliary MPF")
_TOGETHER = 10  # seeds at once


@command(
    steps=8, particles=[20], runs=3, mode_particles=20, seeds=3, variance_particles=20,
    variance_runs=4, posterior_steps=20, posterior_particles=20,
)  # fmt: skip
def main(
    *,
    parts: Sequence[Annotated[str, (*PARTS,)]] = PARTS,
    steps: AtLeast2 = 100,
    particles: Sequence[AtLeast2] = (100, 1000, 10000),
    runs: AtLeast2 = 20,
    mode_particles: AtLeast2 = 200,
    seeds: Count = 200,
    variance_particles: AtLeast2 = 1000,
    variance_runs: AtLeast2 = 1000,
    schemes: Sequence[Annotated[str, (*SCHEMES,)]] = SCHEMES,
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
    - `schemes`: of resampling, of variance.
    - `posterior_steps`: of each chain.
    """
    content: dict[str, Any] = {"settings": harness.settings_of(locals())}
    jobs = {name: make(steps, seed) for name, make in JOBS.items()}
    job = Quadratic(steps, seed)

    def finish(part: str, result: Any, title: str, tables: str, figure: Any = None) -> None:
        content[part] = result
        harness.data(out / "smoothing.json", **content)
        print(f"\n{title}\n{tables}")
        if figure is not None:
            harness.figures(out, dpi=130, **{part: figure})

    if "accuracy" in parts:
        found = {name: accuracy(each, particles, runs, seed) for name, each in jobs.items()}
        title = f"smoothed mean of x_(t-1) x_t, {runs} runs, {steps} steps"
        tables = (
            harness.table({f"{name}: method": "{method}"} | OF_ACCURACY, entries)
            for name, entries in found.items()
        )
        finish("accuracy", found, title, "\n\n".join(tables), draw_accuracy(found))
    if "modes" in parts:
        masses = masses_of_modes(job, mode_particles, seeds, seed)
        title = f"mass of one of two modes, N = {mode_particles}, {seeds} seeds"
        title += f"\nlost by a seed: a mode whose smoothed mass is below {LOST:.0%} at some time"
        entries = modes_lost(masses)
        rows = [{"name": name, **entry} for name, entry in entries.items()]
        finish("modes", entries, title, harness.table(OF_MODES, rows), draw_modes(masses))
    if "variance" in parts:
        entries = variance(jobs, schemes, variance_particles, variance_runs, seed)
        title = f"variance of log Ẑ, N = {variance_particles}, {variance_runs} runs"
        finish("variance", entries, title, harness.table(OF_VARIANCE, entries))
    if "posteriors" in parts:
        truth = posteriors.exact(job)
        found = posteriors.measure(job, posterior_particles, posterior_steps, seed)
        entries = posteriors.summary(truth, found)
        title = f"posterior of two parameters, N = {posterior_particles}, "
        title += f"chains of {posterior_steps} steps"
        tables = harness.table(posteriors.COLUMNS, entries)
        finish("posteriors", entries, title, tables, posteriors.picture(truth, found))
    print(f"written to {out}")


# --- (a) error against time: genealogies, backward sampling and PaRIS, ours and particles' --------


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


OF_ACCURACY = {
    "N": "{particles}",
    "RMS error": "{rms_error:.4f}",
    "bias ± error": "{bias:+.4f} ± {bias_error:.4f}",
    "seconds": "{seconds:.4f}",
}


def accuracy(job: Job, sizes: Sequence[int], runs: int, seed: int) -> list[dict[str, Any]]:
    """For each method and N the RMS error over runs and the median seconds of one."""
    entries = []
    observations = jnp.asarray(job.seen)
    with_particles = importlib.util.find_spec("particles") is not None
    if not with_particles:
        print("particles is not installed: pip install particles")
    for size in sizes:
        filter = mpfjax.particle_filter(job.model(), size)
        estimators: dict[str, Callable[[int], float]] = {}
        for name, estimate in OURS.items():
            if name != "PaRIS" or size <= MOST_SQUARED:
                run = jit_on_wide_vectors(estimate)
                estimators[name] = lambda seed, run=run, filter=filter: float(
                    run(jax.random.key(seed), filter, observations)
                )
        if with_particles:
            from benchmarks.smoothing import through_particles

            for name, method in THEIRS.items():
                most = {"paris": MOST_IN_PYTHON, "online": MOST_SQUARED}.get(method, size)
                if size <= most:
                    estimators[name] = through_particles.estimator(
                        job, size, method, NUM_TRAJECTORIES
                    )
        for name, once in estimators.items():
            found: list[float] = []

            def run_once(turn: int, once: Any = once, found: list = found) -> None:
                found.append(once(seed + turn))

            try:
                (seconds,) = harness.turns({name: run_once}, runs).values()
            except ValueError as error:  # particles' PaRIS does not work with every numpy
                if name in OURS:
                    raise
                print(f"{name}: left out, {error}", file=sys.stderr)
                continue
            errors = np.array(found[1:]) - job.exact
            bias, bias_error = harness.mean_and_error(errors)
            entries.append({
                "method": name, "particles": size, "rms_error": float(np.sqrt(np.mean(errors**2))),
                "bias": bias, "bias_error": bias_error, "seconds": float(np.median(seconds)),
            })  # fmt: skip
    return entries


def draw_accuracy(found: dict[str, list[dict[str, Any]]]) -> Any:
    """Errors above, seconds below, against N."""

    def panel(job: str, what: str, label: str) -> plotting.Panel:
        short = lambda e: e["method"].replace("backward sampling", "backward")  # noqa: E731
        lines = plotting.lines_of(found[job], short, "particles", what)
        return plotting.Panel(job, "particles N", label, lines)

    rows = (("rms_error", "RMS error"), ("seconds", "seconds a run"))
    return plotting.draw_panels(
        [[panel(job, what, label) for job in found] for what, label in rows]
    )


# --- (b) two modes of equal mass, smoothed: which methods keep both, at every time ----------------
# The quadratic model does not see the sign of the state, so that the smoothed mass of the positive
# mode is one half at every time, exactly.

OF_MODES = {
    "filter and smoother": "{name}",
    "RMS error": "{mean_rms_error:.3f}",
    "at its worst": "{worst_rms_error:.3f}",
    "a mode lost": "{lost_at_some_time:.1%}",
    "lost at time 0": "{lost_at_the_start:.1%}",
}


def masses_of_modes(
    job: Quadratic, num_particles: int, seeds: int, seed: int
) -> dict[str, np.ndarray]:
    """The mass of the positive mode by each filter and method, (seeds, T + 1)."""
    model, observations = job.model(), jnp.asarray(job.seen)
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
        paths = sample_trajectories(key_back, filter.model, run, NUM_MODE_TRAJECTORIES)
        return traced, jnp.mean(paths > 0, axis=0)

    return jax.lax.map(one, keys, batch_size=min(_TOGETHER, len(keys)))


def modes_lost(found: dict[str, np.ndarray]) -> dict[str, dict[str, float]]:
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


def draw_modes(found: dict[str, np.ndarray]) -> Any:
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


# --- (c) the errors of log Ẑ and of a mode's mass by one run, against those of many runs ----------

OF_VARIANCE = {
    "log Ẑ of": "{job}",
    "filter": "{filter}",
    "scheme": "{scheme}",
    "variance of runs": lambda e: (
        f"{e['variance']:.4f} ± {e['variance'] * e['relative_error']:.4f}"
    ),
    "by one run": "{mean_of_runs:.4f} ± {std_of_runs:.4f}",
    "ratio": lambda e: f"{e['mean_of_runs'] / e['variance']:.2f}",
    "mass: deviation of runs": "{mass_deviation:.3f}",
    "its error by one run": "{mass_error_of_runs:.3f}",
}


def variance(
    jobs: dict[str, Job], schemes: Sequence[str], num_particles: int, runs: int, seed: int
) -> list[dict[str, Any]]:
    """For each job, filter and scheme the variance over runs and what each run says of it."""
    entries = []
    for job_name, job in jobs.items():
        model, observations = job.model(independent=True), job.seen
        for scheme in schemes:
            filters = {
                "PF": mpfjax.particle_filter(model, num_particles, scheme=scheme),
                "MPF": mpfjax.mixture_particle_filter(model, num_particles, 2, scheme=scheme),
            }
            for name, filter in filters.items():
                keys = jax.random.split(jax.random.key(seed), runs)
                remembering = with_first_ancestors(filter)
                found = mpfjax.monte_carlo(keys, remembering, observations, nothing)
                by_run = np.asarray(jax.vmap(log_marginal_likelihood_variance)(found))
                truth = float(np.var(np.asarray(found.log_marginal_likelihood), ddof=1))
                entries.append({
                    "job": job_name, "filter": name, "scheme": scheme, "variance": truth,
                    "relative_error": float(np.sqrt(2 / (runs - 1))),
                    "mean_of_runs": float(by_run.mean()), "std_of_runs": float(by_run.std()),
                })  # fmt: skip
                # The linear model has one mode, which regrouping divides now here, now there.
                if filter.num_components > 1 and job_name == "quadratic":
                    entries[-1] |= _of_masses(found)
    return entries


def _of_masses(runs: FilterRun) -> dict[str, float]:
    """The deviation of the upper mode's mass over runs, and its mean standard error by one run."""
    means = jax.vmap(lambda mixture: mixture.component_means())(runs.final)
    masses = np.asarray(jax.vmap(lambda mixture: mixture.mixture_weights)(runs.final))
    errors = np.asarray(jax.vmap(mixture_weight_errors)(runs))
    each, upper = np.arange(len(masses)), np.asarray(jnp.argmax(means, axis=1))
    return {
        "mass_deviation": float(masses[each, upper].std(ddof=1)),
        "mass_error_of_runs": float(errors[each, upper].mean()),
    }


if __name__ == "__main__":
    raise SystemExit(main())
