"""The grid filter, for scalar models."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, PyTree

from mpfjax.arrays import real_array
from mpfjax.checks import shown
from mpfjax.models.base import require, with_inputs
from mpfjax.models.law import law_of, refuse_marginalised
from mpfjax.models.series import Series, as_series
from mpfjax.operations.logarithms import log_or_nothing, log_sum_exp, softmax


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
        middle = self.grid[len(self.grid) // 2]
        return middle + self.probabilities @ (self.grid - middle)

    @property
    def variances(self) -> Float[Array, " t"]:
        """Var[x_t | y_1..y_t]."""
        return jnp.sum(self.probabilities * (self.grid[None] - self.means[:, None]) ** 2, axis=1)

    def mass_above(self, threshold: float) -> Float[Array, " t"]:
        """P(x_t > threshold | y_1..y_t); the cell that contains the threshold counts in part."""
        cell = _width(self.grid)
        return self.probabilities @ jnp.clip((self.grid - threshold) / cell + 0.5, 0.0, 1.0)


def grid_filter(model: Any, observations: PyTree, grid: Float[Array, " g"]) -> GridFilterRun:
    """The recursion of Vermaak et al. (2003), eqs. 1 and 2, by quadrature on an even grid.

    - `model`: has `log_initial`, `log_transition` and `log_likelihood`; its states are scalars, or
      vectors of one number.
    - `grid`: evenly spaced points that cover all possible values of x_t, with several points per
      smallest standard deviation of the model. The error then decreases faster than any power of
      the spacing.
    - `observations`: arrays, or a `Series`.

    The computing time is O(t g²). Differentiable in the model's parameters. Raises `ValueError` for
    a grid that is not one row of evenly spaced, ascending numbers, a conditionally linear model or
    one without these densities, and for data as `run_filter` does. Use it as the reference for a
    scalar model.
    """
    points, width = _checked_grid(grid)
    for density in ("log_initial", "log_transition", "log_likelihood"):
        require(model, density, "grid_filter")
    refuse_marginalised(model, "grid_filter", "switching_filter takes one with regimes")
    series = as_series(observations, model)
    return _grid_filter(model, series, points, width)


def _width(grid: Any) -> Any:
    """The width of a cell, from both ends: that of two neighbours is mostly rounding."""
    if not isinstance(grid, Tracer):
        grid = np.asarray(grid, float)
    return (grid[-1] - grid[0]) / max(grid.shape[0] - 1, 1)


def _checked_grid(grid: Any) -> tuple[Float[Array, " g"], Any]:
    """The points and the width; a `ValueError` unless they ascend evenly, as far as is known."""
    points = real_array("points", "grid", grid)
    width = _width(grid)
    if not isinstance(points, Tracer):
        values = np.asarray(points)  # within a caller's jit, too
        even = float(values[0]) + width * np.arange(len(values))
        rounding = 4 * np.finfo(values.dtype).eps * np.abs(even).max()
        if not (width > rounding and np.abs(values - even).max() <= rounding):
            raise ValueError(f"grid: {shown(grid)} does not ascend in even steps")
    return points, width


@eqx.filter_jit
def _grid_filter(model, series, grid, width):
    one = jax.eval_shape(lambda key: model.sample_initial(key, 1), jax.random.key(0))
    states = grid.reshape(-1, *one.shape[1:])
    log_prior = law_of(model).log_initial(states)
    cell = jnp.asarray(width, grid.dtype)

    def kernel_of(model: Any) -> Float[Array, "g g"]:
        def row(previous: Float[Array, "..."]) -> Float[Array, " g"]:
            copies = jnp.broadcast_to(previous, states.shape)
            return law_of(model).log_transition(states, copies)

        return cell * jnp.exp(jax.vmap(row)(states))

    shared = None if series.inputs is not None else kernel_of(model)

    def advance(
        probabilities: Float[Array, " g"], now: Series
    ) -> tuple[Float[Array, " g"], tuple[Float[Array, " g"], Float[Array, ""]]]:
        model_now = with_inputs(model, now.inputs)
        kernel = kernel_of(model_now) if shared is None else shared
        predicted = jnp.matmul(probabilities, kernel, precision="highest")
        log_factors = law_of(model_now).log_likelihood(now.observations, states)
        is_present = True if now.present is None else now.present
        log_joint = log_or_nothing(predicted) + jnp.where(is_present, log_factors, 0.0)
        increment = jnp.where(is_present, log_sum_exp(log_joint), 0.0)
        posterior = softmax(log_joint)
        return posterior, (posterior, increment)

    _, (probabilities, increments) = jax.lax.scan(advance, softmax(log_prior), series)
    return GridFilterRun(grid, probabilities, increments, jnp.sum(increments))
