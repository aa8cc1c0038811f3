"""The two jobs of `benchmarks.peers` in numbers, the same for every library; numpy only.

`initial` and `step` draw from numpy's global generator, which is the one that particles seeds.
"""
# ruff: noqa: NPY002

from dataclasses import dataclass

import numpy as np

LOG_2_PI = float(np.log(2 * np.pi))


@dataclass(frozen=True)
class Quadratic:
    """x_t = x_{t-1} + N(0, σ_x²), y_t = x_t² + N(0, σ_y²), x_0 uniform; the true state a sinusoid.

    Vermaak et al. (2003), section 5.1. States are scalars.
    """

    num_steps: int = 100
    seed: int = 0
    title, state_shape = "quadratic model, 1 dimension", ()
    sigma_x, sigma_y, low, high = 0.1, 0.1, -2.5, 2.5

    @property
    def observations(self) -> np.ndarray:
        """y_1..y_t, (t,)."""
        truth = 2 * np.sin(2 * np.pi * np.arange(1, self.num_steps + 1) / 100)
        noise = np.random.default_rng(self.seed).standard_normal(self.num_steps)
        return (truth**2 + self.sigma_y * noise).astype(np.float32)

    def initial(self, number: int) -> np.ndarray:
        """x_0."""
        return np.random.uniform(self.low, self.high, number)

    def step(self, states: np.ndarray) -> np.ndarray:
        """x_t given x_{t-1}."""
        return states + self.sigma_x * np.random.standard_normal(states.shape)

    def log_likelihood(self, y, states):
        """log L(y_t | x_t), of arrays of numpy or JAX."""
        log_scale = float(np.log(self.sigma_y)) + 0.5 * LOG_2_PI
        return -0.5 * ((y - states**2) / self.sigma_y) ** 2 - log_scale


class ConstantVelocity:
    """A point that moves in the plane with a noisy velocity, seen in its position.

    States are (x, y, velocity of x, velocity of y): x_t = A x_{t-1} + N(0, Q), y_t = H x_t +
    N(0, σ_y² I), x_0 ~ N(0, I).
    """

    title, num_steps, state_shape = "constant velocity, 4 dimensions", 50, (4,)
    sigma_x, sigma_y = 0.3, 1.0
    A = np.kron([[1.0, 1.0], [0.0, 1.0]], np.eye(2)).astype(np.float32)
    Q = sigma_x**2 * np.kron([[1 / 3, 1 / 2], [1 / 2, 1.0]], np.eye(2)).astype("f4")
    H = np.eye(2, 4, dtype=np.float32)
    R = sigma_y**2 * np.eye(2, dtype=np.float32)

    @property
    def observations(self) -> np.ndarray:
        """y_1..y_t, (t, 2), drawn from the model."""
        rng = np.random.default_rng(0)
        factor = np.linalg.cholesky(self.Q)
        state, drawn = rng.standard_normal(4), []
        for _ in range(self.num_steps):
            state = self.A @ state + factor @ rng.standard_normal(4)
            drawn.append(self.H @ state + self.sigma_y * rng.standard_normal(2))
        return np.array(drawn, np.float32)

    def initial(self, number: int) -> np.ndarray:
        """x_0."""
        return np.random.standard_normal((number, 4))

    def step(self, states: np.ndarray) -> np.ndarray:
        """x_t given x_{t-1}."""
        factor = np.linalg.cholesky(self.Q.astype(float)).T
        return states @ self.A.T.astype(float) + np.random.standard_normal(states.shape) @ factor

    def log_likelihood(self, y, states):
        """log L(y_t | x_t), of arrays of numpy or JAX."""
        log_scale = 2 * float(np.log(self.sigma_y)) + LOG_2_PI
        return -0.5 * (((y - states[..., :2]) / self.sigma_y) ** 2).sum(-1) - log_scale


Job = Quadratic | ConstantVelocity
JOBS: dict[str, Job] = {"quadratic": Quadratic(), "constant_velocity": ConstantVelocity()}
