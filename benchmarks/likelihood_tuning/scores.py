"""Part a: bias, spread and time of every gradient estimator against exact scores."""

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from tqdm import tqdm

import mpfjax
from benchmarks.likelihood_tuning.quadratic import (
    GRID,
    OBSERVATIONS,
    build_quadratic,
    exact_quadratic,
)
from mpfjax.console import format_table, write_json
from mpfjax.exact import kalman_filter

ESTIMATORS = {
    "none": "plain derivative",
    "pathwise": "stop-gradient, draws differentiated",
    "stop": "stop-gradient",
}
FILTERS = ("pf", "mpf")
MODELS = {"linear_gaussian": ("a", "log q", "log r"), "quadratic": ("log σ_x", "log σ_y")}
LINEAR_GAUSSIAN_STEPS = 50


class Task(NamedTuple):
    """A model as a function of a few numbers, data, and the exact score at the true numbers."""

    build: Callable[[Array], Any]
    observations: Array
    point: Array
    exact: np.ndarray


def run_scores(options: argparse.Namespace, settings: dict[str, Any], out: Path) -> None:
    """Every estimator of every filter, one cell after the other."""
    tasks = {"linear_gaussian": linear_gaussian_task(), "quadratic": quadratic_task()}
    cells = [
        (model, filter, n, estimator)
        for model in options.models
        for n in options.particles
        for filter in options.filters
        for estimator in options.estimators
    ]
    results = []
    for cell in tqdm(cells, disable=not sys.stderr.isatty(), unit="cell"):
        results.append(measure(*cell, tasks[cell[0]], options.runs, options.seed))
        write_json(out / "scores.json", {"settings": settings, "results": results})
    print(as_score_table(results))


def linear_gaussian_task() -> Task:
    """A scalar autoregression seen with noise, data of its own."""

    def build(point: Array) -> mpfjax.LinearGaussianModel:
        a, q, r = point[0], jnp.exp(2 * point[1]), jnp.exp(2 * point[2])
        one = jnp.ones((1, 1))
        return mpfjax.LinearGaussianModel(
            A=a * one, Q=q * one, H=one, R=r * one, m0=jnp.zeros(1), P0=one
        )

    rng = np.random.default_rng(0)
    state, observations = 0.0, []
    for _ in range(LINEAR_GAUSSIAN_STEPS):
        state = 0.9 * state + 0.6 * rng.normal()
        observations.append([state + 0.5 * rng.normal()])
    data = jnp.array(observations)
    point = jnp.array([0.7, np.log(0.8), np.log(0.4)], jnp.float32)
    exact = jax.grad(lambda p: kalman_filter(build(p), data).log_marginal_likelihood)(point)
    return Task(build, data, point, np.asarray(exact))


def quadratic_task() -> Task:
    """The quadratic model on the data of section 5.1, away from its maximum."""
    point = np.log([0.12, 0.12])
    with jax.enable_x64(True):
        exact = exact_quadratic(GRID)(point)[1]
    return Task(build_quadratic, jnp.asarray(OBSERVATIONS), jnp.asarray(point, jnp.float32), exact)


def build_filter(name: str, model: Any, num_particles: int, estimator: str) -> mpfjax.Filter:
    """The filter of that name with that estimator."""
    if estimator != "pathwise":
        if name == "pf":
            return mpfjax.particle_filter(model, num_particles, gradient=estimator)
        return mpfjax.mixture_particle_filter(model, num_particles, 2, gradient=estimator)
    moves = [mpfjax.Resample(gradient="stop"), mpfjax.Propagate(model)]
    if name == "pf":
        return mpfjax.Filter(model, moves, num_particles)
    grouping = [mpfjax.Merge(), mpfjax.Split(), mpfjax.KMeans()]
    seeds = [mpfjax.KMeans(10, reseed=True)]
    return mpfjax.Filter(model, [*moves, *grouping], num_particles, 2, initial_moves=seeds)


def measure(
    model: str, filter: str, n: int, estimator: str, task: Task, num_runs: int, seed: int
) -> dict[str, Any]:
    """Mean and spread of the score over seeds, and the processor time of a gradient and a run."""

    def log_evidence(point: Array, key: Array) -> Array:
        built = build_filter(filter, task.build(point), n, estimator)
        run = mpfjax.run_filter(key, built, task.observations, nothing)
        return run.log_marginal_likelihood

    keys = jax.random.split(jax.random.key(seed), num_runs)
    run = compiled(jax.vmap(log_evidence, in_axes=(None, 0)), task.point, keys)
    score = compiled(jax.vmap(jax.grad(log_evidence), in_axes=(None, 0)), task.point, keys)
    run_time, _ = timed(run, task.point, keys)
    score_time, scores = timed(score, task.point, keys)
    scores = scores.astype(float)
    is_finite = bool(np.isfinite(scores).all())
    return {
        "model": model,
        "filter": filter,
        "particles": n,
        "estimator": estimator,
        "runs": num_runs,
        "exact": task.exact.tolist(),
        "finite_runs": int(np.isfinite(scores).all(axis=1).sum()),
        "bias": (scores.mean(axis=0) - task.exact).tolist() if is_finite else None,
        "standard_error": (scores.std(axis=0, ddof=1) / np.sqrt(num_runs)).tolist()
        if is_finite
        else None,
        "deviation": scores.std(axis=0).tolist() if is_finite else None,
        "milliseconds": 1000 * score_time / num_runs,
        "cost_in_runs": score_time / run_time,
    }


def nothing(mixture: mpfjax.ParticleMixture) -> None:
    """Of the mixtures, only the likelihood is wanted."""
    del mixture


def compiled(function: Callable[..., Array], *arguments: Array) -> Callable[..., Array]:
    """The function, compiled ahead so that its time is that of its running."""
    return jax.jit(function).lower(*arguments).compile()


def timed(function: Callable[..., Array], *arguments: Array) -> tuple[float, np.ndarray]:
    """The least processor time of three calls, which other programs disturb least."""
    times = []
    for _ in range(3):
        start = time.process_time()
        result = jax.block_until_ready(function(*arguments))
        times.append(time.process_time() - start)
    return min(times), np.asarray(result)


def as_score_table(results: list[dict[str, Any]]) -> str:
    """The estimators in a table for the terminal, a block a model."""
    blocks = []
    for model, names in MODELS.items():
        entries = [entry for entry in results if entry["model"] == model]
        if entries:
            exact = zip(names, entries[0]["exact"], strict=True)
            header = ["estimator", "filter", "N", *(f"{name} ({x:.1f})" for name, x in exact)]
            rows = [as_score_row(entry) for entry in entries]
            title = (
                f"{model}: bias ± standard error (deviation of one run) of the score, exact in ()"
            )
            blocks.append(f"{title}\n{format_table([*header, 'ms', 'runs'], rows)}")
    return "\n\n".join(blocks)


def as_score_row(entry: dict[str, Any]) -> list[str]:
    """One estimator of one filter; words where its derivatives overflowed."""
    numbers = [f"overflows in {entry['runs'] - entry['finite_runs']} runs"] * len(entry["exact"])
    if entry["bias"] is not None:
        parts = zip(entry["bias"], entry["standard_error"], entry["deviation"], strict=True)
        numbers = [f"{bias:+.2f} ± {error:.2f} ({spread:.1f})" for bias, error, spread in parts]
    return [
        ESTIMATORS[entry["estimator"]],
        entry["filter"],
        str(entry["particles"]),
        *numbers,
        f"{entry['milliseconds']:.1f}",
        f"{entry['cost_in_runs']:.1f}",
    ]
