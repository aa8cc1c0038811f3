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

import argparse
import sys
from pathlib import Path
from typing import Any

from benchmarks.smoothing import accuracy, modes, posteriors, variance
from benchmarks.smoothing.jobs import JOBS, Quadratic
from mpfjax.console import exit_status, seed, whole, write_figure, write_json

PARTS = ("accuracy", "modes", "variance", "posteriors")


def parse_arguments(arguments: list[str] | None = None) -> argparse.Namespace:
    """The arguments, each checked."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.smoothing",
        description="Smoothing: accuracy against time, both modes kept, the variance of log Ẑ.",
    )
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--steps", type=whole(2), default=100, help="T")
    parser.add_argument(
        "--particles", type=whole(2), nargs="+", default=[100, 1000, 10000], metavar="N",
        help="of accuracy",
    )  # fmt: skip
    parser.add_argument("--runs", type=whole(2), default=20, help="of accuracy, for each N")
    parser.add_argument("--mode-particles", type=whole(2), default=200, metavar="N")
    parser.add_argument("--seeds", type=whole(), default=200, help="of modes")
    parser.add_argument("--variance-particles", type=whole(2), default=1000, metavar="N")
    parser.add_argument("--variance-runs", type=whole(2), default=1000)
    parser.add_argument(
        "--schemes", nargs="+", choices=variance.SCHEMES, default=list(variance.SCHEMES),
        help="of resampling, of variance",
    )  # fmt: skip
    parser.add_argument("--posterior-particles", type=whole(2), default=100, metavar="N")
    parser.add_argument("--posterior-steps", type=whole(20), default=2000, help="of each chain")
    parser.add_argument("--seed", type=seed, default=0)
    parser.add_argument("--out", type=Path, default=Path("results/smoothing"))
    return parser.parse_args(arguments)


def run(options: argparse.Namespace) -> None:
    """Part by part; what is finished is written."""
    options.out.mkdir(parents=True, exist_ok=True)
    jobs = {name: make(options.steps, options.seed) for name, make in JOBS.items()}
    settings = {name: value for name, value in vars(options).items() if name != "out"}
    content: dict[str, Any] = {"settings": settings}
    if "accuracy" in options.parts:
        found = {
            name: accuracy.measure(job, options.particles, options.runs, options.seed)
            for name, job in jobs.items()
        }
        content["accuracy"] = found
        write_json(options.out / "smoothing.json", content)
        print(f"smoothed mean of x_(t-1) x_t, {options.runs} runs, {options.steps} steps")
        if not accuracy.particles_is_there():
            print("particles is not installed: pip install particles")
        print(accuracy.table(found))
        write_figure(options.out / "accuracy.png", accuracy.picture(found), dpi=130)
    if "modes" in options.parts:
        job = Quadratic(options.steps, options.seed)
        masses = modes.masses(job, options.mode_particles, options.seeds, options.seed)
        content["modes"] = modes.summary(masses)
        write_json(options.out / "smoothing.json", content)
        print(f"\nmass of one of two modes, N = {options.mode_particles}, {options.seeds} seeds")
        print(f"lost by a seed: a mode whose smoothed mass is below {modes.LOST:.0%} at some time")
        print(modes.table(content["modes"]))
        write_figure(options.out / "modes.png", modes.picture(masses), dpi=130)
    if "variance" in options.parts:
        size, runs = options.variance_particles, options.variance_runs
        content["variance"] = variance.measure(jobs, options.schemes, size, runs, options.seed)
        write_json(options.out / "smoothing.json", content)
        print(f"\nvariance of log Ẑ, N = {size}, {runs} runs")
        print(variance.table(content["variance"]))
    if "posteriors" in options.parts:
        job = Quadratic(options.steps, options.seed)
        size, steps = options.posterior_particles, options.posterior_steps
        truth, found = posteriors.exact(job), posteriors.measure(job, size, steps, options.seed)
        content["posteriors"] = posteriors.summary(truth, found)
        write_json(options.out / "smoothing.json", content)
        print(f"\nposterior of two parameters, N = {size}, chains of {steps} steps")
        print(posteriors.table(content["posteriors"]))
        write_figure(options.out / "posteriors.png", posteriors.picture(truth, found), dpi=130)
    print(f"written to {options.out}")


def main(arguments: list[str] | None = None) -> int:
    """Run the benchmark; bad input is one line on the error stream and exit status 2."""
    return exit_status(lambda: run(parse_arguments(arguments)), arguments)


if __name__ == "__main__":
    sys.exit(main())
