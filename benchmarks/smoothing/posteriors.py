"""(d) The posterior of σ_x and σ_y by three samplers, beside that of the grid filter."""

import time
import warnings
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.stats import norm
from matplotlib.figure import Figure

import mpfjax
from benchmarks import figures as plotting
from benchmarks.smoothing.jobs import Quadratic
from mpfjax import tuning
from mpfjax.exact import grid_filter

NAMES = {"sigma_x": "$\\sigma_x$", "sigma_y": "$\\sigma_y$"}
# Both have the same log-normal prior.
PRIOR_MEAN, PRIOR_DEVIATION = float(np.log(0.15)), 0.7
AXIS = np.exp(np.linspace(np.log(0.03), np.log(0.4), 61))
STATES = (-4.0, 4.0, 501)


class Draws(NamedTuple):
    """What a sampler found: draws of both with weights, and what it took."""

    values: dict[str, np.ndarray]  # (draws,)
    weights: np.ndarray
    effective_samples: float  # of the worse of the two
    seconds: float  # with compiling


COLUMNS = {
    "": "{parameter}",
    "by": "{sampler}",
    "mean": "{mean:.4f}",
    "deviation": "{deviation:.4f}",
    "standard errors off": "{standard_errors_off:+.1f}",
    "effective samples": "{effective_samples:.0f}",
    "a second": "{effective_samples_per_second:.1f}",
}


def log_prior(parameters: dict[str, Any]) -> Any:
    """The log density of both, on their own scale."""
    logs = {name: jnp.log(parameters[name]) for name in NAMES}
    terms = [norm.logpdf(log, PRIOR_MEAN, PRIOR_DEVIATION) - log for log in logs.values()]
    return sum(terms[1:], terms[0])


def sample_prior(key: Any) -> dict[str, Any]:
    """One draw of both."""
    logs = PRIOR_MEAN + PRIOR_DEVIATION * jax.random.normal(key, (2,))
    return dict(zip(NAMES, jnp.exp(logs), strict=True))


def exact(job: Quadratic) -> dict[str, np.ndarray]:
    """The marginal density of each parameter on `AXIS`, by the grid filter."""
    states, observations = jnp.linspace(*STATES), jnp.asarray(job.seen)

    @jax.jit
    def log_joint(pair: Any) -> Any:
        model = mpfjax.QuadraticModel(pair[0], pair[1], job.low, job.high)
        parameters = dict(zip(NAMES, pair, strict=True))
        evidence = grid_filter(model, observations, states).log_marginal_likelihood
        return evidence + log_prior(parameters)

    pairs = jnp.asarray([(x, y) for x in AXIS for y in AXIS], jnp.float32)
    table = np.asarray(jax.lax.map(log_joint, pairs), float).reshape(len(AXIS), len(AXIS))
    table = np.exp(table - table.max()) * AXIS[:, None] * AXIS[None]  # per step of the logarithm
    step = float(np.log(AXIS[1] / AXIS[0]))
    marginals = dict(zip(NAMES, (table.sum(axis=1), table.sum(axis=0)), strict=True))
    for name, values in marginals.items():
        if max(values[0], values[-1]) > 0.01 * values.max():
            warnings.warn(f"the posterior of {name} reaches the end of the grid", stacklevel=2)
    return {name: values / (values.sum() * step) / AXIS for name, values in marginals.items()}


def measure(job: Quadratic, num_particles: int, num_steps: int, seed: int) -> dict[str, Draws]:
    """Each sampler on the same filter, from the same start."""
    model: Any = job.model(independent=True)
    filter = mpfjax.mixture_particle_filter(
        model, num_particles, 2, proposal=mpfjax.GaussNewtonProposal(model)
    )
    observations = job.seen
    chosen: dict[str, Any] = {
        "parameters": {
            "sigma_x": lambda filter: filter.model.sigma_x,
            "sigma_y": lambda filter: filter.model.sigma_y,
        },
        "transforms": {name: tuning.Positive() for name in NAMES},
        "progress": False,
    }
    keys = jax.random.split(jax.random.key(seed), 3)
    found = {}
    samplers = {"PMMH": tuning.metropolis_hastings, "particle Gibbs": tuning.particle_gibbs}
    for key, (name, sample) in zip(keys[:2], samplers.items(), strict=True):
        start = time.perf_counter()
        posterior = sample(
            key, filter, observations, num_steps=num_steps, num_chains=2, log_prior=log_prior,
            proposal_deviations=0.2, **chosen,
        )  # fmt: skip
        seconds = time.perf_counter() - start
        kept = {
            each: np.asarray(posterior.parameters[each])[:, num_steps // 10 :] for each in NAMES
        }
        sizes = [_effective(np.log(values)) for values in kept.values()]
        flat = {each: values.ravel() for each, values in kept.items()}
        found[name] = Draws(flat, np.full(flat["sigma_x"].size, 1.0), min(sizes), seconds)
    start = time.perf_counter()
    num_samples = max(6 * (num_steps // 10), 12)
    sequential = tuning.smc2(
        keys[2], filter, observations, num_samples, sample_prior=sample_prior,
        log_prior=log_prior, **chosen,
    )  # fmt: skip
    seconds = time.perf_counter() - start
    weights = np.exp(np.asarray(sequential.log_weights, float))
    size = float(weights.sum() ** 2 / (weights**2).sum())
    values = {each: np.asarray(sequential.parameters[each]) for each in NAMES}
    found["SMC²"] = Draws(values, weights, size, seconds)
    return found


def _effective(chains: np.ndarray) -> float:
    from blackjax.diagnostics import effective_sample_size

    return float(effective_sample_size(jnp.asarray(chains)))


def summary(truth: dict[str, np.ndarray], found: dict[str, Draws]) -> list[dict[str, Any]]:
    """Mean and deviation of each parameter, with the error of the mean in standard errors."""
    step = float(np.log(AXIS[1] / AXIS[0]))
    entries = []
    for name in NAMES:
        shares = truth[name] * AXIS * step
        mean = float(shares @ AXIS)
        deviation = float(np.sqrt(shares @ (AXIS - mean) ** 2))
        head = {"parameter": name}
        entries.append(head | {"sampler": "grid filter", "mean": mean, "deviation": deviation})
        for sampler, draws in found.items():
            own = np.average(draws.values[name], weights=draws.weights)
            spread = np.sqrt(np.average((draws.values[name] - own) ** 2, weights=draws.weights))
            error = deviation / np.sqrt(draws.effective_samples)
            entries.append(head | {
                "sampler": sampler, "mean": float(own), "deviation": float(spread),
                "standard_errors_off": float((own - mean) / error),
                "effective_samples": draws.effective_samples, "seconds": draws.seconds,
                "effective_samples_per_second": draws.effective_samples / draws.seconds,
            })  # fmt: skip
    return entries


def picture(truth: dict[str, np.ndarray], found: dict[str, Draws]) -> Figure:
    """For each parameter the density of every sampler's draws and the exact one."""
    figure = Figure(figsize=(8, 3.4), layout="constrained")
    panels = figure.subplots(1, len(NAMES))
    for panel, (name, label) in zip(panels, NAMES.items(), strict=True):
        panel.plot(AXIS, truth[name], color="0.2", lw=2.2, label="grid filter")
        wide = AXIS[truth[name] > 1e-3 * truth[name].max()]
        bins = np.linspace(wide[0], wide[-1], 21)
        for index, (sampler, draws) in enumerate(found.items()):
            heights, _ = np.histogram(
                draws.values[name], bins=bins, weights=draws.weights, density=True
            )
            panel.stairs(
                heights, bins, color=plotting.COLOURS[index], lw=1.3, label=sampler,
                ls=("-", "--", ":")[index],
            )  # fmt: skip
        panel.set_xlim(wide[0], wide[-1])
        panel.set_ylim(bottom=0)
        panel.set_xlabel(label)
        panel.grid(alpha=0.25)
    panels[0].set_ylabel("posterior density")
    panels[0].legend(fontsize=8)
    return figure
