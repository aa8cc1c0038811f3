"""The jobs of `benchmarks.smoothing` through particles (Chopin and Papaspiliopoulos), in numpy."""
# The rival is installed for the benchmarks only.
# pyright: reportMissingImports=false
# ruff: noqa: NPY002

from collections.abc import Callable
from typing import Any

import numpy as np
import particles
from particles.collectors import Online_smooth_ON2, Paris

from benchmarks.peers import through_particles
from benchmarks.peers.jobs import LOG_2_PI
from benchmarks.smoothing.jobs import Job

ONLINE = {"online": Online_smooth_ON2, "paris": Paris}


class FeynmanKac(through_particles.FeynmanKac):
    """The bootstrap filter of a job, with the density of its dynamics."""

    def __init__(self, job: Job) -> None:
        super().__init__(job, with_start=True)
        self.ssm = self  # where particles looks for the bound of the density

    def M(self, t: int, xp: np.ndarray) -> np.ndarray:
        """A step of the dynamics."""
        factor, scale = self.job.of_step()
        return factor * xp + scale * np.random.standard_normal(xp.shape)

    def logpt(self, t: int, xp: np.ndarray, x: np.ndarray) -> np.ndarray:
        """log D(x_t | x_{t-1})."""
        factor, scale = self.job.of_step()
        return -0.5 * ((x - factor * xp) / scale) ** 2 + self.upper_bound_log_pt(t)

    def upper_bound_log_pt(self, t: int) -> float:
        """The largest log D."""
        return float(-np.log(self.job.of_step()[1]) - 0.5 * LOG_2_PI)

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
        sample = getattr(smc.hist, f"backward_sampling_{'ON2' if method == 'exact' else 'mcmc'}")
        paths = np.array(sample(num_trajectories))
        return float(np.mean(paths[:-1] * paths[1:]))

    return once
