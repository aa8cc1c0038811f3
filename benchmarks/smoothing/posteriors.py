"""The posterior of σ_x and σ_y by three samplers, beside that of the grid filter."""

import time
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.stats import norm
from matplotlib.figure import Figure

import mpfjax
from benchmarks import figures as plotting
from benchmarks.peers.jobs import Quadratic
from benchmarks.peers.libraries import model_of
from mpfjax import tuning
from mpfjax.exact import grid_filter

NAMES = {"sigma_x": "$\\sigma_x$", "sigma_y": "$\\sigma_y$"}
# Both have the same log-normal prior.
PRIOR_MEAN, PRIOR_DEVIATION = float(np.log(0.15)), 0.7
AXIS = np.exp(np.linspace(np.log(0.03), np.log(0.4), 61))
STATES = (-4.0, 4.0, 501)


# By sampler: draws of both with weights, their effective number for the worse one, and seconds.
Draws = dict[str, dict[str, Any]]
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
    states, observations = jnp.linspace(*STATES), jnp.asarray(job.observations)

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
    return {name: values / (values.sum() * step) / AXIS for name, values in marginals.items()}


def measure(job: Quadratic, num_particles: int, num_steps: int, seed: int) -> Draws:
    """Each sampler on the same filter, from the same start."""
    model: Any = model_of(job)
    filter = mpfjax.mixture_particle_filter(
        model, num_particles, 2, proposal=mpfjax.GaussNewtonProposal()
    )
    observations = job.observations
    chosen: dict[str, Any] = {
        "parameters": {
            "sigma_x": lambda filter: filter.model.sigma_x,
            "sigma_y": lambda filter: filter.model.sigma_y,
        },
        "transforms": {name: tuning.Positive() for name in NAMES},
        "progress": False,
    }
    keys = jax.random.split(jax.random.key(seed), 3)

    def chains(sample: Any, key: Any) -> dict[str, Any]:
        posterior = sample(
            key, filter, observations, num_steps=num_steps, num_chains=2, log_prior=log_prior,
            proposal_deviations=0.2, **chosen,
        )  # fmt: skip
        draws = {
            name: np.asarray(posterior.parameters[name])[:, num_steps // 10 :] for name in NAMES
        }
        size = min(_effective(np.log(values)) for values in draws.values())
        flat = {name: values.ravel() for name, values in draws.items()}
        return {"values": flat, "weights": None, "size": size}

    def sequential(key: Any) -> dict[str, Any]:
        samples = tuning.smc2(
            key, filter, observations, max(6 * (num_steps // 10), 12), sample_prior=sample_prior,
            log_prior=log_prior, **chosen,
        )  # fmt: skip
        weights = np.exp(np.asarray(samples.log_weights, float))
        values = {name: np.asarray(samples.parameters[name]) for name in NAMES}
        size = float(weights.sum() ** 2 / (weights**2).sum())
        return {"values": values, "weights": weights, "size": size}

    samplers = {
        "PMMH": partial(chains, tuning.metropolis_hastings),
        "particle Gibbs": partial(chains, tuning.particle_gibbs),
        "SMC²": sequential,
    }
    draws: Draws = {}
    for key, (name, sample) in zip(keys, samplers.items(), strict=True):
        start = time.perf_counter()
        draws[name] = sample(key)
        draws[name]["seconds"] = time.perf_counter() - start
    return draws


def _effective(chains: np.ndarray) -> float:
    from blackjax.diagnostics import effective_sample_size

    return float(effective_sample_size(jnp.asarray(chains)))


def summary(truth: dict[str, np.ndarray], draws_of: Draws) -> list[dict[str, Any]]:
    """Mean and deviation of each parameter, with the error of the mean in standard errors."""
    step = float(np.log(AXIS[1] / AXIS[0]))
    entries = []
    for name in NAMES:
        shares = truth[name] * AXIS * step
        mean = float(shares @ AXIS)
        deviation = float(np.sqrt(shares @ (AXIS - mean) ** 2))
        head = {"parameter": name}
        entries.append(head | {"sampler": "grid filter", "mean": mean, "deviation": deviation})
        for sampler, draws in draws_of.items():
            values, weights, size = draws["values"][name], draws["weights"], draws["size"]
            estimate = np.average(values, weights=weights)
            spread = np.sqrt(np.average((values - estimate) ** 2, weights=weights))
            error = deviation / np.sqrt(size)
            entries.append(head | {
                "sampler": sampler, "mean": float(estimate), "deviation": float(spread),
                "standard_errors_off": float((estimate - mean) / error),
                "effective_samples": size, "seconds": draws["seconds"],
                "effective_samples_per_second": size / draws["seconds"],
            })  # fmt: skip
    return entries


def picture(truth: dict[str, np.ndarray], draws_of: Draws) -> Figure:
    """For each parameter the distribution function of every sampler's draws and the exact one."""
    figure = Figure(figsize=(8, 3.6), layout="constrained")
    for panel, (name, label) in zip(figure.subplots(1, 2, sharey=True), NAMES.items(), strict=True):
        shares = truth[name] * AXIS
        exact = (np.cumsum(shares) - shares / 2) / shares.sum()
        panel.plot(AXIS, exact, color="0.2", lw=4, alpha=0.3, label="grid filter, exact")
        for (sampler, draws), colour, line in zip(
            draws_of.items(), plotting.COLOURS, ("-", "--", ":"), strict=False
        ):
            values, weights = draws["values"][name], draws["weights"]
            panel.ecdf(values, weights, color=colour, ls=line, lw=1.4, label=sampler)
        wide = AXIS[(exact > 1e-3) & (exact < 0.999)]
        panel.set(xlim=(wide[0], wide[-1]), xlabel=label)
        panel.grid(alpha=0.25)
    figure.axes[0].set_ylabel("posterior distribution function")
    figure.axes[0].legend(fontsize=8, loc="upper left")
    return figure
