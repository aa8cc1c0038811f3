"""Which gradients of a filter's likelihood can be trusted, and what `fit` learns with them.

Bias, spread and time of every gradient estimator against exact scores; the tasks that PyDPF's
examples publish, stochastic volatility and a linear-Gaussian model of 25 dimensions.
Run with `python -m benchmarks.likelihood_tuning`; `--help` lists the options.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from time import process_time
from typing import Annotated, Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import mpfjax
from benchmarks import harness
from benchmarks.harness import AtLeast2, Count, Seed, command
from benchmarks.likelihood_tuning import many_dimensions, volatility
from benchmarks.score_vs_particles import HIGH, LOW, simulate
from mpfjax.exact import grid_filter, kalman_filter

ESTIMATORS = {
    "none": "plain derivative",
    "pathwise": "stop-gradient, draws differentiated",
    "stop": "stop-gradient",
}
PARTS = ("gradients", "shifts", "learned", "coverage", "many_dimensions", "scores")
MODELS = {"linear_gaussian": ("a", "log q", "log r"), "quadratic": ("log σ_x", "log σ_y")}
# Drawn once: under double precision the same key would draw another set.
OBSERVATIONS = np.asarray(simulate(2)[1])


@command(
    runs=10, particles=[20], models=["quadratic"], filters=["pf"], estimators=["stop"],
    series=4, data_sets=1, steps=2, dimensions=9, methods=["pooled"],
)  # fmt: skip
def main(
    *,
    parts: Sequence[Annotated[str, (*PARTS,)]] = PARTS,
    runs: Count = 200,
    particles: Sequence[AtLeast2] = (100, 1000),
    estimators: Sequence[Annotated[str, (*ESTIMATORS,)]] = (*ESTIMATORS,),
    models: Sequence[Annotated[str, (*MODELS,)]] = (*MODELS,),
    filters: Sequence[Literal["pf", "mpf"]] = ("pf", "mpf"),
    methods: Sequence[Annotated[str, (*volatility.METHODS,)]] = (*volatility.METHODS,),
    series: Count = 250,
    data_sets: Count = 10,
    steps: Count = volatility.NUM_STEPS,
    dimensions: Count = 25,
    seed: Seed = 0,
    out: Path = Path("results/likelihood_tuning"),
) -> None:
    """Cell by cell; what is finished is written.

    - `parts`: scores of two models; gradients, the shift of the maximum, learned parameters and
      coverage of their intervals for stochastic volatility; the filters in many dimensions.
    - `runs`: seeds for each estimator.
    - `methods`: of `fit`, on stochastic volatility.
    - `series`: of each data set of stochastic volatility; a fifth of it for coverage.
    - `steps`: of `fit` on each of the `data_sets`.
    - `dimensions`: of the linear-Gaussian model.
    """
    settings = harness.settings_of(locals())
    others = {
        "gradients": lambda: volatility.gradients(methods, runs, seed),
        "shifts": lambda: volatility.shifts(methods, series, max(runs // 5, 2), seed),
        "learned": lambda: volatility.learned(methods, series, data_sets, steps, seed),
        "coverage": lambda: volatility.coverage(
            methods, max(series // 5, 1), data_sets, steps, seed
        ),
        "many_dimensions": lambda: many_dimensions.errors(dimensions, runs // 10, seed),
    }
    for part in parts:
        if part != "scores":
            title, table, entries = others[part]()
            harness.data(out / f"{part}.json", settings=settings, results=entries)
            print(f"{title}\n{table}\n")
    if "scores" not in parts:
        return
    tasks = {"linear_gaussian": linear_gaussian_task(), "quadratic": quadratic_task()}
    results = []
    for model, size, filter, estimator in harness.grid(
        "cell", models, particles, filters, estimators
    ):
        results.append(measure(model, filter, size, estimator, tasks[model], runs, seed))
        harness.data(out / "scores.json", settings=settings, results=results)
    print(score_tables(results))
    print(f"results: {out}/")


def build_quadratic(point: Array) -> mpfjax.QuadraticModel:
    """σ_x and σ_y from their logarithms."""
    return mpfjax.QuadraticModel(jnp.exp(point[0]), jnp.exp(point[1]), LOW, HIGH)


# A model as a function of a few numbers, data, and the exact score at the true numbers.
Task = tuple[Callable[[Array], Any], Array, Array, np.ndarray]


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
    for _ in range(50):
        state = 0.9 * state + 0.6 * rng.normal()
        observations.append([state + 0.5 * rng.normal()])
    data = jnp.array(observations)
    point = jnp.array([0.7, np.log(0.8), np.log(0.4)], jnp.float32)
    exact = jax.grad(lambda p: kalman_filter(build(p), data).log_marginal_likelihood)(point)
    return build, data, point, np.asarray(exact)


def quadratic_task() -> Task:
    """The quadratic model on the data of section 5.1, away from its maximum.

    The exact score is that of the grid filter, in double precision.
    """
    point = np.log([0.12, 0.12])

    def log_evidence(point: Array) -> Array:
        grid, observations = jnp.linspace(-3.0, 3.0, 1201), jnp.asarray(OBSERVATIONS, float)
        return grid_filter(build_quadratic(point), observations, grid).log_marginal_likelihood

    with jax.enable_x64(True):
        exact = np.asarray(jax.jit(jax.grad(log_evidence))(jnp.asarray(point, float)))
    return build_quadratic, jnp.asarray(OBSERVATIONS), jnp.asarray(point, jnp.float32), exact


def build_filter(name: str, model: Any, num_particles: int, estimator: Any) -> mpfjax.Filter:
    """The filter of that name with that estimator."""
    if estimator != "pathwise":
        if name == "pf":
            return mpfjax.particle_filter(model, num_particles, gradient=estimator)
        return mpfjax.mixture_particle_filter(model, num_particles, 2, gradient=estimator)
    moves = [mpfjax.Resample(gradient="stop"), mpfjax.Propagate()]
    if name == "pf":
        return mpfjax.Filter(model, moves, num_particles)
    grouping = [mpfjax.Merge(), mpfjax.Split(), mpfjax.KMeans()]
    seeds = [mpfjax.KMeans(10, reseed=True)]
    return mpfjax.Filter(model, [*moves, *grouping], num_particles, 2, initial_moves=seeds)


def measure(
    model: str, filter: str, n: int, estimator: str, task: Task, num_runs: int, seed: int
) -> dict[str, Any]:
    """Mean and spread of the score over seeds, and the processor time of a gradient and a run."""
    build, observations, true, exact = task

    def log_evidence(point: Array, key: Array) -> Array:
        built = build_filter(filter, build(point), n, estimator)
        run = mpfjax.run_filter(key, built, observations, harness.nothing)
        return run.log_marginal_likelihood

    keys = jax.random.split(jax.random.key(seed), num_runs)
    given = true, keys
    run = jax.jit(jax.vmap(log_evidence, in_axes=(None, 0)))
    score = jax.jit(jax.vmap(jax.grad(log_evidence), in_axes=(None, 0)))
    # The least processor time of three calls, which other programs disturb least.
    calls = {"run": lambda _: run(*given), "score": lambda _: score(*given)}
    taken = {name: t.min() for name, t in harness.turns(calls, 3, clock=process_time).items()}
    scores = np.asarray(score(*given)).astype(float)
    return {
        "model": model, "filter": filter, "particles": n, "estimator": estimator, "runs": num_runs,
        "exact": exact, "milliseconds": 1000 * taken["score"] / num_runs,
        "cost_in_runs": taken["score"] / taken["run"], "bias": scores.mean(axis=0) - exact,
        "standard_error": scores.std(axis=0, ddof=1) / np.sqrt(num_runs),
        "deviation": scores.std(axis=0),
    }  # fmt: skip


def score_tables(results: list[dict[str, Any]]) -> str:
    """The estimators in a table for the terminal, a block a model."""

    def cell(entry: dict[str, Any], k: int) -> str:
        error, deviation = entry["standard_error"][k], entry["deviation"][k]
        return f"{entry['bias'][k]:+.2f} ± {error:.2f} ({deviation:.1f})"

    blocks = []
    for model in dict.fromkeys(entry["model"] for entry in results):
        entries = [entry for entry in results if entry["model"] == model]
        columns: dict[str, Any] = {"estimator": lambda entry: ESTIMATORS[entry["estimator"]]}
        columns |= {"filter": "{filter}", "N": "{particles}"}
        for k, name in enumerate(MODELS[model]):
            title = f"{name} ({entries[0]['exact'][k]:.1f})"
            columns[title] = lambda entry, k=k: cell(entry, k)
        columns |= {"ms": "{milliseconds:.1f}", "runs": "{cost_in_runs:.1f}"}
        title = f"{model}: bias ± standard error (deviation of one run) of the score, exact in ()"
        blocks.append(f"{title}\n{harness.table(columns, entries)}")
    return "\n\n".join(blocks)


if __name__ == "__main__":
    raise SystemExit(main())
