"""(c) The variance of log Ẑ by one run, against that of many runs."""

from typing import Any

import jax
import numpy as np

import mpfjax
from benchmarks.smoothing.filters import make_model, observations_of
from benchmarks.smoothing.jobs import Job
from mpfjax.console import format_table
from mpfjax.smoothing import log_marginal_likelihood_variance, with_first_ancestors

SCHEMES = ("multinomial", "systematic", "ssp")


def _nothing(mixture: mpfjax.ParticleMixture) -> None:
    del mixture


def measure(jobs: dict[str, Job], num_particles: int, runs: int, seed: int) -> list[dict[str, Any]]:
    """For each job, filter and scheme the variance over runs and what each run says of it."""
    entries = []
    for job_name, job in jobs.items():
        model, observations = make_model(job, independent=True), observations_of(job)
        for scheme in SCHEMES:
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
    return entries


def table(entries: list[dict[str, Any]]) -> str:
    """A row for each job, filter and scheme."""
    return format_table(
        ["log Ẑ of", "filter", "scheme", "variance of runs", "by one run", "ratio"],
        [
            [
                entry["job"],
                entry["filter"],
                entry["scheme"],
                f"{entry['variance']:.4f} ± {entry['variance'] * entry['relative_error']:.4f}",
                f"{entry['mean_of_runs']:.4f} ± {entry['std_of_runs']:.4f}",
                f"{entry['mean_of_runs'] / entry['variance']:.2f}",
            ]
            for entry in entries
        ],
    )
