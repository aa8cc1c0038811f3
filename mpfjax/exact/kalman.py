"""The Kalman filter and smoother, for linear-Gaussian models."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, PyTree

from mpfjax.checks import as_numbers, check_one_of, check_type
from mpfjax.models.inputs import with_inputs
from mpfjax.models.linear_gaussian import LinearGaussianModel
from mpfjax.observations import steps_of_inputs


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


def kalman_filter(
    model: LinearGaussianModel,
    observations: Float[Array, "t p"],
    *,
    inputs: PyTree = None,
    missing: str = "error",
) -> KalmanFilterRun:
    """The Kalman filter (Kalman 1960), with the library's convention: y_1 follows x_1, not x_0.

    Covariances are updated in Joseph's form, which stays positive in float32. Differentiable, and
    `jax.vmap` maps it over several series.

    - `inputs`: the model's, with a leading axis t: controls, or matrices that change in time.
    - `missing`: "error" raises a `ValueError` for a NaN or an infinity, as far as the numbers are
      known. "skip" leaves out each number that is NaN: of two sensors, the one that is there
      counts. (A particle filter leaves out the whole step, unless its model has `handles_missing`.)

    Raises `ValueError` for another model and observations that are not (t, p). Use it as the truth
    for a linear-Gaussian model.
    """
    series = _checked(model, observations, inputs, missing)
    filtered, increments = _kalman_filter(model, *series)
    return KalmanFilterRun(*filtered, increments, jnp.sum(increments))


def kalman_smoother(
    model: LinearGaussianModel,
    observations: Float[Array, "t p"],
    *,
    inputs: PyTree = None,
    missing: str = "error",
) -> KalmanSmootherRun:
    """E and Cov of x_0, ..., x_t given y_1..y_t, by the recursion of Rauch, Tung and Striebel 1965.

    After the Kalman filter it goes back from x_t. With (m, P) the filter's moments at s, and (m',
    P') the smoothed ones at s + 1,

        G = P Aᵀ (A P Aᵀ + Q)⁻¹,   mean m + G (m' - A m),   covariance
        (I - G A) P (I - G A)ᵀ + G (Q + P') Gᵀ,

    a sum of positive terms, which stays positive in float32. Differentiable, and `jax.vmap` maps it
    over several series. Arguments and errors are those of `kalman_filter`. Use it as the truth for
    what a particle smoother says of a linear-Gaussian model.
    """
    return _smooth(model, *_checked(model, observations, inputs, missing))


def _checked(
    model: Any, observations: Any, inputs: PyTree, missing: str
) -> tuple[Float[Array, "t p"], PyTree]:
    check_type(LinearGaussianModel, "a LinearGaussianModel", model=model)
    check_one_of(("error", "skip"), missing=missing)
    rows = jnp.asarray(as_numbers("observations", observations, floating=True))
    if rows.ndim != 2 or rows.shape[1] != model.H.shape[0]:
        raise ValueError(f"observations: shape {rows.shape} is not (t, {model.H.shape[0]})")
    if not isinstance(rows, Tracer):
        values = np.asarray(rows)
        usable = ~np.isinf(values) if missing == "skip" else np.isfinite(values)
        if not usable.all():
            what = "infinite" if missing == "skip" else "NaN or infinite"
            first = int(np.argmin(usable.all(axis=1)))
            raise ValueError(f"observations: {what} at index {first} of the leading axis")
    return rows.astype(model.m0.dtype), steps_of_inputs(inputs, rows.shape[0], model)


@eqx.filter_jit
def _kalman_filter(constant, observations, inputs):
    """Means and covariances of x_1, ..., x_t, and the increments; a NaN is a missing number."""
    identity = jnp.eye(constant.m0.shape[0], dtype=constant.m0.dtype)

    def advance(carry, step):
        (mean, covariance), (observation, now) = carry, step
        model = with_inputs(constant, now)
        mean = _moved(model, mean)
        covariance = model.A @ covariance @ model.A.T + model.Q
        seen = ~jnp.isnan(observation)
        # A number that is missing is one of variance one, of nothing and equal to what is expected.
        H = jnp.where(seen[:, None], model.H, 0.0)
        R = jnp.where(seen[:, None] & seen[None], model.R, jnp.eye(*model.R.shape, dtype=H.dtype))
        innovation = jnp.where(seen, observation, 0.0) - H @ mean
        factor = jnp.linalg.cholesky(H @ covariance @ H.T + R)
        white = jax.scipy.linalg.solve_triangular(factor, innovation, lower=True)
        increment = -0.5 * jnp.sum(white**2) - jnp.sum(jnp.log(jnp.diagonal(factor)))
        increment -= 0.5 * jnp.sum(seen).astype(mean.dtype) * jnp.log(2 * jnp.pi)
        gain = jax.scipy.linalg.cho_solve((factor, True), H @ covariance).T
        left = identity - gain @ H
        mean = mean + gain @ innovation
        covariance = left @ covariance @ left.T + gain @ R @ gain.T
        return (mean, covariance), (mean, covariance, increment)

    start, steps = (constant.m0, constant.P0), (observations, inputs)
    _, (means, covariances, increments) = jax.lax.scan(advance, start, steps)
    return (means, covariances), increments


def _moved(model: LinearGaussianModel, mean: Float[Array, " d"]) -> Float[Array, " d"]:
    """A m + B u."""
    return model.A @ mean if model.control is None else model.A @ mean + model.control


@eqx.filter_jit
def _smooth(constant, observations, inputs):
    (means, covariances), increments = _kalman_filter(constant, observations, inputs)
    identity = jnp.eye(constant.m0.shape[0], dtype=constant.m0.dtype)

    def back(later, earlier):
        (later_mean, later_covariance), (mean, covariance, now) = later, earlier
        model = with_inputs(constant, now)
        predicted = model.A @ covariance @ model.A.T + model.Q
        gain = jnp.linalg.solve(predicted, model.A @ covariance).T
        left = identity - gain @ model.A
        mean = mean + gain @ (later_mean - _moved(model, mean))
        covariance = left @ covariance @ left.T + gain @ (model.Q + later_covariance) @ gain.T
        return (mean, covariance), (mean, covariance, later_covariance @ gain.T)

    last = means[-1], covariances[-1]
    earlier = (
        jnp.concatenate([constant.m0[None], means[:-1]]),
        jnp.concatenate([constant.P0[None], covariances[:-1]]),
        inputs,
    )
    _, (smoothed, spreads, lagged) = jax.lax.scan(back, last, earlier, reverse=True)
    return KalmanSmootherRun(
        means=jnp.concatenate([smoothed, last[0][None]]),
        covariances=jnp.concatenate([spreads, last[1][None]]),
        lagged_covariances=lagged,
        log_marginal_likelihood=jnp.sum(increments),
    )
