"""Models through particles (Chopin and Papaspiliopoulos), in numpy.

A Feynman-Kac model, the fast way that its documentation shows beside state-space models of
distribution objects, and `multiSMC` over the seeds. A module without JAX: particles' own processes
import it.
"""
# The rivals are installed for the benchmarks only.
# pyright: reportMissingImports=false

from collections.abc import Callable
from typing import Any

import numpy as np
import particles
from particles import collectors


class FeynmanKac(particles.FeynmanKac):
    """The bootstrap filter of a job with `initial`, `step` and `log_likelihood`.

    particles has no x_0 before the first observation: its time 0 is y_1.
    """

    def __init__(self, job: Any) -> None:
        super().__init__(len(job.observations))
        self.job = job
        self.observations = job.observations.astype(float)

    def M0(self, N: int) -> np.ndarray:
        """The first states."""
        return self.job.step(self.job.initial(N))

    def M(self, t: int, xp: np.ndarray) -> np.ndarray:
        """A step of the dynamics."""
        return self.job.step(xp)

    def logG(self, t: int, xp: np.ndarray | None, x: np.ndarray) -> np.ndarray:
        """log L of the states."""
        return self.job.log_likelihood(self.observations[t], x)


def weighted_mean(weights: np.ndarray, states: np.ndarray) -> np.ndarray:
    """E[x_t | y_1..y_t], estimated."""
    return weights @ states


def outputs(filter: Any) -> tuple[np.ndarray, np.ndarray, float]:
    """Mean and effective sample size of every step, and log p(y_1..y_t)."""
    summaries = filter.summaries
    return np.array(summaries.moments), np.array(summaries.ESSs), filter.logLt


def prepare(job: Any, num_particles: int, num_seeds: int, num_processes: int) -> Callable[[], Any]:
    """All seeds of the job, from numpy's global generator."""
    model = FeynmanKac(job)

    def run() -> tuple[np.ndarray, ...]:
        runs = particles.multiSMC(
            fk=model, N=num_particles, nruns=num_seeds, nprocs=num_processes, out_func=outputs,
            collect=[collectors.Moments(mom_func=weighted_mean)], resampling="systematic",
            ESSrmin=1.0,
        )  # fmt: skip
        means, sizes, log_likelihoods = zip(*(run["output"] for run in runs), strict=True)
        return np.array(means), np.array(sizes), np.array(log_likelihoods)

    return run
