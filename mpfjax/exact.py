"""Exact references: a grid filter for scalar models, Kalman's filter and smoother for linear ones,
and all sequences of regimes for switching ones.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, PyTree

from mpfjax.checks import as_numbers, check_one_of, check_type, real_arrays
from mpfjax.models.base import require
from mpfjax.models.inputs import with_inputs
from mpfjax.models.linear_gaussian import LinearGaussianModel
from mpfjax.models.switching import SwitchingLinearGaussianModel
from mpfjax.observations import as_arrays, steps_of_inputs
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


def grid_filter(
    model: Any,
    observations: Float[Array, "t ..."],
    grid: Float[Array, " g"],
    log_initial: Float[Array, " g"] | None = None,
    *,
    state_shape: tuple[int, ...] = (),
    inputs: PyTree = None,
) -> GridFilterRun:
    """The recursion of Vermaak et al. (2003), eqs. 1 and 2, by quadrature on an even grid.

    - `model`: has `log_transition` and `log_likelihood`; its states are scalars of shape
      `state_shape`, () or (1,).
    - `grid`: evenly spaced points that cover all values that x_t can have, with several points in
      the smallest standard deviation of the model. The error then falls faster than any power of
      the spacing.
    - `log_initial`: log p(x_0) at the grid points; None calls the model's own `log_initial`.
    - `inputs`: u_1, ..., u_t, as for `run_filter`.

    Costs O(t g²). Differentiable in the model's parameters. Raises `ValueError` for a grid that
    is not one ascending row, or a model without these densities. Use it as the truth for a
    scalar model.
    """
    observations = jax.tree.map(jnp.asarray, as_arrays(observations))
    grid = real_arrays("...", grid=grid)
    if grid.ndim != 1 or grid.shape[0] < 2:
        raise ValueError(f"grid: shape {grid.shape} is not one row of at least two points")
    for density in ("log_transition", "log_likelihood"):
        require(model, density, "grid_filter")
    if log_initial is None:
        require(model, "log_initial", "grid_filter without log_initial")
    else:
        log_initial = real_arrays("g", log_initial=log_initial)
    length = jax.tree.leaves(observations)[0].shape[0]
    inputs = steps_of_inputs(inputs, length, model)
    return _grid_filter(model, observations, grid, log_initial, state_shape, inputs)


@eqx.filter_jit
def _grid_filter(model, observations, grid, log_initial, state_shape, inputs):
    num_points = grid.shape[0]
    states = grid.reshape(-1, *state_shape)
    log_prior = model.log_initial(states) if log_initial is None else log_initial
    log_cell = jnp.log(grid[1] - grid[0])

    def kernel_of(model: Any) -> Float[Array, "g g"]:
        def row(previous: Float[Array, "..."]) -> Float[Array, " g"]:
            copies = jnp.broadcast_to(previous, (num_points, *state_shape))
            return model.log_transition(states, copies)

        return jnp.exp(log_cell + jax.vmap(row)(states))

    shared = None if inputs is not None else kernel_of(model)

    def advance(
        probabilities: Float[Array, " g"], step: tuple[Float[Array, "..."], PyTree]
    ) -> tuple[Float[Array, " g"], tuple[Float[Array, " g"], Float[Array, ""]]]:
        observation, now = step
        given = with_inputs(model, now)
        predicted = probabilities @ (kernel_of(given) if shared is None else shared)
        positive = predicted > 0
        log_predicted = jnp.where(positive, jnp.log(jnp.where(positive, predicted, 1.0)), -jnp.inf)
        log_joint = log_predicted + given.log_likelihood(observation, states)
        increment = log_sum_exp(log_joint)
        updated = jnp.exp(log_joint - increment)
        return updated, (updated, increment)

    initial = jnp.exp(log_prior - log_sum_exp(log_prior))
    _, (probabilities, increments) = jax.lax.scan(advance, initial, (observations, inputs))
    return GridFilterRun(grid, probabilities, increments, jnp.sum(increments))


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


class SwitchingFilterRun(eqx.Module):
    """The filtering and the smoothing distribution of a switching model, with K regimes."""

    regime_probabilities: Float[Array, "t k"]
    """P(z_s | y_1..y_s)."""
    means: Float[Array, "t d"]
    """E[x_s | y_1..y_s]."""
    covariances: Float[Array, "t d d"]
    """Cov[x_s | y_1..y_s]."""
    smoothed_regime_probabilities: Float[Array, "t1 k"]
    """P(z_s | y_1..y_t), from s = 0 on."""
    smoothed_means: Float[Array, "t1 d"]
    """E[x_s | y_1..y_t], from s = 0 on."""
    smoothed_covariances: Float[Array, "t1 d d"]
    """Cov[x_s | y_1..y_t], from s = 0 on."""
    log_likelihood_increments: Float[Array, " t"]
    log_marginal_likelihood: Float[Array, ""]


_MOST_SEQUENCES = 2**20


def switching_filter(model: Any, observations: Float[Array, "t ..."]) -> SwitchingFilterRun:
    """All K^(t+1) sequences of regimes z_0, ..., z_t, and a Kalman smoother for each.

    `model` is a `SwitchingLinearGaussianModel`. The sum over sequences is the exact answer, and no
    recursion has one: the number of Gaussians grows K-fold with every step. An entry of the
    observations that is NaN is missing. Differentiable. Raises `ValueError` for another model, for
    observations that are not (t, p), and for more than a million sequences. Use it as the truth
    for a short series.
    """
    check_type(SwitchingLinearGaussianModel, "a SwitchingLinearGaussianModel", model=model)
    num_rows, k = model.H.shape[-2], model.num_regimes
    if observations.ndim != 2 or observations.shape[1] != num_rows:
        raise ValueError(f"observations: shape {observations.shape} is not (t, {num_rows})")
    length = observations.shape[0]
    if k ** (length + 1) > _MOST_SEQUENCES:
        raise ValueError(
            f"observations: {length} steps of {k} regimes are {k}^{length + 1} sequences, more than"
            f" {_MOST_SEQUENCES}"
        )
    return _enumerated(model, observations)


@eqx.filter_jit
def _enumerated(
    model: SwitchingLinearGaussianModel, observations: Float[Array, "t p"]
) -> SwitchingFilterRun:
    k, length = model.num_regimes, observations.shape[0]
    places = np.indices((k,) * (length + 1), np.int32).reshape(length + 1, -1).T
    sequences = jnp.asarray(places)
    log_prior = model.log_initial(sequences[:, 0])
    for s in range(length):
        log_prior = log_prior + model.log_transition(sequences[:, s + 1], sequences[:, s])
    given = jax.vmap(lambda sequence: _kalman_smoother(model, sequence, observations))(sequences)
    filtered, smoothed, log_densities = given
    log_weights = log_prior[:, None] + jnp.cumsum(log_densities, axis=1)
    log_evidence = jax.vmap(log_sum_exp)(log_weights.T)
    weights = jnp.exp(log_weights - log_evidence[None])
    is_regime = jax.nn.one_hot(sequences, k, dtype=weights.dtype)
    means, covariances = _mixed(weights, *filtered)
    final = jnp.broadcast_to(weights[:, -1:], (len(places), length + 1))
    smoothed_means, smoothed_covariances = _mixed(final, *smoothed)
    increments = jnp.diff(log_evidence, prepend=jnp.zeros(1, log_evidence.dtype))
    return SwitchingFilterRun(
        regime_probabilities=jnp.einsum("st,stk->tk", weights, is_regime[:, 1:]),
        means=means,
        covariances=covariances,
        smoothed_regime_probabilities=jnp.einsum("st,stk->tk", final, is_regime),
        smoothed_means=smoothed_means,
        smoothed_covariances=smoothed_covariances,
        log_likelihood_increments=increments,
        log_marginal_likelihood=log_evidence[-1],
    )


def _mixed(
    weights: Float[Array, "s t"], means: Float[Array, "s t d"], covariances: Float[Array, "s t d d"]
) -> tuple[Float[Array, "t d"], Float[Array, "t d d"]]:
    """The moments of a mixture of Gaussians at each time."""
    mean = jnp.einsum("st,std->td", weights, means)
    centred = means - mean[None]
    squares = covariances + centred[..., :, None] * centred[..., None, :]
    return mean, jnp.einsum("st,stde->tde", weights, squares)


def _kalman_smoother(
    model: SwitchingLinearGaussianModel, sequence: Array, observations: Float[Array, "t p"]
) -> tuple[tuple[Array, Array], tuple[Array, Array], Float[Array, " t"]]:
    """Filtered and smoothed moments, and log p(y_s | y_1..y_{s-1}), given the regimes."""
    d = model.m0.shape[-1]
    row = lambda part, shape: jnp.broadcast_to(part, (1, *shape))[0]  # noqa: E731
    mean, covariance = (
        row(part, shape)
        for part, shape in zip(model.initial_moments(sequence[:1]), ((d,), (d, d)), strict=True)
    )
    moments, expected, log_densities, matrices = [(mean, covariance)], [], [], []
    for s, observation in enumerate(observations):
        regime = sequence[s + 1 : s + 2]
        matrix, offset, noise = model.dynamics(regime, regime)
        matrix, offset, noise = row(matrix, (d, d)), row(offset, (d,)), row(noise, (d, d))
        mean, covariance = matrix @ mean + offset, matrix @ covariance @ matrix.T + noise
        matrices.append(matrix)
        expected.append((mean, covariance))
        p = observation.shape[0]
        seen, offset, noise = model.emission(regime)
        present = ~jnp.isnan(observation)
        here = present.astype(mean.dtype)
        seen = here[:, None] * row(seen, (p, d))
        missed = jnp.where(present, observation - seen @ mean - row(offset, (p,)), 0.0)
        alone = jnp.diag(1 - here)
        spread = (
            seen @ covariance @ seen.T + here[:, None] * here[None] * row(noise, (p, p)) + alone
        )
        gain = jnp.linalg.solve(spread, seen @ covariance).T
        log_densities.append(
            -0.5 * missed @ jnp.linalg.solve(spread, missed)
            - 0.5 * jnp.linalg.slogdet(spread)[1]
            - 0.5 * jnp.sum(here) * jnp.log(2 * jnp.pi)
        )
        mean = mean + gain @ missed
        covariance = covariance - gain @ spread @ gain.T
        moments.append((mean, covariance))
    smoothed = [(mean, covariance)]
    for s in reversed(range(len(observations))):
        (mean, covariance), (next_mean, next_covariance) = moments[s], smoothed[-1]
        back = jnp.linalg.solve(expected[s][1], matrices[s] @ covariance).T
        mean = mean + back @ (next_mean - expected[s][0])
        covariance = covariance + back @ (next_covariance - expected[s][1]) @ back.T
        smoothed.append((mean, covariance))
    return _stacked(moments[1:]), _stacked(smoothed[::-1]), jnp.stack(log_densities)


def _stacked(moments: list[tuple[Array, Array]]) -> tuple[Array, Array]:
    means, covariances = zip(*moments, strict=True)
    return jnp.stack(means), jnp.stack(covariances)
