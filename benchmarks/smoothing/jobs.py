"""What is smoothed: two models, their observations, the exact answers, and the filters.

Every method estimates the same number, E[(1/T) Σ_t x_{t-1} x_t | y_1..y_T], which needs pairs of
neighbouring states. The exact one is that of the Rauch-Tung-Striebel smoother, or of a smoother on
a grid.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

import mpfjax
from benchmarks.peers import jobs
from mpfjax.exact import kalman_smoother

GRID = np.linspace(-5.0, 5.0, 1001)


@dataclass(frozen=True)
class Linear:
    """x_t = a x_{t-1} + N(0, q²), y_t = x_t + N(0, r²), x_0 ~ N(0, p²)."""

    num_steps: int
    seed: int
    a: float = 0.95
    q: float = 0.5
    r: float = 0.7
    p: float = 1.0

    @cached_property
    def observations(self) -> np.ndarray:
        """y_1..y_T."""
        rng = np.random.default_rng(self.seed)
        x, seen = rng.normal(scale=self.p), []
        for _ in range(self.num_steps):
            x = self.a * x + rng.normal(scale=self.q)
            seen.append(x + rng.normal(scale=self.r))
        return np.array(seen)

    @cached_property
    def exact(self) -> float:
        """The smoothed mean of the products, by Rauch, Tung and Striebel."""
        model: Any = self.model()
        found = kalman_smoother(model, self.seen)
        means, pairs = np.asarray(found.means)[:, 0], np.asarray(found.lagged_covariances)[:, 0, 0]
        return float(np.mean(pairs + means[:-1] * means[1:]))

    def model(self, independent: bool = False) -> mpfjax.AbstractStateSpaceModel:
        """The model of the job; `independent` draws of x_0 are the only ones."""
        rows = {"A": self.a, "Q": self.q**2, "H": 1.0, "R": self.r**2, "P0": self.p**2}
        matrices = {name: np.full((1, 1), value, np.float32) for name, value in rows.items()}
        return mpfjax.LinearGaussianModel(m0=np.zeros(1, np.float32), **matrices)

    @property
    def seen(self) -> np.ndarray:
        """y_1..y_T as the model takes them."""
        return self.observations.astype(np.float32)[:, None]


class Quadratic(jobs.Quadratic):
    """That of `benchmarks.peers`, of any length: the two modes meet at zero, at t = 50."""

    @cached_property
    def exact(self) -> float:
        """The smoothed mean of the products, on a grid."""
        steps = (GRID[None] - GRID[:, None]) / self.sigma_x
        kernel = np.exp(-0.5 * steps**2)
        kernel /= kernel.sum(axis=1, keepdims=True)
        noise = (self.observations[:, None].astype(float) - GRID[None] ** 2) / self.sigma_y
        likelihoods = np.exp(-0.5 * (noise**2 - (noise**2).min(axis=1, keepdims=True)))
        forward = [(np.abs(GRID) <= self.high).astype(float)]
        for likelihood in likelihoods:
            joint = (forward[-1] @ kernel) * likelihood
            forward.append(joint / joint.sum())
        backward, products = np.ones(len(GRID)), 0.0
        for t in range(self.num_steps - 1, -1, -1):
            message = likelihoods[t] * backward
            joint = forward[t][:, None] * kernel * message[None]
            products += np.einsum("ij,i,j->", joint, GRID, GRID) / joint.sum()
            backward = kernel @ message
            backward /= backward.sum()
        return products / self.num_steps

    def model(self, independent: bool = False) -> mpfjax.AbstractStateSpaceModel:
        """The model of the job; with `independent` draws of x_0 or stratified ones."""
        draw = "independent" if independent else "stratified"
        return mpfjax.QuadraticModel(self.sigma_x, self.sigma_y, self.low, self.high, draw)

    @property
    def seen(self) -> np.ndarray:
        """y_1..y_T as the model takes them."""
        return self.observations


Job = Linear | Quadratic
JOBS = {"linear": Linear, "quadratic": Quadratic}


def _auxiliary(model: mpfjax.AbstractStateSpaceModel, num_particles: int) -> mpfjax.Filter:
    proposal = mpfjax.GaussNewtonProposal(model)
    plain = mpfjax.mixture_particle_filter(model, num_particles, 2)
    return mpfjax.with_point_sets(mpfjax.with_lookahead(plain, proposal))


def _guided(model: mpfjax.AbstractStateSpaceModel, num_particles: int) -> mpfjax.Filter:
    proposal = mpfjax.GaussNewtonProposal(model)
    return mpfjax.mixture_particle_filter(model, num_particles, 2, proposal=proposal, noise="rqmc")


FILTERS: dict[str, Callable[[mpfjax.AbstractStateSpaceModel, int], mpfjax.Filter]] = {
    "PF": mpfjax.particle_filter,
    "multinomial PF": lambda model, num_particles: mpfjax.particle_filter(
        model, num_particles, scheme="multinomial"
    ),
    "MPF": lambda model, num_particles: mpfjax.mixture_particle_filter(model, num_particles, 2),
    "guided MPF": _guided,
    "auxiliary MPF": _auxiliary,
}
