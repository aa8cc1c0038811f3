"""What is smoothed, in numpy alone: two models, their observations, and the exact answers.

Every method estimates the same number, E[(1/T) Σ_t x_{t-1} x_t | y_1..y_T], which needs pairs of
neighbouring states. The exact one is that of the Rauch-Tung-Striebel smoother, or of a smoother on
a grid.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

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
        means, variances = [0.0], [self.p**2]
        for y in self.observations:
            mean, variance = self.a * means[-1], self.a**2 * variances[-1] + self.q**2
            gain = variance / (variance + self.r**2)
            means.append(mean + gain * (y - mean))
            variances.append((1 - gain) * variance)
        mean, variance, products = means[-1], variances[-1], 0.0
        for t in range(self.num_steps - 1, -1, -1):
            predicted = self.a**2 * variances[t] + self.q**2
            gain = self.a * variances[t] / predicted
            earlier = means[t] + gain * (mean - self.a * means[t])
            products += gain * variance + earlier * mean
            variance = variances[t] + gain**2 * (variance - predicted)
            mean = earlier
        return products / self.num_steps


@dataclass(frozen=True)
class Quadratic:
    """x_t = x_{t-1} + N(0, σ_x²), y_t = x_t² + N(0, σ_y²), x_0 uniform on [-width, width]."""

    num_steps: int
    seed: int
    sigma_x: float = 0.1
    sigma_y: float = 0.1
    width: float = 2.5

    @cached_property
    def observations(self) -> np.ndarray:
        """y_1..y_T of Vermaak et al. (2003), section 5.1: the two modes meet at zero, at t = 50."""
        rng = np.random.default_rng(self.seed)
        truth = 2 * np.sin(2 * np.pi * np.arange(1, self.num_steps + 1) / 100)
        return truth**2 + self.sigma_y * rng.normal(size=self.num_steps)

    @cached_property
    def exact(self) -> float:
        """The smoothed mean of the products, on a grid."""
        steps = (GRID[None] - GRID[:, None]) / self.sigma_x
        kernel = np.exp(-0.5 * steps**2)
        kernel /= kernel.sum(axis=1, keepdims=True)
        noise = (self.observations[:, None] - GRID[None] ** 2) / self.sigma_y
        likelihoods = np.exp(-0.5 * (noise**2 - (noise**2).min(axis=1, keepdims=True)))
        forward = [(np.abs(GRID) <= self.width).astype(float)]
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


Job = Linear | Quadratic
JOBS = {"linear": Linear, "quadratic": Quadratic}
