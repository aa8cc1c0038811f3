"""(c) The errors of log Ẑ and of a mode's mass by one run, against those of many runs."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import mpfjax
from benchmarks.smoothing.filters import make_model, observations_of
from benchmarks.smoothing.jobs import Job
from mpfjax.console import format_table
from mpfjax.running.scan import FilterRun
from mpfjax.smoothing import (
    log_marginal_likelihood_variance,
    mixture_weight_errors,
    with_first_ancestors,
)

# The only one for which a single run tells.
SCHEMES = ("multinomial",)


def _nothing(mixture: mpfjax.ParticleMixture) -> None:
    del mixture


def measure(
    jobs: dict[str, Job], schemes: Sequence[str], num_particles: int, runs: int, seed: int
) -> list[dict[str, Any]]:
    """For each job, filter and scheme the variance over runs and what each run says of it."""
    entries = []
    for job_name, job in jobs.items():
        model, observations = make_model(job, independent=True), observations_of(job)
        for scheme in schemes:
            filters = {
                "PF": mpfjax.particle_filter(model, num_particles, scheme=scheme),
                "MPF": mpfjax.mixture_particle_filter(model, num_particles, 2, scheme=scheme),
            }
            for name, filter in filters.items():
                keys = jax.random.split(jax.random.key(seed), runs)
                remembering = with_first_ancestors(filter)
                found = mpfjax.monte_carlo(keys, remembering, observations, _nothing)
                by_run = np.asarray(jax.vmap(log_marginal_likelihood_variance)(found))
                truth = float(np.var(np.asarray(found.log_marginal_likelihood), ddof=1))
                entries.append({
                    "job": job_name, "filter": name, "scheme": scheme, "variance": truth,
                    "relative_error": float(np.sqrt(2 / (runs - 1))),
                    "mean_of_runs": float(by_run.mean()), "std_of_runs": float(by_run.std()),
                })  # fmt: skip
                # The linear model has one mode, which regrouping divides now here, now there.
                if filter.num_components > 1 and job_name == "quadratic":
                    entries[-1] |= _of_masses(found)
    return entries


def _of_masses(runs: FilterRun) -> dict[str, float]:
    """The deviation of the upper mode's mass over runs, and its mean standard error by one run."""
    means = jax.vmap(lambda mixture: mixture.component_means())(runs.final)
    masses = np.asarray(jax.vmap(lambda mixture: mixture.mixture_weights)(runs.final))
    errors = np.asarray(jax.vmap(mixture_weight_errors)(runs))
    each, upper = np.arange(len(masses)), np.asarray(jnp.argmax(means, axis=1))
    return {
        "mass_deviation": float(masses[each, upper].std(ddof=1)),
        "mass_error_of_runs": float(errors[each, upper].mean()),
    }


def table(entries: list[dict[str, Any]]) -> str:
    """A row for each job, filter and scheme."""
    return format_table(
        ["log Ẑ of", "filter", "scheme", "variance of runs", "by one run", "ratio",
         "mass: deviation of runs", "by one run"],
        [
            [
                entry["job"],
                entry["filter"],
                entry["scheme"],
                f"{entry['variance']:.4f} ± {entry['variance'] * entry['relative_error']:.4f}",
                f"{entry['mean_of_runs']:.4f} ± {entry['std_of_runs']:.4f}",
                f"{entry['mean_of_runs'] / entry['variance']:.2f}",
                *(f"{entry[name]:.3f}" if name in entry else ""
                  for name in ("mass_deviation", "mass_error_of_runs")),
            ]
            for entry in entries
        ],
    )  # fmt: skip
