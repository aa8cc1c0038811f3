"""Exact references: the grid filter for scalar models and the Kalman filter for linear ones."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mpfjax.models.base import require
from mpfjax.models.linear_gaussian import LinearGaussianModel
from mpfjax.operations.logarithms import log_sum_exp


class GridFilterRun(eqx.Module):
    """The filtering distribution of a scalar model, on a grid."""

    grid: Float[Array, " g"]
    probabilities: Float[Array, "t g"]
    """the mass of each grid cell under p(x_t | y_1..y_t)."""
    log_likelihood_increments: Float[Array, " t"]
    log_marginal_likelihood: Float[Array, ""]

    @property
    def means(self) -> Float[Array, " t"]:
        """E[x_t | y_1..y_t]."""
        return self.probabilities @ self.grid

    @property
    def variances(self) -> Float[Array, " t"]:
        """Var[x_t | y_1..y_t]."""
        return self.probabilities @ self.grid**2 - self.means**2

    def mass_above(self, threshold: float) -> Float[Array, " t"]:
        """P(x_t > threshold | y_1..y_t); of the cell at the threshold, the part above it counts."""
        cell = self.grid[1] - self.grid[0]
        return self.probabilities @ jnp.clip((self.grid - threshold) / cell + 0.5, 0.0, 1.0)


@eqx.filter_jit
def grid_filter(
    model: Any,
    observations: Float[Array, "t ..."],
    grid: Float[Array, " g"],
    log_initial: Float[Array, " g"] | None = None,
    *,
    state_shape: tuple[int, ...] = (),
) -> GridFilterRun:
    """The recursion of Vermaak et al. (2003), eqs. 1 and 2, by quadrature on an even grid.

    - `model`: has `log_transition` and `log_likelihood`; its states are scalars of shape
      `state_shape`, () or (1,).
    - `grid`: evenly spaced points that cover all values that x_t can have, with several points in
      the smallest standard deviation of the model. The error then falls faster than any power of
      the spacing.
    - `log_initial`: log p(x_0) at the grid points; None calls the model's own `log_initial`.

    Costs O(t g²). Differentiable in the model's parameters. Raises `ValueError` for a grid that
    is not one ascending row, or a model without these densities. Use it as the truth for a
    scalar model.
    """
    if grid.ndim != 1 or grid.shape[0] < 2:
        raise ValueError(f"grid: shape {grid.shape} is not one row of at least two points")
    for density in ("log_transition", "log_likelihood"):
        require(model, density, "grid_filter")
    num_points = grid.shape[0]
    states = grid.reshape(-1, *state_shape)
    if log_initial is None:
        require(model, "log_initial", "grid_filter without log_initial")
        log_prior: Float[Array, " g"] = model.log_initial(states)
    else:
        log_prior = log_initial
    log_cell = jnp.log(grid[1] - grid[0])
    kernel = jnp.exp(
        log_cell
        + jax.vmap(
            lambda previous: model.log_transition(
                states, jnp.broadcast_to(previous, (num_points, *state_shape))
            )
        )(states)
    )

    def advance(
        probabilities: Float[Array, " g"], observation: Float[Array, "..."]
    ) -> tuple[Float[Array, " g"], tuple[Float[Array, " g"], Float[Array, ""]]]:
        predicted = probabilities @ kernel
        positive = predicted > 0
        log_predicted = jnp.where(positive, jnp.log(jnp.where(positive, predicted, 1.0)), -jnp.inf)
        log_joint = log_predicted + model.log_likelihood(observation, states)
        increment = log_sum_exp(log_joint)
        updated = jnp.exp(log_joint - increment)
        return updated, (updated, increment)

    initial = jnp.exp(log_prior - log_sum_exp(log_prior))
    _, (probabilities, increments) = jax.lax.scan(advance, initial, observations)
    return GridFilterRun(grid, probabilities, increments, jnp.sum(increments))


class KalmanFilterRun(eqx.Module):
    """The filtering distribution of a linear-Gaussian model."""

    means: Float[Array, "t d"]
    """E[x_t | y_1..y_t]."""
    covariances: Float[Array, "t d d"]
    """Cov[x_t | y_1..y_t]."""
    log_likelihood_increments: Float[Array, " t"]
    log_marginal_likelihood: Float[Array, ""]


@eqx.filter_jit
def kalman_filter(model: LinearGaussianModel, observations: Float[Array, "t p"]) -> KalmanFilterRun:
    """The Kalman filter (Kalman 1960), with the library's convention: y_1 follows x_1, not x_0.

    Covariances are updated in Joseph's form, which stays positive in float32. Differentiable.
    Raises `ValueError` for observations that are not (t, p). Use it as the truth for a
    linear-Gaussian model.
    """
    if observations.ndim != 2 or observations.shape[1] != model.H.shape[0]:
        raise ValueError(f"observations: shape {observations.shape} is not (t, {model.H.shape[0]})")
    identity = jnp.eye(model.m0.shape[0], dtype=model.m0.dtype)

    def advance(carry, observation):
        mean, covariance = carry
        mean = model.A @ mean
        covariance = model.A @ covariance @ model.A.T + model.Q
        innovation = observation - model.H @ mean
        factor = jnp.linalg.cholesky(model.H @ covariance @ model.H.T + model.R)
        white = jax.scipy.linalg.solve_triangular(factor, innovation, lower=True)
        increment = -0.5 * jnp.sum(white**2) - jnp.sum(jnp.log(jnp.diagonal(factor)))
        increment -= 0.5 * innovation.shape[0] * jnp.log(2 * jnp.pi)
        gain = jax.scipy.linalg.cho_solve((factor, True), model.H @ covariance).T
        left = identity - gain @ model.H
        mean = mean + gain @ innovation
        covariance = left @ covariance @ left.T + gain @ model.R @ gain.T
        return (mean, covariance), (mean, covariance, increment)

    _, (means, covariances, increments) = jax.lax.scan(advance, (model.m0, model.P0), observations)
    return KalmanFilterRun(means, covariances, increments, jnp.sum(increments))
