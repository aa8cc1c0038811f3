"""The two jobs of `benchmarks.peers` in numbers, the same for every library; numpy only."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Quadratic:
    """x_t = x_{t-1} + N(0, σ_x²), y_t = x_t² + N(0, σ_y²), x_0 uniform; the true state a sinusoid.

    Vermaak et al. (2003), section 5.1. States are scalars.
    """

    title: str = "quadratic model, 1 dimension"
    num_steps: int = 100
    sigma_x: float = 0.1
    sigma_y: float = 0.1
    low: float = -2.5
    high: float = 2.5

    @property
    def state_shape(self) -> tuple[int, ...]:
        """()."""
        return ()

    @property
    def observations(self) -> np.ndarray:
        """y_1..y_t, (t,)."""
        truth = 2 * np.sin(2 * np.pi * np.arange(1, self.num_steps + 1) / 100)
        noise = np.random.default_rng(0).standard_normal(self.num_steps)
        return (truth**2 + self.sigma_y * noise).astype(np.float32)


@dataclass(frozen=True)
class ConstantVelocity:
    """A point that moves in the plane with a noisy velocity, seen in its position.

    States are (x, y, velocity of x, velocity of y): x_t = A x_{t-1} + N(0, Q), y_t = H x_t +
    N(0, σ_y² I), x_0 ~ N(0, I).
    """

    title: str = "constant velocity, 4 dimensions"
    num_steps: int = 50
    sigma_x: float = 0.3
    sigma_y: float = 1.0

    @property
    def state_shape(self) -> tuple[int, ...]:
        """(4,)."""
        return (4,)

    @property
    def A(self) -> np.ndarray:
        """One step at the present velocity."""
        return np.kron([[1.0, 1.0], [0.0, 1.0]], np.eye(2)).astype(np.float32)

    @property
    def Q(self) -> np.ndarray:
        """White-noise acceleration over one step."""
        return self.sigma_x**2 * np.kron([[1 / 3, 1 / 2], [1 / 2, 1.0]], np.eye(2)).astype("f4")

    @property
    def H(self) -> np.ndarray:
        """The position."""
        return np.eye(2, 4, dtype=np.float32)

    @property
    def R(self) -> np.ndarray:
        """σ_y² I."""
        return self.sigma_y**2 * np.eye(2, dtype=np.float32)

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


Job = Quadratic | ConstantVelocity
JOBS: dict[str, Job] = {"quadratic": Quadratic(), "constant_velocity": ConstantVelocity()}
