"""The grid filter, for scalar models."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from mpfjax.checks import real_arrays
from mpfjax.models.base import require
from mpfjax.models.inputs import saying_that_none_were_given, with_inputs
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

    Costs O(t g²). Differentiable in the model's parameters. Raises `ValueError` for a grid that is
    not one ascending row, or a model without these densities. Use it as the reference for a scalar
    model.
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
    with saying_that_none_were_given(model):
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
