"""How fast mpfjax is beside particles, blackjax and cuthbert, on the same jobs.

    python -m benchmarks.peers                        # whichever rivals are installed
    python -m benchmarks.peers --devices 2            # and mpfjax on two host devices

A bootstrap filter with systematic resampling at every step, for all seeds; mean, effective sample
size and log-likelihood come out. Each library works in a process of its own, in the best way that
its pages document (`peer_libraries`, `peer_particles`); they take turns, so that what else the
machine does meets all alike. None is timed before its log-likelihoods and effective sample sizes
agree with mpfjax's, and with the exact log-likelihood. Into --out DIR go peers.json and peers.png.
"""

import argparse
import importlib.util
import os
import platform
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy import stats

from benchmarks.peer_jobs import JOBS, Job, Quadratic
from benchmarks.peer_libraries import LIBRARIES, model_of
from benchmarks.peer_worker import Worker, stop_all
from mpfjax import plotting
from mpfjax.console import exit_status, format_table, positive, whole, write_json
from mpfjax.exact import grid_filter, kalman_filter

RIVALS = {  # and how each is installed
    # particles 0.4 asks for numpy below 2, works with 2, and would take JAX back to 0.7.
    "particles": "pip install joblib numba scikit-learn; pip install --no-deps particles",
    "blackjax": "pip install blackjax",
    "cuthbert": "pip install cuthbert",
}
ON_DEVICES = "mpfjax_devices"
MOST_PARTICLES = {"quadratic": 1_000_000, "constant_velocity": 10_000}
GRID = (-4.0, 4.0, 1601)
LEVEL = 1e-5  # of each test: a hundred of them refuse one that is right once in a thousand runs
ROUNDING = 1e-4  # of float32 against float64, relative
MOST_SPREAD = 1.0  # nats; log-likelihoods that spread more are not close enough to normal
SLOW_SECONDS, FEWEST_REPEATS = 20.0, 3
START_SECONDS = 120.0


def main(arguments: list[str] | None = None) -> int:
    """Run the comparison; 1 where a library was refused."""
    options = parse(arguments)
    refused: list[str] = []
    return exit_status(lambda: run(options, refused)) or int(bool(refused))


def parse(arguments: list[str] | None) -> argparse.Namespace:
    """The options, or a message that names the one that cannot be run."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.peers")
    parser.add_argument(
        "--particles", type=whole(2), nargs="+", default=[100, 1000, 10_000, 100_000], metavar="N"
    )
    parser.add_argument("--jobs", nargs="+", choices=list(JOBS), default=list(JOBS))
    parser.add_argument("--seeds", type=whole(3), default=20, help="runs of each filter, at once")
    parser.add_argument("--repeats", type=whole(), default=9, help="times that each cell is timed")
    parser.add_argument("--skip", nargs="+", choices=list(RIVALS), default=[], help="libraries")
    parser.add_argument(
        "--devices", type=whole(), default=1, help="mpfjax on so many, beside on one"
    )
    parser.add_argument("--time-limit", type=positive, default=600.0, help="seconds, of one run")
    parser.add_argument("--out", default="results/peers", metavar="DIR")
    return parser.parse_args(arguments)


def run(options: argparse.Namespace, refused: list[str]) -> None:
    """All cells in turn, each written as it is finished; appends what is refused."""
    out = Path(options.out)
    libraries = chosen_libraries(options)
    content: dict[str, Any] = {"settings": settings_of(options), "libraries": {}, "results": []}
    for job_name in options.jobs:
        exact = exact_log_likelihood(JOBS[job_name])
        workers = {name: start(name, job_name, options.devices) for name in libraries}
        try:
            for name, worker in list(workers.items()):
                found = worker.answer(START_SECONDS)
                if "error" in found:
                    drop(workers, name, found["error"])
                content["libraries"][name] = found
            for num_particles in sorted(options.particles):
                if num_particles > MOST_PARTICLES[job_name]:
                    continue
                place = {"job": job_name, "particles": num_particles}
                for entry in time_cell(workers, num_particles, exact, options):
                    content["results"].append(place | entry)
                    if entry["refused"]:
                        refused.append(entry["library"])
                write_json(out / "peers.json", content)
        finally:
            stop_all(workers.values())
    labels = labels_of(options.devices)
    for job_name in options.jobs:
        print(as_tables(job_name, content["results"], labels), end="\n\n")
    draw(content["results"], labels).savefig(out / "peers.png", dpi=150)
    print(f"results and figure: {out}/")


def chosen_libraries(options: argparse.Namespace) -> list[str]:
    """The names of what runs, mpfjax first; says which rival is not installed."""
    chosen = ["mpfjax"] + ([ON_DEVICES] if options.devices > 1 else [])
    for name, command in RIVALS.items():
        if name in options.skip:
            continue
        if importlib.util.find_spec(name) is None:
            print(f"{name} is not installed and left out: {command}", file=sys.stderr)
            continue
        chosen += ["particles", "particles_2"] if name == "particles" else [name]
    return chosen


def labels_of(num_devices: int) -> dict[str, str]:
    """What each library is called in tables."""
    first, *rest = LIBRARIES.items()
    return dict([first, (ON_DEVICES, f"mpfjax, {num_devices} devices"), *rest])


def start(name: str, job_name: str, num_devices: int) -> Worker:
    """The process of a library; those of all start side by side."""
    if name == ON_DEVICES:
        return Worker("mpfjax", job_name, num_devices)
    return Worker(name, job_name, num_devices=1 if name == "mpfjax" else None)


def drop(workers: dict[str, Worker], name: str, reason: str) -> None:
    """Go on without a library that failed; not without mpfjax."""
    workers.pop(name).stop()
    if name == "mpfjax":
        raise ValueError(f"mpfjax: {reason}")
    print(f"{name} failed and is left out from here on: {reason}", file=sys.stderr)


def exact_log_likelihood(job: Job) -> float:
    """log p(y_1..y_t), by quadrature or by the Kalman filter."""
    model, observations = model_of(job), jnp.asarray(job.observations)
    if isinstance(job, Quadratic):
        return float(grid_filter(model, observations, jnp.linspace(*GRID)).log_marginal_likelihood)
    return float(kalman_filter(model, observations).log_marginal_likelihood)


# --- what is measured -------------------------------------------------------------------------


def time_cell(
    workers: dict[str, Worker], num_particles: int, exact: float, options: argparse.Namespace
) -> list[dict[str, Any]]:
    """One entry for each library, at one number of particles.

    The first run of each is checked and counts as its start; then they take turns in random
    order. One that is slow is timed less often.
    """
    request = {"particles": num_particles, "seeds": options.seeds}
    first: dict[str, dict[str, Any]] = {}
    for name in list(workers):
        found = workers[name].run(options.time_limit, **request, seed=0)
        if "error" in found:
            drop(workers, name, found["error"])
        else:
            first[name] = found
    reasons = {name: disagreement(found, first["mpfjax"], exact) for name, found in first.items()}
    for name, reason in reasons.items():
        if reason is not None:
            print(f"N = {num_particles}: {name} is not timed: {reason}", file=sys.stderr)
    elapsed = {name: [] for name, reason in reasons.items() if reason is None}
    memory = {name: found["memory"] for name, found in first.items()}
    order = np.random.default_rng(0)
    for repeat in range(options.repeats):
        for name in order.permutation(list(elapsed)).tolist():
            slow = sum(elapsed[name]) > SLOW_SECONDS and len(elapsed[name]) >= FEWEST_REPEATS
            if slow or name not in workers:
                continue
            found = workers[name].run(options.time_limit, **request, seed=1 + repeat)
            if "error" in found:
                drop(workers, name, found["error"])
                continue
            elapsed[name].append(found["seconds"])
            memory[name] = max(memory[name], found["memory"])
    baseline = np.median(elapsed["mpfjax"]) if elapsed.get("mpfjax") else None
    return [
        summarise(name, first[name], elapsed.get(name, []), memory[name], reasons[name], baseline)
        for name in first
    ]


def disagreement(
    found: Mapping[str, Any], reference: Mapping[str, Any], exact: float
) -> str | None:
    """Why these are not results of the same filter, or None.

    Welch's test of log-likelihoods and of effective sample sizes against the reference's. And, as
    E[Ẑ] = Z, log Ẑ + s²/2 against the exact log Z, where log Ẑ spreads little enough to be close
    to normal.
    """
    for what in ("log_likelihoods", "effective_sample_sizes"):
        ours, others = np.array(found[what]), np.array(reference[what])
        if not np.isfinite(ours).all():
            return f"{what.replace('_', ' ')} that are not finite"
        gap = abs(ours.mean() - others.mean())
        if gap <= ROUNDING * max(1.0, abs(others.mean())):
            continue
        test: Any = stats.ttest_ind(ours, others, equal_var=False)
        if test.pvalue < LEVEL:
            return f"mean {what.replace('_', ' ')} {ours.mean():.6g}, not {others.mean():.6g}"
    estimates = np.array(found["log_likelihoods"])
    number, variance = len(estimates), estimates.var(ddof=1)
    if variance > MOST_SPREAD**2:
        return None
    gap = abs(estimates.mean() + variance / 2 - exact)
    error = np.sqrt(variance / number + variance**2 / (2 * (number - 1)))
    limit = stats.t.isf(LEVEL / 2, number - 1) * error + ROUNDING * max(1.0, abs(exact))
    return f"log-likelihood {estimates.mean():.6g}, exactly {exact:.6g}" if gap > limit else None


def summarise(
    name: str,
    first: Mapping[str, Any],
    seconds: list[float],
    memory: int,
    refused: str | None,
    baseline: float | None,
) -> dict[str, Any]:
    """One entry of the results; times in seconds, memory in bytes above the imports'."""
    median = float(np.median(seconds)) if seconds else None
    return {
        "library": name,
        "refused": refused,
        "seconds": seconds,
        "median": median,
        "ratio": None if median is None or baseline is None else float(median / baseline),
        "start": None if median is None else max(first["seconds"] - median, 0.0),
        # What particles' other processes take is not seen from the first.
        "memory": None if name == "particles_2" else memory,
        "log_likelihood_mean": float(np.mean(first["log_likelihoods"])),
        "log_likelihood_std": float(np.std(first["log_likelihoods"])),
        "effective_sample_size": float(np.mean(first["effective_sample_sizes"])),
    }


# --- tables and the picture -------------------------------------------------------------------


def as_tables(job_name: str, results: list[dict[str, Any]], labels: Mapping[str, str]) -> str:
    """Times with their ratios to mpfjax's, and below them starts and memory."""
    entries = {(e["library"], e["particles"]): e for e in results if e["job"] == job_name}
    sizes = sorted({size for _, size in entries})
    names = [name for name in labels if any(name == library for library, _ in entries)]

    def table(title: str, form: Any) -> str:
        rows = [
            [labels[name], *(form(entries.get((name, size), {})) for size in sizes)]
            for name in names
        ]
        return format_table([title, *(f"N = {size}" for size in sizes)], rows)

    return "\n\n".join(
        [
            JOBS[job_name].title,
            table("median [ms], ratio", _time),
            table("start [s], memory [MB]", _start),
        ]
    )


def _time(entry: Mapping[str, Any]) -> str:
    if entry.get("refused"):
        return "refused"
    if entry.get("median") is None:
        return "-"
    ratio = "" if entry["ratio"] is None else f" {entry['ratio']:6.2f}"
    return f"{1000 * entry['median']:.4g}{ratio}"


def _start(entry: Mapping[str, Any]) -> str:
    if entry.get("start") is None:
        return "-"
    memory = "-" if entry["memory"] is None else f"{entry['memory'] / 1e6:.0f}"
    return f"{entry['start']:.1f} {memory:>5}"


def draw(results: list[dict[str, Any]], labels: Mapping[str, str]) -> Any:
    """Time against N, a panel for each job and a line for each library; particles' faster mode."""
    panels = []
    for job_name in dict.fromkeys(entry["job"] for entry in results):
        lines: dict[str, dict[float, float]] = {}
        for entry in results:
            if entry["job"] != job_name or entry["median"] is None:
                continue
            # The two modes have one line.
            label = labels[entry["library"]]
            label = "particles" if entry["library"].startswith("particles") else label
            line, milliseconds = lines.setdefault(label, {}), 1000 * entry["median"]
            size = entry["particles"]
            line[size] = min(milliseconds, line.get(size, np.inf))
        job = JOBS[job_name]
        panels.append(
            plotting.CostPanel(
                f"{job.title}, {job.num_steps} steps",
                "number of particles $N$",
                "time of all runs [ms]",
                {label: list(line.items()) for label, line in lines.items()},
            )
        )
    return plotting.draw_costs([panels])


def settings_of(options: argparse.Namespace) -> dict[str, Any]:
    """What a second run needs to be the same, and the machine."""
    return {
        "jobs": options.jobs,
        "particles": sorted(options.particles),
        "seeds": options.seeds,
        "repeats": options.repeats,
        "devices": options.devices,
        "jax": jax.__version__,
        "numpy": np.__version__,
        "python": platform.python_version(),
        "machine": platform.machine(),
        "processors": os.cpu_count(),
    }


if __name__ == "__main__":
    sys.exit(main())
