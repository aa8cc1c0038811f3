"""Linear Gaussian models: one system, and K systems selected by a Markov chain."""

import dataclasses
from typing import Annotated

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key, PyTree

from mpfjax.arrays import COVARIANCE, FINITE, Fitting, to_array
from mpfjax.checks import check_shape, entries
from mpfjax.models.base import AbstractStateSpaceModel
from mpfjax.models.conditionally_linear import AbstractConditionallyLinearModel
from mpfjax.models.gaussians import log_multinormal
from mpfjax.operations.logarithms import log_or_nothing
from mpfjax.operations.matrices import cholesky
from mpfjax.operations.random import normal, uniform
from mpfjax.operations.segments import spread

# Sums of probabilities may differ from one by this much, for rounding.
_ROUNDING = 1e-4
PROBABILITIES = entries(
    lambda rows: (rows >= 0).all() & (np.abs(rows.sum(axis=-1) - 1) <= _ROUNDING),
    "probabilities, rows that sum to one",
)
# One of all regimes, or one for each.
VectorOfEach = Annotated[Float[Array, " d"] | Float[Array, "k d"], FINITE]
SquareOfEach = Float[Array, "d d"] | Float[Array, "k d d"]
RowsOfEach = Float[Array, "p d"] | Float[Array, "k p d"]
NoiseOfEach = Float[Array, "p p"] | Float[Array, "k p p"]
OffsetOfEach = Annotated[Float[Array, " p"] | Float[Array, "k p"], FINITE]
States = Float[Array, "n d"]
Regimes = Int[Array, " n"]
Parts = Float[Array, "..."]


class LinearGaussianModel(AbstractStateSpaceModel, Fitting):
    """x_t = A x_{t-1} + B u_t + N(0, Q), y_t = H x_t + N(0, R), x_0 ~ N(m0, P0).

    - `A`, `Q`: (d, d); `H`: (p, d); `R`: (p, p); `m0`: (d,); `P0`: (d, d). R is positive definite;
      P0 and Q may be singular, but x_0 or x_t then has no density. States have shape (n, d),
      observations (p,).
    - `B`: (d, k), the control matrix, for inputs u_t, (k,). None omits B u_t.

    Inputs are u_t alone, or a dict of the fields that vary in time by their names, such as {"A":
    ..., "Q": ..., "inputs": ...}: each contains that field at step t. So the matrices of a
    continuous-time system at irregular times are inputs too.

    Raises `ValueError` for shapes that do not agree, and for Q, R or P0 that is not a covariance.
    Use it to compare a filter with the Kalman filter, or if the system is linear.
    """

    A: Annotated[Float[Array, "d d"], FINITE] = eqx.field(converter=to_array("A"))
    Q: Annotated[Float[Array, "d d"], COVARIANCE] = eqx.field(converter=to_array("Q"))
    H: Annotated[Float[Array, "p d"], FINITE] = eqx.field(converter=to_array("H"))
    R: Annotated[Float[Array, "p p"], COVARIANCE] = eqx.field(converter=to_array("R"))
    m0: Annotated[Float[Array, " d"], FINITE] = eqx.field(converter=to_array("m0"))
    P0: Annotated[Float[Array, "d d"], COVARIANCE] = eqx.field(converter=to_array("P0"))
    B: Annotated[Float[Array, "d k"], FINITE] | None = eqx.field(
        converter=to_array("B"), default=None
    )
    inputs: Float[Array, " k"] | None = eqx.field(converter=to_array("inputs"), default=None)

    def with_inputs(self, inputs: PyTree) -> "LinearGaussianModel":
        """The model at step t: u_t, (k,), or a dict of the fields that vary in time."""
        fields = inputs if isinstance(inputs, dict) else {"inputs": inputs}
        return dataclasses.replace(self, **fields)

    @property
    def control(self) -> Float[Array, " d"] | None:
        """B u_t; None if there is no B, or no u_t."""
        return None if self.B is None or self.inputs is None else self.B @ self.inputs

    def sample_initial(self, key: Key[Array, ""], num_particles: int) -> States:
        """x_0 ~ N(m0, P0)."""
        noise = normal(key, (num_particles, self.initial_noise_dimension), self.m0.dtype)
        return self.initial_from_noise(noise)

    @property
    def initial_noise_dimension(self) -> int:
        """d."""
        return self.m0.shape[0]

    def initial_from_noise(self, noise: Float[Array, "n d"]) -> States:
        """x_0 ~ N(m0, P0)."""
        return self.m0[None] + noise @ _root(self.P0).T

    noise_dimension = initial_noise_dimension

    def transition_from_noise(self, noise: Float[Array, "n d"], states: States) -> States:
        """x_t ~ N(A x_{t-1} + B u_t, Q)."""
        return self.transition_mean(states) + noise @ _root(self.Q).T

    def log_likelihood(self, observation: Float[Array, " p"], states: States) -> Float[Array, " n"]:
        """log N(y_t; H x_t, R)."""
        check_shape(f"{self.H.shape[0]}", observation=observation)
        return log_multinormal(observation[None] - self.observation_mean(states), self.R)

    def sample_observation(self, key: Key[Array, ""], states: States) -> Float[Array, "n p"]:
        """y_t ~ N(H x_t, R) of every state."""
        noise = normal(key, (len(states), self.R.shape[0]), self.R.dtype)
        return self.observation_mean(states) + noise @ _root(self.R).T

    def log_transition(self, states: States, previous_states: States) -> Float[Array, " n"]:
        """log N(x_t; A x_{t-1} + B u_t, Q)."""
        return log_multinormal(states - self.transition_mean(previous_states), self.Q)

    def log_initial(self, states: States) -> Float[Array, " n"]:
        """log N(x_0; m0, P0)."""
        return log_multinormal(states - self.m0[None], self.P0)

    def transition_mean(self, states: States) -> States:
        """A x_{t-1} + B u_t."""
        mean = states @ self.A.T
        return mean if self.control is None else mean + self.control[None]

    def observation_mean(self, states: States) -> Float[Array, "n p"]:
        """H x_t."""
        return states @ self.H.T

    @property
    def transition_covariance(self) -> Float[Array, "d d"]:
        """Q."""
        return self.Q

    @property
    def observation_covariance(self) -> Float[Array, "p p"]:
        """R."""
        return self.R


class SwitchingLinearGaussianModel(AbstractConditionallyLinearModel, Fitting):
    """A Markov chain of K regimes z_t, and a linear Gaussian system for each of them.

        P(z_t = j | z_{t-1} = i) = Π_ij,    x_0 ~ N(m0, P0),
        x_t = F[z_t] x_{t-1} + b[z_t] + N(0, Q[z_t]),    y_t = H[z_t] x_t + c[z_t] + N(0, R[z_t])

    A jump Markov linear system, or switching state-space model. The latent is the regime, integers
    (n,). `exact.switching_filter` is exact for a short series.

    - `transition_matrix`: Π, (K, K), each row sums to one.
    - `F`, `Q`: (d, d), or (K, d, d) with one for each regime; `H`: (p, d) or (K, p, d); `R`: (p, p)
      or (K, p, p). Q and R are positive semidefinite.
    - `m0`: (d,) or (K, d), and `P0`: (d, d) or (K, d, d), by z_0.
    - `b`, `c`: (d,) or (K, d), and (p,) or (K, p); None is zero.
    - `initial_probabilities`: of z_0, (K,); None makes all equal.

    Raises `ValueError` for shapes that do not agree, for rows that are not probabilities, and for
    Q, R or P0 that is not a covariance. Use it for manoeuvring targets, and for regimes of a time
    series.
    """

    transition_matrix: Annotated[Float[Array, "k k"], PROBABILITIES] = eqx.field(
        converter=to_array("transition_matrix")
    )
    F: Annotated[SquareOfEach, FINITE] = eqx.field(converter=to_array("F"))
    Q: Annotated[SquareOfEach, COVARIANCE] = eqx.field(converter=to_array("Q"))
    H: Annotated[RowsOfEach, FINITE] = eqx.field(converter=to_array("H"))
    R: Annotated[NoiseOfEach, COVARIANCE] = eqx.field(converter=to_array("R"))
    m0: VectorOfEach = eqx.field(converter=to_array("m0"))
    P0: Annotated[SquareOfEach, COVARIANCE] = eqx.field(converter=to_array("P0"))
    b: VectorOfEach | None = eqx.field(converter=to_array("b"), default=None, kw_only=True)
    c: OffsetOfEach | None = eqx.field(converter=to_array("c"), default=None, kw_only=True)
    initial_probabilities: Annotated[Float[Array, " k"], PROBABILITIES] | None = eqx.field(
        converter=to_array("initial_probabilities"), default=None, kw_only=True
    )

    @property
    def num_regimes(self) -> int:
        """K."""
        return self.transition_matrix.shape[0]

    @property
    def probabilities_at_start(self) -> Float[Array, " k"]:
        """P(z_0)."""
        if self.initial_probabilities is not None:
            return self.initial_probabilities
        return jnp.full(self.num_regimes, 1 / self.num_regimes, self.transition_matrix.dtype)

    def sample_initial(self, key: Key[Array, ""], num_particles: int) -> Regimes:
        """z_0 by its probabilities."""
        shares = uniform(key, (num_particles,), self.transition_matrix.dtype)
        return self._initial(shares)

    noise_dimension = initial_noise_dimension = 1

    def initial_from_noise(self, noise: Float[Array, "n 1"]) -> Regimes:
        """z_0 as a function of standard normal numbers."""
        return self._initial(jax.scipy.special.ndtr(noise[:, 0]))

    def initial_moments(self, latent: Regimes) -> tuple[Parts, Parts]:
        """m0 and P0."""
        return self._of(latent, self.m0, 1), self._of(latent, self.P0, 2)

    def sample_transition(self, key: Key[Array, ""], latent: Regimes) -> Regimes:
        """z_t by the row of z_{t-1}."""
        shares = uniform(key, latent.shape, self.transition_matrix.dtype)
        return self._next(shares, latent)

    def transition_from_noise(self, noise: Float[Array, "n 1"], latent: Regimes) -> Regimes:
        """z_t as a function of standard normal numbers."""
        return self._next(jax.scipy.special.ndtr(noise[:, 0]), latent)

    def log_transition(self, latent: Regimes, previous_latent: Regimes) -> Float[Array, " n"]:
        """log Π of the two regimes."""
        k = self.num_regimes
        return spread(log_or_nothing(self.transition_matrix).ravel(), previous_latent * k + latent)

    def log_initial(self, latent: Regimes) -> Float[Array, " n"]:
        """log P(z_0)."""
        return spread(log_or_nothing(self.probabilities_at_start), latent)

    def all_transitions(self, latent: Regimes) -> list[tuple[Regimes, Float[Array, " n"]]]:
        """Every regime, with the log of its probability given z_{t-1}."""
        log_matrix = log_or_nothing(self.transition_matrix)
        return [
            (jnp.full_like(latent, j), spread(log_matrix[:, j], latent))
            for j in range(self.num_regimes)
        ]

    def dynamics(self, latent: Regimes, previous_latent: Regimes) -> tuple[Parts, Parts, Parts]:
        """F, b and Q of the regime z_t."""
        b = jnp.zeros(self.m0.shape[-1], self.m0.dtype) if self.b is None else self.b
        return self._of(latent, self.F, 2), self._of(latent, b, 1), self._of(latent, self.Q, 2)

    def emission(self, latent: Regimes) -> tuple[Parts, Parts, Parts]:
        """H, c and R of the regime z_t."""
        c = jnp.zeros(self.H.shape[-2], self.H.dtype) if self.c is None else self.c
        return self._of(latent, self.H, 2), self._of(latent, c, 1), self._of(latent, self.R, 2)

    def _of(self, latent: Regimes, values: Array, rank: int) -> Parts:
        """The parameter of each particle's regime; one that all regimes share, unchanged."""
        return values if values.ndim == rank else spread(values, latent)

    def _initial(self, shares: Float[Array, " n"]) -> Regimes:
        bounds = jnp.cumsum(self.probabilities_at_start)[:-1]
        return jnp.sum(shares[:, None] >= bounds[None], axis=1, dtype=jnp.int32)

    def _next(self, shares: Float[Array, " n"], latent: Regimes) -> Regimes:
        """The regime whose interval of the row's cumulative probabilities holds each number."""
        bounds = jnp.cumsum(self.transition_matrix, axis=1)
        drawn = jnp.zeros_like(latent)
        for j in range(self.num_regimes - 1):
            drawn = drawn + (shares >= spread(bounds[:, j], latent)).astype(latent.dtype)
        return drawn


def _root(covariance: Float[Array, "d d"]) -> Float[Array, "d d"]:
    """A lower triangular L with L Lᵀ = covariance, which may be singular."""
    is_definite = jnp.all(jnp.isfinite(jnp.linalg.cholesky(jax.lax.stop_gradient(covariance))))
    return jax.lax.cond(
        is_definite, jnp.linalg.cholesky, lambda matrix: cholesky(matrix[None])[0], covariance
    )
