"""The jobs of `benchmarks.peers` through particles (Chopin and Papaspiliopoulos), in numpy.

A Feynman-Kac model of its own for each job, the fast way that its documentation shows beside
state-space models of distribution objects, and `multiSMC` over the seeds. A module without JAX:
particles' own processes import it. Draws come from numpy's global generator, which is the one that
particles seeds.
"""
# The rivals are installed for this benchmark only.
# pyright: reportMissingImports=false
# ruff: noqa: NPY002

from collections.abc import Callable
from typing import Any

import numpy as np
import particles
from particles import collectors

from benchmarks.peers.jobs import ConstantVelocity, Job, Quadratic

LOG_2_PI = np.log(2 * np.pi)


class QuadraticFeynmanKac(particles.FeynmanKac):
    """The bootstrap filter of the quadratic job; particles' time 0 is y_1."""

    def __init__(self, job: Quadratic) -> None:
        super().__init__(job.num_steps)
        self.job = job
        self.observations = job.observations.astype(float)

    def M0(self, N: int) -> np.ndarray:
        """x_1: x_0 and a step."""
        return self.M(0, np.random.uniform(self.job.low, self.job.high, N))

    def M(self, t: int, xp: np.ndarray) -> np.ndarray:
        """A step of the random walk."""
        return xp + self.job.sigma_x * np.random.standard_normal(xp.shape)

    def logG(self, t: int, xp: np.ndarray | None, x: np.ndarray) -> np.ndarray:
        """log L(y_t | x_t)."""
        noise = (self.observations[t] - x**2) / self.job.sigma_y
        return -0.5 * noise**2 - (np.log(self.job.sigma_y) + 0.5 * LOG_2_PI)


class ConstantVelocityFeynmanKac(particles.FeynmanKac):
    """The bootstrap filter of the linear-Gaussian job; particles' time 0 is y_1."""

    def __init__(self, job: ConstantVelocity) -> None:
        super().__init__(job.num_steps)
        self.A = job.A.T.astype(float)
        self.factor = np.linalg.cholesky(job.Q.astype(float)).T
        self.sigma_y = job.sigma_y
        self.observations = job.observations.astype(float)

    def M0(self, N: int) -> np.ndarray:
        """x_1: x_0 and a step."""
        return self.M(0, np.random.standard_normal((N, 4)))

    def M(self, t: int, xp: np.ndarray) -> np.ndarray:
        """A step of the dynamics."""
        return xp @ self.A + np.random.standard_normal(xp.shape) @ self.factor

    def logG(self, t: int, xp: np.ndarray | None, x: np.ndarray) -> np.ndarray:
        """log L(y_t | x_t)."""
        noise = (self.observations[t] - x[:, :2]) / self.sigma_y
        return -0.5 * (noise**2).sum(axis=1) - (2 * np.log(self.sigma_y) + LOG_2_PI)


def weighted_mean(weights: np.ndarray, states: np.ndarray) -> np.ndarray:
    """E[x_t | y_1..y_t], estimated."""
    return weights @ states


def outputs(filter: Any) -> tuple[np.ndarray, np.ndarray, float]:
    """Mean and effective sample size of every step, and log p(y_1..y_t)."""
    summaries = filter.summaries
    return np.array(summaries.moments), np.array(summaries.ESSs), filter.logLt


def prepare(job: Job, num_particles: int, num_seeds: int, num_processes: int) -> Callable[[], Any]:
    """All seeds of the job, from numpy's global generator."""
    kind = QuadraticFeynmanKac if isinstance(job, Quadratic) else ConstantVelocityFeynmanKac
    model = kind(job)  # type: ignore[arg-type]

    def run() -> tuple[np.ndarray, ...]:
        runs = particles.multiSMC(
            fk=model,
            N=num_particles,
            nruns=num_seeds,
            nprocs=num_processes,
            out_func=outputs,
            collect=[collectors.Moments(mom_func=weighted_mean)],
            resampling="systematic",
            ESSrmin=1.0,
        )
        means, sizes, log_likelihoods = zip(*(run["output"] for run in runs), strict=True)
        return np.array(means), np.array(sizes), np.array(log_likelihoods)

    return run
