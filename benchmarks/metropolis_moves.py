"""How exact log Z-hat gets by Metropolis moves where the likelihood is narrow, and at what price.

    python -m benchmarks.metropolis_moves

A linear-Gaussian model, each number of the state a random walk that decays and each seen with a
small error, so that the Kalman filter knows log Z. The plain filter runs with N particles and with
several times as many. The filters with moves let the likelihood come in by stages, L^(1/64),
L^(1/16), L^(1/4) and L, each stage but the last followed by resampling and by steps of the move.
Printed are the mean and the RMS of the error of log Z-hat over seeds, the mean of Z-hat / Z with
its standard error, and milliseconds of processor time a run, the least of --repeats turns. Into
--out DIR goes metropolis_moves.json.
"""

import argparse
import sys
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import mpfjax
from mpfjax import MetropolisAdjustedLangevin, RandomWalkMetropolis
from mpfjax.console import exit_status, format_table, positive, whole, write_json
from mpfjax.exact import kalman_filter

KEPT = 0.9
EXPONENTS = (1 / 64, 1 / 16, 1 / 4, 1.0)
HEADER = ["filter", "N", "bias", "RMS of log Z-hat", "mean of Z-hat / Z", "ms a run"]


def main(arguments: list[str] | None = None) -> int:
    """Run every filter, print a table, and write the results."""
    options = parse(arguments)
    return exit_status(lambda: run(options), arguments)


def parse(arguments: list[str] | None) -> argparse.Namespace:
    """The options, or a message that names the one that cannot be run."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.metropolis_moves")
    parser.add_argument("--particles", type=whole(), default=200, help="N of filters with moves")
    parser.add_argument("--plain", type=whole(), nargs="+", default=[200, 2000, 8000], metavar="N")
    parser.add_argument("--moves", type=whole(), nargs="+", default=[1, 3], help="steps a stage")
    parser.add_argument("--dimensions", type=whole(), default=4)
    parser.add_argument("--error", type=positive, default=0.1, help="deviation of an observation")
    parser.add_argument("--steps", type=whole(), default=20, help="observations")
    parser.add_argument("--seeds", type=whole(2), default=200)
    parser.add_argument("--repeats", type=whole(), default=3, help="times that each is timed")
    parser.add_argument("--out", default="results/metropolis_moves", metavar="DIR")
    return parser.parse_args(arguments)


def run(options: argparse.Namespace) -> None:
    """Each filter over the same observations, timed in turns."""
    model = narrow_model(options.dimensions, options.error)
    _, observations = model.simulate(jax.random.key(0), options.steps)
    log_z = float(kalman_filter(model, observations).log_marginal_likelihood)
    keys = jax.random.split(jax.random.key(1), options.seeds)
    runs = {name: run_of(keys, filter, observations) for name, filter in filters(options, model)}
    found = {name: once() for name, once in runs.items()}
    milliseconds = dict.fromkeys(runs, np.inf)
    for _ in range(options.repeats):
        for name, once in runs.items():
            start = time.process_time()
            once()
            taken = 1000 * (time.process_time() - start) / options.seeds
            milliseconds[name] = min(milliseconds[name], taken)
    results = [
        {"filter": name[0], "N": name[1], **errors(found[name] - log_z), "ms": milliseconds[name]}
        for name in runs
    ]
    print(format_table(HEADER, [row_of(result) for result in results]))
    out = Path(options.out)
    out.mkdir(parents=True, exist_ok=True)
    write_json(out / "metropolis_moves.json", {"settings": vars(options), "results": results})
    print(f"results: {out}/")


def narrow_model(dimensions: int, error: float) -> mpfjax.LinearGaussianModel:
    """x_t = 0.9 x_{t-1} + N(0, I), y_t = x_t + N(0, error² I)."""
    eye = jnp.eye(dimensions)
    return mpfjax.LinearGaussianModel(
        KEPT * eye, eye, eye, error**2 * eye, jnp.zeros(dimensions), eye
    )


def filters(
    options: argparse.Namespace, model: mpfjax.LinearGaussianModel
) -> list[tuple[tuple[str, int], mpfjax.Filter]]:
    """The plain filter of each size, and each move with each number of steps."""
    plain = [(("plain", size), mpfjax.particle_filter(model, size)) for size in options.plain]
    moving = [
        ((f"{move.__name__}, {steps} a stage", options.particles),
         by_stages(model, move, steps, options.particles))
        for move in (RandomWalkMetropolis, MetropolisAdjustedLangevin)
        for steps in options.moves
    ]  # fmt: skip
    return plain + moving


def by_stages(
    model: mpfjax.LinearGaussianModel, move: Callable[..., Any], steps: int, size: int
) -> mpfjax.Filter:
    """A filter whose likelihood comes in by powers, with moves in between."""
    moves = [mpfjax.Resample(), mpfjax.Predict(model), mpfjax.Reweight(model, EXPONENTS[0])]
    for before, after in pairwise(EXPONENTS):
        moves += [
            mpfjax.Resample(), move(model, steps, exponent=before),
            mpfjax.Reweight(model, after - before),
        ]  # fmt: skip
    return mpfjax.Filter(model, moves, size)


def run_of(keys: Any, filter: mpfjax.Filter, observations: Any) -> Callable[[], np.ndarray]:
    """log Z-hat of every seed, when called."""

    def once() -> np.ndarray:
        run = mpfjax.monte_carlo(keys, filter, observations, nothing)
        return np.asarray(run.log_marginal_likelihood, float)

    return once


def nothing(mixture: mpfjax.ParticleMixture) -> None:
    """What is collected."""


def errors(found: np.ndarray) -> dict[str, float]:
    """Of the errors of log Z-hat."""
    ratios = np.exp(found)
    return {
        "bias": float(found.mean()),
        "rms": float(np.sqrt(np.mean(found**2))),
        "ratio": float(ratios.mean()),
        "ratio_error": float(ratios.std() / np.sqrt(len(ratios))),
    }


def row_of(result: dict[str, Any]) -> list[str]:
    """A line of the table."""
    return [
        result["filter"],
        str(result["N"]),
        f"{result['bias']:.2f}",
        f"{result['rms']:.2f}",
        f"{result['ratio']:.2f} ± {result['ratio_error']:.2f}",
        f"{result['ms']:.2f}",
    ]


if __name__ == "__main__":
    sys.exit(main())
