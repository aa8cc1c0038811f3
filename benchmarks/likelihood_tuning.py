"""Which gradients of a filter's likelihood can be trusted, and tuning by those that can.

Part a: bias, spread and time of every gradient estimator against exact scores. Part b: σ_x and
σ_y of the quadratic model tuned from random starts, against the exact maximum. Part c: a colour
likelihood tuned on labelled frames, and trackers with and without it on held-out ones. Run with
`python -m benchmarks.likelihood_tuning`; `--help` lists the options.
"""

import argparse
import sys
import time
from collections.abc import Callable, Iterator
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
from benchmarks.label_tuning import CLIMB_STEPS as LABEL_STEPS
from benchmarks.label_tuning import SEQUENCES, run_labels
from benchmarks.score_vs_particles import HIGH, LOW, position, simulate
from mpfjax import plotting
from mpfjax.console import fill_in, format_table, seed, whole, write_json
from mpfjax.exact import grid_filter, kalman_filter
from mpfjax.tuning import Positive, TuningRun, fit

ESTIMATORS = {
    "none": "plain derivative",
    "soft": "soft resampling",
    "straight_through": "straight-through",
    "ot": "entropic transport",
    "pathwise": "stop-gradient, draws differentiated",
    "stop": "stop-gradient",
}
FILTERS = ("pf", "mpf")
MODELS = {"linear_gaussian": ("a", "log q", "log r"), "quadratic": ("log σ_x", "log σ_y")}
# Transport costs O(N²) an iteration and step.
LARGEST_TRANSPORT = 100
MOST_TRANSPORTS = 20
LINEAR_GAUSSIAN_STEPS = 50
GRID = (-3.0, 3.0, 1201)
COARSE_GRID = (-3.0, 3.0, 801)
STARTS = (0.04, 0.5)
TUNED_PARTICLES = 200
TUNED_SEEDS = 16
CLIMB_STEPS = 120
RATE = 0.15
CURVATURE_SEEDS = 128
TOLERANCE = 0.03
# Drawn once: under double precision the same key would draw another set.
OBSERVATIONS = np.asarray(simulate(2)[1])


def main(arguments: list[str] | None = None) -> int:
    """Run the parts that were asked for, print their tables, write their results and figures."""
    options = parse(arguments)
    out = Path(options.out)
    try:
        if "a" in options.parts:
            run_scores(options, out)
        if "b" in options.parts:
            run_starts(options, out)
        if "c" in options.parts:
            run_labels(options, out)
    except FileNotFoundError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"interrupted: what was finished is in {out}", file=sys.stderr)
        return 130
    print(f"results: {out}/")
    return 0


def parse(arguments: list[str] | None) -> argparse.Namespace:
    """The options, or a message that names the one that cannot be run."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.likelihood_tuning")
    parser.add_argument("--parts", nargs="+", choices=("a", "b", "c"), default=["a", "b", "c"])
    parser.add_argument("--runs", type=whole(), help="a: seeds for each estimator; default: 200")
    parser.add_argument(
        "--particles", type=whole(2), nargs="+", metavar="N", help="a; default: 100 1000"
    )
    parser.add_argument("--estimators", nargs="+", choices=list(ESTIMATORS), help="a; default: all")
    parser.add_argument("--models", nargs="+", choices=list(MODELS), help="a; default: all")
    parser.add_argument("--filters", nargs="+", choices=FILTERS, help="a; default: all")
    parser.add_argument("--starts", type=whole(), help="b: random starts; default: 20")
    parser.add_argument("--steps", type=whole(), help=f"b: of each climb; default: {CLIMB_STEPS}")
    parser.add_argument("--sequences", nargs="+", choices=SEQUENCES, help="c; default: all")
    parser.add_argument("--label-runs", type=whole(2), help="c: seeds of each filter; default: 6")
    parser.add_argument(
        "--label-steps", type=whole(), help=f"c: of each climb; default: {LABEL_STEPS}"
    )
    parser.add_argument("--seed", type=seed, default=0)
    parser.add_argument("--out", default="results/likelihood_tuning", metavar="DIR")
    options = parser.parse_args(arguments)
    defaults: dict[str, dict[str, Any]] = {
        "a": {
            "runs": 200,
            "particles": [100, 1000],
            "estimators": list(ESTIMATORS),
            "models": list(MODELS),
            "filters": FILTERS,
        },
        "b": {"starts": 20, "steps": CLIMB_STEPS},
        "c": {"sequences": SEQUENCES, "label_runs": 6, "label_steps": LABEL_STEPS},
    }
    for part, own in defaults.items():
        fill_in(parser, options, part in options.parts, f"without part {part}", **own)
    return options


# Part a.


class Task(NamedTuple):
    """A model as a function of a few numbers, data, and the exact score at the true numbers."""

    build: Callable[[Array], Any]
    observations: Array
    point: Array
    exact: np.ndarray


def run_scores(options: argparse.Namespace, out: Path) -> None:
    """Every estimator of every filter, one cell after the other."""
    tasks = {"linear_gaussian": linear_gaussian_task(), "quadratic": quadratic_task()}
    cells = [
        (model, filter, n, estimator)
        for model in options.models
        for n in options.particles
        for filter in options.filters
        for estimator in options.estimators
        if estimator != "ot" or n <= LARGEST_TRANSPORT
    ]
    results = []
    for cell in tqdm(cells, disable=not sys.stderr.isatty(), unit="cell"):
        results.append(measure(*cell, tasks[cell[0]], options.runs, options.seed))
        write_json(out / "scores.json", {"settings": settings_of(options), "results": results})
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


def build_quadratic(point: Array) -> mpfjax.QuadraticModel:
    """σ_x and σ_y from their logarithms."""
    return mpfjax.QuadraticModel(jnp.exp(point[0]), jnp.exp(point[1]), LOW, HIGH)


def exact_quadratic(grid: tuple[float, float, int]) -> Callable[[np.ndarray], tuple]:
    """log Z and its gradient by the grid filter, under the precision of the caller."""
    observations = jnp.asarray(OBSERVATIONS, float)
    points = jnp.linspace(*grid)

    def log_evidence(point: Array) -> Array:
        return grid_filter(build_quadratic(point), observations, points).log_marginal_likelihood

    both = jax.jit(jax.value_and_grad(log_evidence))
    return lambda point: tuple(np.asarray(v, float) for v in both(jnp.asarray(point, float)))


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

    if estimator == "ot":
        num_runs = min(num_runs, MOST_TRANSPORTS)
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
        "standard_error": (scores.std(axis=0) / np.sqrt(num_runs)).tolist() if is_finite else None,
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


# Part b.


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


def run_starts(options: argparse.Namespace, out: Path) -> None:
    """Climb from every start, and compare with the exact maximum."""
    maximum = exact_maximum()
    rng = np.random.default_rng(options.seed)
    starts = np.exp(rng.uniform(*np.log(STARTS), size=(options.starts, 2)))
    results: list[dict[str, Any]] = []
    paths = []
    for start, run in climbs(starts, options):
        results.append(compare(start, run, maximum))
        paths.append(np.stack([run.history["sigma_x"], run.history["sigma_y"]], axis=1))
        content = {
            "settings": settings_of(options),
            "exact": np.exp(maximum.point).tolist(),
            "exact_relative_errors": maximum.errors.tolist(),
            "results": results,
        }
        write_json(out / "starts.json", content)
    print(as_start_table(results, maximum))
    levels = surface()
    figure = plotting.draw_climbs(*levels, paths, np.exp(maximum.point))
    figure.savefig(out / "climbs.png", dpi=150)


def climbs(
    starts: np.ndarray, options: argparse.Namespace
) -> Iterator[tuple[np.ndarray, TuningRun]]:
    """The climb from each start, with seeds of its own."""
    for k, start in enumerate(tqdm(starts, disable=not sys.stderr.isatty(), unit="start")):
        yield (
            start,
            climb(jax.random.fold_in(jax.random.key(options.seed), k), start, options.steps),
        )


def climb(key: Array, start: np.ndarray, num_steps: int) -> TuningRun:
    """The guided mixture particle filter's likelihood, climbed from one start."""
    model = mpfjax.QuadraticModel(float(start[0]), float(start[1]), LOW, HIGH)
    filter = mpfjax.mixture_particle_filter(
        model,
        TUNED_PARTICLES,
        max_components=2,
        proposal=mpfjax.GaussNewtonProposal(model, noise="stratified"),
        sort_by=position,
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
    """Where a climb ended, and its standard errors, relative to the exact ones."""
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


def settings_of(options: argparse.Namespace) -> dict[str, Any]:
    """Everything that a second run needs to be the same."""
    return {
        "runs": options.runs,
        "particles": options.particles,
        "starts": options.starts,
        "steps": options.steps,
        "seed": options.seed,
        "tuned_particles": TUNED_PARTICLES,
        "tuned_seeds": TUNED_SEEDS,
        "curvature_seeds": CURVATURE_SEEDS,
        "rate": RATE,
        "start_range": STARTS,
        "jax": jax.__version__,
        "mpfjax": mpfjax.__version__,
    }


if __name__ == "__main__":
    sys.exit(main())
