"""The Kalman filter and smoother, for linear-Gaussian models."""

from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from mpfjax.checks import as_numbers, checked
from mpfjax.models.base import with_inputs
from mpfjax.models.linear import LinearGaussianModel
from mpfjax.models.observations import Series, gathered, present_steps, steps_of_inputs
from mpfjax.operations.matrices import cholesky


class LinearStep(NamedTuple):
    """x_t = F x_{t-1} + b + N(0, Q), y_t = H x_t + c + N(0, R), at one step."""

    F: Float[Array, "d d"]
    b: Float[Array, " d"]
    Q: Float[Array, "d d"]
    H: Float[Array, "p d"]
    c: Float[Array, " p"]
    R: Float[Array, "p p"]


Moments = tuple[Float[Array, "... d"], Float[Array, "... d d"]]
StepOf = Callable[[PyTree], LinearStep]


class KalmanFilterRun(eqx.Module):
    """The filtering distribution of a linear-Gaussian model."""

    means: Float[Array, "t d"]
    """E[x_t | y_1..y_t]."""
    covariances: Float[Array, "t d d"]
    """Cov[x_t | y_1..y_t]."""
    log_likelihood_increments: Float[Array, " t"]
    log_marginal_likelihood: Float[Array, ""]


class KalmanSmootherRun(eqx.Module):
    """The smoothing distribution of a linear-Gaussian model; its first time is that of x_0."""

    means: Float[Array, "t d"]
    """E[x_s | y_1..y_t] for s = 0, ..., t."""
    covariances: Float[Array, "t d d"]
    """Cov[x_s | y_1..y_t] for s = 0, ..., t."""
    lagged_covariances: Float[Array, "s d d"]
    """Cov[x_s, x_{s-1} | y_1..y_t] for s = 1, ..., t, which EM needs."""
    log_marginal_likelihood: Float[Array, ""]


@checked
def kalman_filter(
    model: LinearGaussianModel,
    observations: PyTree,
    *,
    inputs: PyTree = None,
    missing: Literal["error", "skip"] = "error",
) -> KalmanFilterRun:
    """The Kalman filter (Kalman 1960), with the library's convention: y_1 follows x_1, not x_0.

    Covariances are updated in Joseph's form, which stays positive in float32. Differentiable, and
    `jax.vmap` maps it over several series.

    - `observations`: an array (t, p), or a `Series` of one.
    - `inputs`: those of the model, controls or matrices that change in time; as for `run_filter`.
    - `missing`: "skip", as `Series.skipping`, leaves out each number that is NaN: of two sensors,
      the one that is there counts. (A particle filter leaves out the whole step, unless its model
      has `handles_missing`.) With "error" a NaN is a `ValueError`, as far as the numbers are known.

    Raises `ValueError` for another model and observations that are not (t, p). Use it as the
    reference for a linear-Gaussian model.
    """
    filtered, increments = _kalman_filter(model, *_checked(model, observations, inputs, missing))
    return KalmanFilterRun(*filtered, increments, jnp.sum(increments))


@checked
def kalman_smoother(
    model: LinearGaussianModel,
    observations: PyTree,
    *,
    inputs: PyTree = None,
    missing: Literal["error", "skip"] = "error",
) -> KalmanSmootherRun:
    """E and Cov of x_0, ..., x_t given y_1..y_t, by the recursion of Rauch, Tung and Striebel 1965.

    After the Kalman filter it goes back from x_t. With (m, P) the filter's moments at s, and (m',
    P') the smoothed ones at s + 1,

        G = P Aᵀ (A P Aᵀ + Q)⁻¹,   mean m + G (m' - A m),   covariance
        (I - G A) P (I - G A)ᵀ + G (Q + P') Gᵀ,

    a sum of positive terms, which stays positive in float32. Differentiable, and `jax.vmap` maps it
    over several series. Arguments and errors are those of `kalman_filter`. Use it as the reference
    for particle smoothers of a linear-Gaussian model.
    """
    return _smooth(model, *_checked(model, observations, inputs, missing))


def _checked(model: Any, data: PyTree, inputs: PyTree, missing: str) -> tuple[Array, PyTree]:
    series = gathered(data, inputs, missing)
    rows = checked_rows(series, model.H.shape[0], model.m0.dtype)
    return rows, steps_of_inputs(series.inputs, rows.shape[0], model)


def checked_rows(series: Series, num_rows: int, dtype: jnp.dtype) -> Float[Array, "t p"]:
    """y_1..y_t as an array of this type, NaN where missing; a `ValueError` for what is none."""
    rows = as_numbers("observations", series.observations, floating=True)
    if rows.ndim != 2 or rows.shape[1] != num_rows:
        raise ValueError(f"observations: shape {rows.shape} is not (t, {num_rows})")
    present = present_steps(rows, series, takes_nan=series.skips_missing)
    rows = jnp.asarray(rows).astype(dtype)
    return rows if present is None else jnp.where(present[:, None], rows, jnp.nan)


@eqx.filter_jit
def _kalman_filter(constant, observations, inputs):
    """Means and covariances of x_1, ..., x_t, and the increments."""
    start = constant.m0, constant.P0
    return filtered_moments(start, lambda now: _step_of(constant, now), inputs, observations)


@eqx.filter_jit
def _smooth(constant, observations, inputs):
    start, filtered = (constant.m0, constant.P0), _kalman_filter(constant, observations, inputs)
    moments, increments = filtered
    step_of = lambda now: _step_of(constant, now)  # noqa: E731
    smoothed, lagged = smoothed_moments(start, moments, step_of, inputs)
    return KalmanSmootherRun(*smoothed, lagged, jnp.sum(increments))


def _step_of(constant: LinearGaussianModel, now: PyTree) -> LinearStep:
    """The model's matrices at the step whose inputs are these."""
    model = with_inputs(constant, now)
    nothing = jnp.zeros(model.H.shape[0], model.m0.dtype)
    b = jnp.zeros_like(model.m0) if model.control is None else model.control
    return LinearStep(model.A, b, model.Q, model.H, nothing, model.R)


def filtered_moments(
    start: Moments, step_of: StepOf, told: PyTree, observations: Float[Array, "t p"]
) -> tuple[Moments, Float[Array, " t"]]:
    """Means and covariances of x_1, ..., x_t, and the increments; a NaN is a missing number.

    `step_of` makes the matrices of each step from its part of `told`, which has a leading axis t.
    """
    identity = jnp.eye(start[0].shape[0], dtype=start[0].dtype)

    def advance(carry: Moments, of_step: tuple[Array, PyTree]) -> tuple[Moments, Any]:
        (mean, covariance), (observation, now) = carry, of_step
        step = step_of(now)
        mean = step.F @ mean + step.b
        covariance = step.F @ covariance @ step.F.T + step.Q
        seen = ~jnp.isnan(observation)
        # A missing number becomes one with H = 0, variance one and no error.
        H = jnp.where(seen[:, None], step.H, 0.0)
        R = jnp.where(seen[:, None] & seen[None], step.R, jnp.eye(*step.R.shape, dtype=H.dtype))
        innovation = jnp.where(seen, observation - step.c, 0.0) - H @ mean
        factor = jnp.linalg.cholesky(H @ covariance @ H.T + R)
        white = jax.scipy.linalg.solve_triangular(factor, innovation, lower=True)
        increment = -0.5 * jnp.sum(white**2) - jnp.sum(jnp.log(jnp.diagonal(factor)))
        increment -= 0.5 * jnp.sum(seen).astype(mean.dtype) * jnp.log(2 * jnp.pi)
        gain = jax.scipy.linalg.cho_solve((factor, True), H @ covariance).T
        left = identity - gain @ H
        mean = mean + gain @ innovation
        covariance = left @ covariance @ left.T + gain @ R @ gain.T
        return (mean, covariance), (mean, covariance, increment)

    _, (means, covariances, increments) = jax.lax.scan(advance, start, (observations, told))
    return (means, covariances), increments


def _root(covariance: Float[Array, "d d"]) -> Float[Array, "d d"]:
    """The Cholesky factor, in which a direction without variance counts as independent.

    What is multiplied by the inverse has nothing in that direction either, so that any will do.
    """
    factor, variances = cholesky(covariance[None])[0], jnp.diagonal(covariance)
    scales = jnp.sqrt(jnp.where(variances > 0, variances, 1.0))
    return factor + jnp.diag(jnp.where(jnp.diagonal(factor) == 0, scales, 0.0))


def smoothed_moments(
    start: Moments, filtered: Moments, step_of: StepOf, told: PyTree
) -> tuple[Moments, Float[Array, "t d d"]]:
    """Those of x_0, ..., x_t given y_1..y_t, and Cov[x_s, x_{s-1}]."""
    identity = jnp.eye(start[0].shape[0], dtype=start[0].dtype)

    def back(later: Moments, earlier: tuple[Array, Array, PyTree]) -> tuple[Moments, Any]:
        (later_mean, later_covariance), (mean, covariance, now) = later, earlier
        step = step_of(now)
        predicted = step.F @ covariance @ step.F.T + step.Q
        gain = jax.scipy.linalg.cho_solve((_root(predicted), True), step.F @ covariance).T
        left = identity - gain @ step.F
        mean = mean + gain @ (later_mean - (step.F @ mean + step.b))
        covariance = left @ covariance @ left.T + gain @ (step.Q + later_covariance) @ gain.T
        return (mean, covariance), (mean, covariance, later_covariance @ gain.T)

    last = filtered[0][-1], filtered[1][-1]
    earlier = jax.tree.map(
        lambda row, rows: jnp.concatenate([row[None], rows[:-1]]), start, filtered
    )
    _, (*found, lagged) = jax.lax.scan(back, last, (*earlier, told), reverse=True)
    means, covariances = (
        jnp.concatenate([rows, row[None]]) for rows, row in zip(found, last, strict=True)
    )
    return (means, covariances), lagged
