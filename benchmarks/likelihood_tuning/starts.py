"""Part b: the quadratic model tuned from random starts, against the exact maximum."""

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array
from scipy.optimize import minimize
from tqdm import tqdm

import mpfjax
from benchmarks import figures as plotting
from benchmarks.likelihood_tuning.quadratic import COARSE_GRID, GRID, OBSERVATIONS, exact_quadratic
from benchmarks.score_vs_particles import HIGH, LOW
from mpfjax.console import format_table, write_figure, write_json
from mpfjax.tuning import Positive, TuningRun, fit

STARTS = (0.04, 0.5)
TUNED_PARTICLES = 200
TUNED_SEEDS = 16
CLIMB_STEPS = 120
RATE = 0.15
CURVATURE_SEEDS = 128
TOLERANCE = 0.03


class Maximum(NamedTuple):
    """The exact maximum in log σ_x, log σ_y, and the standard errors of these two."""

    point: np.ndarray
    errors: np.ndarray


def exact_maximum() -> Maximum:
    """By BFGS on the grid filter, in double precision."""
    with jax.enable_x64(True):
        both = exact_quadratic(GRID)
        found = minimize(
            lambda point: tuple(-value for value in both(point)), np.log([0.1, 0.06]), jac=True
        )
        step = 1e-3
        columns = [
            (both(found.x - offset)[1] - both(found.x + offset)[1]) / (2 * step)
            for offset in step * np.eye(2)
        ]
    covariance = np.linalg.inv((np.stack(columns) + np.stack(columns).T) / 2)
    return Maximum(found.x, np.sqrt(np.diagonal(covariance)))


def run_starts(options: argparse.Namespace, settings: dict[str, Any], out: Path) -> None:
    """Optimisation from every start, and compare with the exact maximum."""
    maximum = exact_maximum()
    rng = np.random.default_rng(options.seed)
    starts = np.exp(rng.uniform(*np.log(STARTS), size=(options.starts, 2)))
    results: list[dict[str, Any]] = []
    paths = []
    for start, run in optimisations(starts, options):
        results.append(compare(start, run, maximum))
        paths.append(np.stack([run.history["sigma_x"], run.history["sigma_y"]], axis=1))
        content = {
            "settings": settings,
            "exact": np.exp(maximum.point).tolist(),
            "exact_relative_errors": maximum.errors.tolist(),
            "results": results,
        }
        write_json(out / "starts.json", content)
    print(as_start_table(results, maximum))
    levels = surface()
    figure = plotting.draw_optimisations(*levels, paths, np.exp(maximum.point))
    write_figure(out / "optimisations.png", figure, dpi=150)


def optimisations(
    starts: np.ndarray, options: argparse.Namespace
) -> Iterator[tuple[np.ndarray, TuningRun]]:
    """The optimisation from each start, with seeds of its own."""
    for k, start in enumerate(tqdm(starts, disable=not sys.stderr.isatty(), unit="start")):
        yield (
            start,
            optimisation(jax.random.fold_in(jax.random.key(options.seed), k), start, options.steps),
        )


def optimisation(key: Array, start: np.ndarray, num_steps: int) -> TuningRun:
    """The guided mixture particle filter's likelihood, climbed from one start."""
    model = mpfjax.QuadraticModel(float(start[0]), float(start[1]), LOW, HIGH)
    filter = mpfjax.mixture_particle_filter(
        model,
        TUNED_PARTICLES,
        max_components=2,
        proposal=mpfjax.GaussNewtonProposal(model),
        noise="rqmc",
        gradient="stop",
    )
    return fit(
        key,
        filter,
        jnp.asarray(OBSERVATIONS),
        optax.adam(optax.cosine_decay_schedule(RATE, num_steps)),
        num_steps,
        parameters={"sigma_x": lambda f: f.model.sigma_x, "sigma_y": lambda f: f.model.sigma_y},
        transforms={"sigma_x": Positive(), "sigma_y": Positive()},
        num_seeds=TUNED_SEEDS,
        curvature_seeds=CURVATURE_SEEDS,
        progress=False,
    )


def compare(start: np.ndarray, run: TuningRun, maximum: Maximum) -> dict[str, Any]:
    """Where an optimisation ended, and its standard errors, relative to the exact ones."""
    end = np.array([run.parameters["sigma_x"], run.parameters["sigma_y"]], float)
    errors = None
    if run.standard_errors is not None:
        found = np.array([run.standard_errors["sigma_x"], run.standard_errors["sigma_y"]], float)
        errors = (found / end / maximum.errors).tolist()
    return {
        "start": start.tolist(),
        "end": end.tolist(),
        "relative_error": (end / np.exp(maximum.point) - 1).tolist(),
        "standard_errors_over_exact": errors,
        "stopped": run.stopped,
    }


def as_start_table(results: list[dict[str, Any]], maximum: Maximum) -> str:
    """A line for each start, and how many ended where they should."""
    rows = [
        [
            " ".join(f"{value:.3f}" for value in entry["start"]),
            " ".join(f"{value:.4f}" for value in entry["end"]),
            " ".join(f"{100 * value:+.1f}%" for value in entry["relative_error"]),
            " ".join(f"{value:.2f}" for value in entry["standard_errors_over_exact"] or []),
        ]
        for entry in results
    ]
    near = sum(np.abs(entry["relative_error"]).max() < TOLERANCE for entry in results)
    best = " ".join(f"{value:.4f}" for value in np.exp(maximum.point))
    header = ["start", "end", "off by", "standard errors / exact"]
    return (
        f"{format_table(header, rows)}\n"
        f"{near} of {len(results)} end within {TOLERANCE:.0%} of the exact maximum, {best}"
    )


def surface() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The exact log marginal likelihood on a grid of σ_x and σ_y."""
    sigmas_x, sigmas_y = np.geomspace(0.03, 0.6, 16), np.geomspace(0.03, 0.6, 16)
    both = exact_quadratic(COARSE_GRID)
    values = [[both(np.log([x, y]))[0] for x in sigmas_x] for y in sigmas_y]
    return sigmas_x, sigmas_y, np.array(values, float)
