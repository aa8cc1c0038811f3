"""A published task: the parameters of stochastic volatility, learned from many series.

Brady, Cox, Elvira and Li (2025), PyDPF, whose examples publish the spread of gradients and the
errors of learned parameters, with N = 100. The grid filter has the exact scores and maxima.
"""

import warnings
from collections.abc import Sequence
from functools import partial
from time import process_time
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.scipy.stats import norm
from jaxtyping import Array, Float

import mpfjax
from benchmarks import harness
from mpfjax.exact import grid_filter
from mpfjax.models.series import Series
from mpfjax.tuning import Interval, Positive, fit, standard_errors
from mpfjax.tuning.evidence import FisherEvidence, LogEvidence
from mpfjax.tuning.problem import Reals, averages

LENGTH = 101
TRUTH = {"alpha": 0.91, "beta": 0.5, "sigma": 1.0}
PARAMETERS = {name: lambda filter, name=name: getattr(filter.model, name) for name in TRUTH}
TRANSFORMS = {"alpha": Interval(0.0, 1.0), "beta": Positive(), "sigma": Positive()}
# Its tables: the spread of the score in α per observation, and the mean errors of what is learned.
PUBLISHED = [
    {"method": "pydpf, detached", "deviation": 0.035,
     "alpha": 0.0044, "beta": 0.040, "sigma": 0.027},
    {"method": "pydpf, stop-gradient", "deviation": 1.165,
     "alpha": 0.0126, "beta": 0.113, "sigma": 0.049},
    {"method": "pydpf, marginal stop-gradient", "deviation": 0.476,
     "alpha": 0.0044, "beta": 0.115, "sigma": 0.049},
]  # fmt: skip
ERRORS = {name: f"{{{name}:.4f}}" for name in TRUTH}
Table = tuple[str, str, list[dict[str, Any]]]  # its title, what it shows, and its entries
# Of fit: the gradient of the filter, the score, whether seeds are pooled, their number, a title.
METHODS: dict[str, tuple[Any, Any, bool, int, str]] = {
    "none": ("none", "filter", False, 1, "no gradient of resampling, K = 1"),
    "one": ("stop", "filter", False, 1, "mean of log Ẑ, K = 1"),
    "mean": ("stop", "filter", False, 8, "mean of log Ẑ, K = 8"),
    "pooled": ("stop", "filter", True, 8, "log of mean Ẑ, jackknife, K = 8"),
    "fisher": ("none", "fisher", True, 8, "the same, Fisher's identity"),
}
TITLES = {name: method[-1] for name, method in METHODS.items()} | {"exact": "exact maximum"}
NUM_PARTICLES, BATCH, NUM_STEPS, CURVATURE_SEEDS = 100, 32, 100, 64


class StochasticVolatility(mpfjax.AbstractStateSpaceModel):
    """x_t = α x_{t-1} + σ N(0, 1), x_0 stationary; y_t ~ N(0, β² exp x_t)."""

    alpha: Float[Array, ""] = eqx.field(converter=jnp.asarray)
    beta: Float[Array, ""] = eqx.field(converter=jnp.asarray)
    sigma: Float[Array, ""] = eqx.field(converter=jnp.asarray)

    @property
    def deviation(self) -> Float[Array, ""]:
        """That of x_0."""
        return self.sigma / jnp.sqrt(1 - self.alpha**2)

    def sample_initial(self, key: Array, num_particles: int) -> Float[Array, " n"]:
        """From the stationary distribution."""
        return self.deviation * jax.random.normal(key, (num_particles,))

    def sample_transition(self, key: Array, states: Float[Array, " n"]) -> Float[Array, " n"]:
        """One step of the autoregression."""
        return self.alpha * states + self.sigma * jax.random.normal(key, states.shape)

    def log_initial(self, states: Float[Array, " n"]) -> Float[Array, " n"]:
        """The density of the stationary distribution."""
        return norm.logpdf(states, 0.0, self.deviation)

    def log_transition(
        self, states: Float[Array, " n"], previous_states: Float[Array, " n"]
    ) -> Float[Array, " n"]:
        """The density of a step."""
        return norm.logpdf(states, self.alpha * previous_states, self.sigma)

    def log_likelihood(
        self, observation: Float[Array, ""], states: Float[Array, " n"]
    ) -> Float[Array, " n"]:
        """y_t ~ N(0, β² exp x_t)."""
        return norm.logpdf(observation, 0.0, self.beta * jnp.exp(states / 2))


def simulate(num_series: int, seed: int) -> Float[np.ndarray, "series t"]:
    """Series with the true parameters."""
    rng = np.random.default_rng(seed)
    alpha, beta, sigma = TRUTH.values()
    states = rng.normal(size=num_series) * sigma / np.sqrt(1 - alpha**2)
    rows = []
    for _ in range(LENGTH):
        states = alpha * states + sigma * rng.normal(size=num_series)
        rows.append(beta * np.exp(states / 2) * rng.normal(size=num_series))
    return np.array(rows, np.float32).T


def volatility_filter(gradient: Any, start: dict[str, Any]) -> mpfjax.Filter:
    """The bootstrap filter."""
    model = StochasticVolatility(**start)
    return mpfjax.particle_filter(model, NUM_PARTICLES, gradient=gradient)


def constrained(reals: Reals) -> dict[str, Array]:
    """The parameters on their own scale."""
    return {name: TRANSFORMS[name].constrain(u) for name, u in reals.items()}


def unconstrained(values: dict[str, float]) -> Reals:
    """Logit and logarithms."""
    return {name: TRANSFORMS[name].unconstrain(jnp.float32(v)) for name, v in values.items()}


@jax.jit
def exact_scores(reals: Reals, observations: Float[Array, "s t"]) -> Float[Array, "s 3"]:
    """The score of each series by the grid filter, α, β and σ."""
    grid = jnp.linspace(-16.0, 16.0, 161)

    @jax.grad
    def score(reals: Reals, y: Array) -> Array:
        model = StochasticVolatility(**constrained(reals))
        return grid_filter(model, y, grid).log_marginal_likelihood

    return jax.lax.map(lambda y: jnp.stack([*score(reals, y).values()]), observations, batch_size=8)


@partial(jax.jit, static_argnames="method")
def estimated_scores(
    reals: Reals, observations: Array, keys: Array, method: str
) -> Float[Array, "s 3"]:
    """The same by a method of `fit`, with one key for each series."""
    gradient, score, pooled, num_seeds, _ = METHODS[method]
    evidence = FisherEvidence if score == "fisher" else LogEvidence

    @jax.grad
    def derivative(reals: Reals, y: Array, key: Array) -> Array:
        filter, of_series = volatility_filter(gradient, constrained(reals)), evidence([Series(y)])
        keys = jax.random.split(key, num_seeds)
        values = jax.vmap(lambda key: of_series(key, filter)[0])(keys)
        return averages(values[:, None], pooled)[0]

    def of_series(one: tuple[Array, Array]) -> Array:
        return jnp.stack([*derivative(reals, *one).values()])

    rows = observations[:, None], keys
    return jax.lax.map(of_series, rows, batch_size=64 // num_seeds)


def gradients(methods: Sequence[str], runs: int, seed: int) -> Table:
    """The score in α per observation, of one series at α = .93, by each method of `fit`."""
    y = jnp.asarray(simulate(1, seed))
    at = unconstrained(TRUTH | {"alpha": 0.93})
    slope = LENGTH * 0.93 * 0.07  # of the logit, for scores in α itself, per observation
    exact = float(exact_scores(at, y)[0, 0]) / slope
    keys, entries = jax.random.split(jax.random.key(seed), runs), []
    copies = jnp.broadcast_to(y, (runs, LENGTH))
    for method in methods:
        start = process_time()
        rows = np.asarray(estimated_scores(at, copies, keys, method))
        values = rows[:, 0] / slope
        entries.append({
            "method": METHODS[method][-1], "exact": exact, "bias": float(values.mean() - exact),
            "standard_error": float(values.std(ddof=1) / np.sqrt(runs)),
            "deviation": float(values.std(ddof=1)), "seconds": process_time() - start,
        })  # fmt: skip
    columns = {
        "method": "{method}", "bias": "{bias:+.4f} ± {standard_error:.4f}",
        "deviation": "{deviation:.3f}", "CPU s": "{seconds:.1f}",
    }  # fmt: skip
    title = f"Score in α per observation, of one series at α = .93, exact {exact:.4f}"
    return title, harness.table(columns, entries + PUBLISHED), entries


def maximum(observations: Array) -> tuple[Reals, Float[np.ndarray, "3 3"]]:
    """The exact maximum, and the second derivatives there, by Newton's method from the truth."""
    point, hessian = unconstrained(TRUTH), np.eye(3)

    def score(point: Reals) -> np.ndarray:
        return np.asarray(exact_scores(point, observations), float).sum(axis=0)

    for _ in range(3):
        centre = score(point)
        moved = [score(point | {name: point[name] + 0.02}) for name in TRUTH]
        hessian = (np.array(moved) - centre) / 0.02
        hessian = (hessian + hessian.T) / 2
        step = np.linalg.solve(hessian, centre)
        point = {name: point[name] - jnp.float32(d) for name, d in zip(TRUTH, step, strict=True)}
    return point, hessian


def shifts(methods: Sequence[str], num_series: int, repeats: int, seed: int) -> Table:
    """How far each method moves the exact maximum: the bias of its score there, by Newton's step.

    In logit α, log β and log σ, with standard errors over series and repeats.
    """
    observations = jnp.asarray(simulate(num_series, seed))
    point, hessian = maximum(observations)
    repeated = jnp.tile(observations, (repeats, 1))
    exact = np.tile(np.asarray(exact_scores(point, observations), float), (repeats, 1))
    keys, entries = jax.random.split(jax.random.key(seed), len(repeated)), []
    for method in methods:
        rows = estimated_scores(point, repeated, keys, method)
        moves = -num_series * np.linalg.solve(hessian, (np.asarray(rows, float) - exact).T).T
        error = moves.std(axis=0, ddof=1) / np.sqrt(len(moves))
        entry = {"method": METHODS[method][-1], "maximum": jax.tree.map(float, constrained(point))}
        entry["shift"] = dict(zip(TRUTH, moves.mean(axis=0).tolist(), strict=True))
        entries.append(entry | {"error": dict(zip(TRUTH, error.tolist(), strict=True))})
    names = {"logit α": "alpha", "log β": "beta", "log σ": "sigma"}
    columns = {"method": "{method}"} | {
        title: f"{{shift[{name}]:+.3f}} ± {{error[{name}]:.3f}}" for title, name in names.items()
    }
    return (
        "Shift of the exact maximum by the bias of the score",
        harness.table(columns, entries),
        entries,
    )


def learned(
    methods: Sequence[str], num_series: int, data_sets: int, steps: int, seed: int
) -> Table:
    """Mean errors of what `fit` learns by each method, over data sets with starts of their own."""
    entries = [
        learned_from(num_series, method, steps, seed + number)
        for method, number in harness.grid("fit", methods, range(data_sets))
    ]
    entries += [exact_from(num_series, seed + number) for number in range(data_sets)]
    rows = []
    for method in [*methods, "exact"]:
        of_method = [entry for entry in entries if entry["method"] == method]
        means = {name: np.mean([e[name] for e in of_method]) for name in [*TRUTH, "seconds"]}
        rows.append({"method": TITLES[method]} | means)
    columns = {"method": "{method}"} | ERRORS | {"CPU s": "{seconds:.0f}"}
    return "Mean errors of learned parameters", harness.table(columns, rows + PUBLISHED), entries


def coverage(
    methods: Sequence[str], num_series: int, data_sets: int, steps: int, seed: int
) -> Table:
    """The share of 90% intervals, by `standard_errors`, that hold the true parameter."""
    entries = [
        learned_from(num_series, method, steps, seed + number, CURVATURE_SEEDS)
        for method, number in harness.grid("fit", methods, range(data_sets))
    ]
    entries += [exact_from(num_series, seed + number) for number in range(data_sets)]
    rows = []
    for method in [*methods, "exact"]:
        of_method = [e for e in entries if e["method"] == method and e["standard_errors"]]
        shares = {
            name: np.mean(
                [e[name] < norm.ppf(0.95) * e["standard_errors"][name] for e in of_method]
            )
            for name in TRUTH
        }
        rows.append({"method": TITLES[method], "number": len(of_method)} | shares)
    columns = {"method": "{method}", "data sets": "{number}"}
    columns |= {name: f"{{{name}:.2f}}" for name in TRUTH}
    title = f"Coverage of 90% intervals, data sets of {num_series} series"
    return title, harness.table(columns, rows), entries


def learned_from(
    num_series: int, method: str, steps: int, seed: int, curvature_seeds: int = 0
) -> dict[str, Any]:
    """The parameters that `fit` finds on one data set, from a random start as published."""
    rng = np.random.default_rng([seed, 1])
    start = {"alpha": rng.uniform(), "beta": rng.uniform(0.0, 2.0), "sigma": rng.uniform(0.0, 5.0)}
    gradient, score, pooled, num_seeds, _ = METHODS[method]
    # By default Adam's steps would remain small for a thousand steps after the first gradients,
    # which are large: b2 = .9 forgets them.
    optimizer = optax.adam(optax.cosine_decay_schedule(0.15, steps), b2=0.9)
    began, series, of_parameters = process_time(), list(simulate(num_series, seed)), None
    tuned: Any = {"parameters": PARAMETERS, "transforms": TRANSFORMS, "score": score}
    with warnings.catch_warnings(action="ignore"):  # of the biases that are measured here
        run = fit(
            jax.random.key(seed), volatility_filter(gradient, start), series, optimizer, steps,
            num_seeds=num_seeds, batch=min(BATCH, num_series), pooled=pooled, progress=False,
            **tuned,
        )  # fmt: skip
        if curvature_seeds:
            of_parameters = standard_errors(
                jax.random.key(seed + 1), run.tuned, series, num_seeds=curvature_seeds, **tuned
            )
    errors = {name: abs(float(run.parameters[name]) - true) for name, true in TRUTH.items()}
    return {"method": method, "seed": seed, "seconds": process_time() - began} | errors | {
        "effective_seeds": np.asarray(run.effective_seeds).mean(), "start": start,
        "standard_errors": of_parameters,
    }  # fmt: skip


def exact_from(num_series: int, seed: int) -> dict[str, Any]:
    """The exact maximum for the same data, with the exact standard errors."""
    began = process_time()
    point, hessian = maximum(jnp.asarray(simulate(num_series, seed)))
    variances, values = np.diag(np.linalg.inv(-hessian)), constrained(point)
    slopes = jax.grad(lambda reals: sum(constrained(reals).values()))(point)
    errors = {name: abs(float(values[name]) - true) for name, true in TRUTH.items()}
    return {"method": "exact", "seed": seed, "seconds": process_time() - began} | errors | {
        "standard_errors": {
            name: float(slopes[name]) * variance**0.5
            for name, variance in zip(TRUTH, variances.tolist(), strict=True)
        } if (variances > 0).all() else None,
    }  # fmt: skip
