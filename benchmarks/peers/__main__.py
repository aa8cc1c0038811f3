"""How fast mpfjax is beside particles, blackjax and cuthbert, on the same jobs.

    python -m benchmarks.peers                        # whichever rivals are installed
    python -m benchmarks.peers --devices 2            # and mpfjax on two host devices

A bootstrap filter with systematic resampling at every step, for all seeds; mean, effective sample
size and log-likelihood come out. Each library works in a process of its own, in the best way that
its pages document (`libraries`, `through_particles`); they take turns, so that what else the
machine does meets all alike. None is timed before its log-likelihoods and effective sample sizes
agree with mpfjax's, and with the exact log-likelihood. Into --out DIR go peers.json and peers.png.
"""

import argparse
import importlib.util
import os
import platform
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.peers.comparison import drop, time_cell
from benchmarks.peers.jobs import JOBS, Job, Quadratic
from benchmarks.peers.libraries import LIBRARIES, model_of
from benchmarks.peers.tables import as_tables, draw
from benchmarks.peers.worker import Worker, stop_all
from mpfjax.console import exit_status, positive, whole, write_figure, write_json
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
START_SECONDS = 120.0


def main(arguments: list[str] | None = None) -> int:
    """Run the comparison; 1 where a library was refused."""
    options = parse(arguments)
    refused: list[str] = []
    return exit_status(lambda: run(options, refused), arguments) or int(bool(refused))


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
    write_figure(out / "peers.png", draw(content["results"], labels), dpi=150)
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


def exact_log_likelihood(job: Job) -> float:
    """log p(y_1..y_t), by quadrature or by the Kalman filter."""
    model, observations = model_of(job), jnp.asarray(job.observations)
    if isinstance(job, Quadratic):
        return float(grid_filter(model, observations, jnp.linspace(*GRID)).log_marginal_likelihood)
    return float(kalman_filter(model, observations).log_marginal_likelihood)


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
