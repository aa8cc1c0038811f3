"""The jobs of `benchmarks.smoothing` through particles (Chopin and Papaspiliopoulos), in numpy.

particles has no x_0 before the first observation, so its time 0 is given a potential of one, and
its time t is ours. Draws come from numpy's global generator, which is the one that it seeds.
"""
# The rival is installed for this benchmark only.
# pyright: reportMissingImports=false
# ruff: noqa: NPY002

from collections.abc import Callable
from typing import Any

import numpy as np
import particles
from particles.collectors import Online_smooth_ON2, Paris

from benchmarks.smoothing.jobs import Job, Linear

LOG_2_PI = np.log(2 * np.pi)
ONLINE = {"online": Online_smooth_ON2, "paris": Paris}


class FeynmanKac(particles.FeynmanKac):
    """The bootstrap filter of a job, with the density of its dynamics."""

    def __init__(self, job: Job) -> None:
        super().__init__(job.num_steps + 1)
        self.job = job
        self.ssm = self  # where particles looks for the bound of the density
        self.scale = job.q if isinstance(job, Linear) else job.sigma_x
        self.factor = job.a if isinstance(job, Linear) else 1.0

    def M0(self, N: int) -> np.ndarray:
        """x_0."""
        if isinstance(self.job, Linear):
            return self.job.p * np.random.standard_normal(N)
        return np.random.uniform(-self.job.width, self.job.width, N)

    def M(self, t: int, xp: np.ndarray) -> np.ndarray:
        """A step of the dynamics."""
        return self.factor * xp + self.scale * np.random.standard_normal(xp.shape)

    def logG(self, t: int, xp: np.ndarray | None, x: np.ndarray) -> np.ndarray:
        """log L(y_t | x_t); zero for x_0."""
        if t == 0:
            return np.zeros(len(x))
        if isinstance(self.job, Linear):
            scale, seen = self.job.r, x
        else:
            scale, seen = self.job.sigma_y, x**2
        noise = (self.job.observations[t - 1] - seen) / scale
        return -0.5 * noise**2 - np.log(scale) - 0.5 * LOG_2_PI

    def logpt(self, t: int, xp: np.ndarray, x: np.ndarray) -> np.ndarray:
        """log D(x_t | x_{t-1})."""
        noise = (x - self.factor * xp) / self.scale
        return -0.5 * noise**2 + self.upper_bound_log_pt(t)

    def upper_bound_log_pt(self, t: int) -> float:
        """The largest log D."""
        return float(-np.log(self.scale) - 0.5 * LOG_2_PI)

    def add_func(self, t: int, xp: np.ndarray | None, x: np.ndarray) -> np.ndarray:
        """x_{t-1} x_t."""
        return np.zeros_like(x) if xp is None else xp * x


def estimator(
    job: Job, num_particles: int, method: str, num_trajectories: int
) -> Callable[[int], float]:
    """A function of a seed: the estimate by one run."""

    def once(seed: int) -> float:
        np.random.seed(seed)
        collected = ONLINE.get(method)
        kept: Any = {"store_history": True} if collected is None else {"collect": [collected()]}
        smc: Any = particles.SMC(
            fk=FeynmanKac(job), N=num_particles, resampling="systematic", ESSrmin=1.0, **kept
        )
        smc.run()
        if collected is not None:
            return float(getattr(smc.summaries, collected().summary_name)[-1]) / job.num_steps
        history = smc.hist
        if method == "exact":
            paths = np.array(history.backward_sampling_ON2(num_trajectories))
        else:
            paths = np.array(history.backward_sampling_mcmc(num_trajectories))
        return float(np.mean(paths[:-1] * paths[1:]))

    return once
