"""The Kalman filter and smoother, for linear Gaussian models."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from mpfjax.checks import as_numbers, checked
from mpfjax.models.base import with_inputs
from mpfjax.models.linear import LinearGaussianModel
from mpfjax.models.observations import NOT_FINITE, numpy_for
from mpfjax.models.series import (
    Series,
    check_differences,
    present_steps,
    series_of,
    steps_of_inputs,
    with_gaps,
)


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
    """The filtering distribution of a linear Gaussian model."""

    means: Float[Array, "t d"]
    """E[x_t | y_1..y_t]."""
    covariances: Float[Array, "t d d"]
    """Cov[x_t | y_1..y_t]."""
    log_likelihood_increments: Float[Array, " t"]
    log_marginal_likelihood: Float[Array, ""]


class KalmanSmootherRun(eqx.Module):
    """The smoothing distribution of a linear Gaussian model; its first time is the time of x_0."""

    means: Float[Array, "t d"]
    """E[x_s | y_1..y_t] for s = 0, ..., t."""
    covariances: Float[Array, "t d d"]
    """Cov[x_s | y_1..y_t] for s = 0, ..., t."""
    log_marginal_likelihood: Float[Array, ""]


@checked
def kalman_filter(model: LinearGaussianModel, observations: PyTree) -> KalmanFilterRun:
    """The Kalman filter (Kalman 1960), with the library's convention: y_1 follows x_1, not x_0.

    Covariances are factors U diag(D) Uᵀ, and no variance is a difference: in float32 log Z is
    accurate to 0.05 up to a diffuse prior of P_0 / R = 1e13. Differentiable, and `jax.vmap` maps it
    over several series.

    - `observations`: an array (t, p), or a `Series` of one, whose inputs are those of the model:
      controls, or matrices that vary in time. `Series.skipping` omits each number that is NaN: of
      two sensors, the one that is present is used. (A particle filter omits the whole step, unless
      its model has `handles_missing`.) Otherwise a NaN is a `ValueError`, as far as the numbers are
      known.

    Raises `ValueError` for another model and observations that are not (t, p). Use it as the
    reference for a linear Gaussian model.
    """
    filtered, increments = _kalman_filter(model, *_checked(model, observations))
    return KalmanFilterRun(*filtered, increments, jnp.sum(increments))


@checked
def kalman_smoother(model: LinearGaussianModel, observations: PyTree) -> KalmanSmootherRun:
    """E and Cov of x_0, ..., x_t given y_1..y_t, by the recursion of Rauch, Tung and Striebel 1965.

    After the Kalman filter it proceeds backward from x_t. With (m, P) the filter's moments at s,
    and (m', P') the smoothed ones at s + 1,

        G = P Aᵀ (A P Aᵀ + Q)⁻¹,   mean m + G (m' - A m),   covariance C + G P' Gᵀ,

    where C is Cov[x_s | x_{s+1}, y_1..y_s]. Precision, derivatives, arguments and errors are those
    of `kalman_filter`. Use it as the reference for particle smoothers of a linear Gaussian model.
    """
    return _smooth(model, *_checked(model, observations))


def _checked(model: Any, data: PyTree) -> tuple[Any, PyTree]:
    series = series_of(data)
    rows = checked_rows(series, model.H.shape[0], model.m0.dtype)
    return rows, steps_of_inputs(series.inputs, rows.shape[0], model)


def checked_rows(series: Series, num_rows: int, dtype: jnp.dtype) -> Any:
    """y_1..y_t as an array of this type, NaN where missing; a `ValueError` for what is none."""
    check_differences("observations", series.observations)
    rows = as_numbers("observations", series.observations, floating=True)
    if rows.ndim != 2 or rows.shape[1] != num_rows:
        raise ValueError(f"observations: shape {rows.shape} is not (t, {num_rows})")
    present = present_steps(rows, series, "infinite" if series.skips_missing else NOT_FINITE)
    # In numpy as far as it is known: to JAX with `jax_debug_nans` an array with a NaN is an error.
    return with_gaps(numpy_for(rows, present).asarray(rows, dtype), present)


@eqx.filter_jit
def _kalman_filter(constant, observations, inputs):
    """Means and covariances of x_1, ..., x_t, and the increments."""
    laws, increments = filtered(*_initial_law_and_steps(constant), inputs, observations)
    return laws.moments, increments


@eqx.filter_jit
def _smooth(constant, observations, inputs):
    start, step_of = _initial_law_and_steps(constant)
    laws, increments = filtered(start, step_of, inputs, observations)
    moments = smoothed(start, laws, step_of, inputs)
    return KalmanSmootherRun(*moments, jnp.sum(increments))


def _initial_law_and_steps(constant: LinearGaussianModel) -> tuple["Law", StepOf]:
    """The law of x_0, and the matrices of a step by its inputs."""

    def step_of(now: PyTree) -> LinearStep:
        model = with_inputs(constant, now)
        nothing = jnp.zeros(model.H.shape[0], model.m0.dtype)
        b = jnp.zeros_like(model.m0) if model.control is None else model.control
        return LinearStep(model.A, b, model.Q, model.H, nothing, model.R)

    return Law.of(constant.m0, constant.P0), step_of


class Law(NamedTuple):
    """N(mean, U diag(D) Uᵀ), with U upper triangular and ones on its diagonal, D >= 0."""

    mean: Float[Array, "*t d"]
    unit: Float[Array, "*t d d"]
    variances: Float[Array, "*t d"]

    @classmethod
    def of(cls, mean: Float[Array, " d"], covariance: Float[Array, "d d"]) -> "Law":
        """From a covariance, positive semidefinite."""
        return cls(mean, *_factors(covariance))

    @property
    def moments(self) -> Moments:
        """Mean and covariance."""
        return self.mean, _covariance(self.unit, self.variances)


def _covariance(rows: Float[Array, "*t n k"], variances: Float[Array, "*t k"]) -> Array:
    """A diag(D) Aᵀ, a sum of terms none of which is negative on the diagonal."""
    return jnp.einsum("...ik,...k,...jk->...ij", rows, variances, rows)


def _factors(covariance: Float[Array, "d d"]) -> tuple[Float[Array, "d d"], Float[Array, " d"]]:
    """U and D of a covariance; a variance that only rounding leaves is zero."""
    d = covariance.shape[0]
    least = 4 * d * jnp.finfo(covariance.dtype).eps * jnp.diagonal(covariance)

    def eliminate(rest: Array, j: Array) -> tuple[Array, tuple[Array, Array]]:
        variance = jnp.where(rest[j, j] > least[j], rest[j, j], 0.0)
        column = _above(j, _without_zero(rest[:, j], variance))
        return rest - variance * jnp.outer(column, column), (column, variance)

    _, (columns, variances) = jax.lax.scan(eliminate, covariance, jnp.arange(d), reverse=True)
    return columns.T + jnp.eye(d, dtype=covariance.dtype), variances


def _without_zero(numbers: Array, divisor: Float[Array, ""]) -> Array:
    """Their ratio, 0 where the divisor is."""
    is_zero = divisor == 0
    return jnp.where(is_zero, 0.0, numbers / jnp.where(is_zero, 1.0, divisor))


def _above(j: Array, column: Float[Array, " n"]) -> Float[Array, " n"]:
    """The entries above row j, and zeros."""
    return jnp.where(jnp.arange(column.shape[0]) < j, column, 0.0)


class Regression(NamedTuple):
    """Rows z on the last m of them: z = (what is left, 0) + unit e, e ~ N(0, diag(variances))."""

    left: Float[Array, "rest k"]
    unit: Float[Array, "n m"]
    variances: Float[Array, " m"]


def _regression(rows: Float[Array, "n k"], noise: Float[Array, " k"], on: int) -> Regression:
    """Of z = A w, w ~ N(0, diag(noise)), on the last rows, as many as `on`.

    By the modified Gram-Schmidt method with weights (Thornton and Bierman 1978), from the last row
    upward: no variance is a difference. Each row is taken off twice, and what rounding alone leaves
    of an entry counts as zero, so that a small noise is not lost beside a large one.
    """
    n, eps = rows.shape[0], jnp.finfo(rows.dtype).eps

    def eliminate(carry: tuple[Array, Array], j: Array) -> tuple[Any, Any]:
        (rows, sizes), row = carry, carry[0][j]
        weighted = noise * row
        variance = jnp.sum(weighted * row)

        def column(rows: Array) -> Array:
            return _above(j, _without_zero(rows @ weighted, variance))

        share = column(rows)
        rest = rows - jnp.outer(share, row)
        sizes = jnp.maximum(sizes, jnp.abs(jnp.outer(share, row)))
        remains = column(rest)
        rest = rest - jnp.outer(remains, row)
        rounding = jnp.where(jnp.abs(rest) <= 4 * eps * sizes, rest, 0.0)
        # Its derivative stays.
        rest = rest - jax.lax.stop_gradient(rounding)
        return (rest, sizes), (share + remains, variance)

    first, carry = n - on, (rows, jnp.abs(rows))
    (rows, _), (columns, variances) = jax.lax.scan(
        eliminate, carry, jnp.arange(first, n), reverse=True
    )
    unit = columns.T + jnp.eye(n, on, -first, dtype=rows.dtype)
    return Regression(rows[:first], unit, variances)


def filtered(
    start: Law, step_of: StepOf, step_data: PyTree, observations: Float[Array, "t p"]
) -> tuple[Law, Float[Array, " t"]]:
    """The laws of x_1, ..., x_t, and the increments; a NaN is a missing number.

    `step_of` makes the matrices of each step from its part of `step_data`, of leading axis t.
    (x_t, y_t) is a matrix times independent noises, those of x_{t-1}, of the dynamics and of y_t.
    """

    def advance(law: Law, of_step: tuple[Array, PyTree]) -> tuple[Law, Any]:
        observation, now = of_step
        step, d = step_of(now), law.mean.shape[0]
        is_present = ~jnp.isnan(observation)
        # A missing number becomes one with H = 0, variance one and no error.
        H = jnp.where(is_present[:, None], step.H, 0.0)
        both = is_present[:, None] & is_present[None]
        R = jnp.where(both, step.R, jnp.eye(*step.R.shape, dtype=H.dtype))
        mean = step.F @ law.mean + step.b
        innovation = jnp.where(is_present, observation - step.c, 0.0) - H @ mean
        units, variances = _factors(jax.scipy.linalg.block_diag(step.Q, R))
        moved = jnp.concatenate([step.F @ law.unit, units[:d]], axis=1)
        of_observation = jnp.pad(units[d:], ((0, 0), (d, 0)))
        rows = jnp.concatenate([moved, H @ moved + of_observation])
        noise = jnp.concatenate([law.variances, variances])
        _, unit, variances = _regression(rows, noise, rows.shape[0])
        errors, spread = _solve_unit(unit[d:, d:], innovation), variances[d:]
        increment = -0.5 * jnp.sum(errors**2 / spread + jnp.log(spread))
        increment -= 0.5 * jnp.sum(is_present).astype(H.dtype) * jnp.log(2 * jnp.pi)
        law = Law(mean + unit[:d, d:] @ errors, unit[:d, :d], variances[:d])
        return law, (law, increment)

    return jax.lax.scan(advance, start, (observations, step_data))[1]


def _solve_unit(unit: Float[Array, "m m"], right: Float[Array, "m ..."]) -> Float[Array, "m ..."]:
    """U⁻¹ b."""
    return jax.scipy.linalg.solve_triangular(unit, right, unit_diagonal=True)


def smoothed(start: Law, laws: Law, step_of: StepOf, step_data: PyTree) -> Moments:
    """The moments of x_0, ..., x_t given y_1..y_t; `laws` are filtered.

    (x_s, x_{s+1}) is a matrix times the noises of x_s and of the dynamics.
    """
    d = start.mean.shape[0]

    def back(later: Moments, earlier: tuple[Law, PyTree]) -> tuple[Moments, Moments]:
        (later_mean, later_covariance), (law, now) = later, earlier
        step = step_of(now)
        units, variances = _factors(step.Q)
        rows = jnp.block([[law.unit, jnp.zeros_like(units)], [step.F @ law.unit, units]])
        noise = jnp.concatenate([law.variances, variances])
        left, unit, _ = _regression(rows, noise, d)
        gain = unit[:d] @ _solve_unit(unit[d:], jnp.eye(d, dtype=unit.dtype))
        mean = law.mean + gain @ (later_mean - (step.F @ law.mean + step.b))
        covariance = _covariance(left, noise) + gain @ later_covariance @ gain.T
        return (mean, covariance), (mean, covariance)

    last = jax.tree.map(lambda rows: rows[-1], laws.moments)
    earlier = jax.tree.map(lambda row, rows: jnp.concatenate([row[None], rows[:-1]]), start, laws)
    _, before = jax.lax.scan(back, last, (earlier, step_data), reverse=True)
    return jax.tree.map(lambda rows, row: jnp.concatenate([rows, row[None]]), before, last)
