"""Standard errors from the curvature of the log marginal likelihood."""

import warnings
from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Key, PyTree

from mpfjax.filters import Filter
from mpfjax.tuning.problem import Parameters, Problem, Reals, pose_evidence, scores
from mpfjax.tuning.transforms import AbstractTransform

_MOST_NUMBERS = 50
_FIRST_STEP = 0.05


def standard_errors(
    key: Key[Array, ""],
    filter: Filter,
    observations: PyTree,
    *,
    parameters: Parameters = None,
    transforms: Mapping[str, AbstractTransform] | None = None,
    num_seeds: int = 100,
    missing: str = "error",
) -> dict[str, np.ndarray] | None:
    """Standard errors of a filter's parameters where they maximise the likelihood.

    The roots of the diagonal of J I⁻¹ Jᵀ: I is the observed information, by central differences
    of the mean score over about one standard error to each side, with the same seeds on both, in
    unconstrained numbers, and J their Jacobian (the delta method). The scores must be unbiased:
    build the filter with `gradient="stop"`. Costs four gradients of `num_seeds` runs a number.

    Arguments are those of `fit`. None, with a warning, where I is not positive definite: away
    from a maximum, along a direction that nothing tells, or with too few seeds. Raises
    `ValueError` for what `fit` does, fewer than one seed, and more than fifty numbers.
    """
    if num_seeds < 1:
        raise ValueError(f"num_seeds: {num_seeds} is less than 1")
    problem = pose_evidence(filter, observations, parameters, transforms, missing)
    return errors_at(problem, problem.start(), [jax.random.split(key, num_seeds)])


def errors_at(
    problem: Problem, reals: Reals, batches: list[Key[Array, " seeds"]]
) -> dict[str, np.ndarray] | None:
    """The standard errors at a point, from scores with all batches of seeds."""
    point, unravel = ravel_pytree(reals)
    if point.size > _MOST_NUMBERS:
        raise ValueError(
            f"parameters: {point.size} numbers are too many for a curvature by differences,"
            f" which is for at most {_MOST_NUMBERS}"
        )

    def score(flat: np.ndarray) -> np.ndarray:
        at = unravel(jnp.asarray(flat, point.dtype))
        gradients = [ravel_pytree(scores(problem, at, keys)[1])[0] for keys in batches]
        return np.mean([np.asarray(g, float) for g in gradients], axis=0)

    centre = np.asarray(point)
    steps = np.full(centre.shape, _FIRST_STEP)
    for _ in range(2):
        information = _differences(score, centre, steps)
        steep = np.maximum(np.diagonal(information), 0.0)
        # As far as the likelihood tells the points apart: where the noise matters least.
        steps = np.where(steep > 0, 1 / np.sqrt(np.where(steep > 0, steep, 1.0)), steps)
        steps = np.clip(steps, 1e-3, 0.5)
    if not np.isfinite(information).all() or np.linalg.eigvalsh(information)[0] <= 0:
        warnings.warn(
            "standard_errors: the log marginal likelihood has no maximum here, or too few seeds"
            " to see it",
            stacklevel=2,
        )
        return None
    covariance = np.linalg.inv(information)
    return _on_their_own_scale(problem, reals, covariance)


def _differences(score, centre: np.ndarray, steps: np.ndarray) -> Float[np.ndarray, "d d"]:
    columns = []
    for axis, step in enumerate(steps):
        offset = np.zeros_like(centre)
        offset[axis] = step
        columns.append((score(centre - offset) - score(centre + offset)) / (2 * step))
    matrix = np.stack(columns, axis=1)
    return (matrix + matrix.T) / 2


def _on_their_own_scale(
    problem: Problem, reals: Reals, covariance: Float[np.ndarray, "d d"]
) -> dict[str, np.ndarray]:
    errors, first = {}, 0
    # In the order in which `ravel_pytree` lays a dictionary out.
    for name in sorted(reals):
        size = reals[name].size
        block = covariance[first : first + size, first : first + size]
        jacobian = np.asarray(jax.jacfwd(problem.transforms[name].constrain)(reals[name]))
        value_shape = jacobian.shape[: jacobian.ndim - reals[name].ndim]
        jacobian = jacobian.reshape(-1, size)
        variances = np.einsum("ij,jk,ik->i", jacobian, block, jacobian)
        errors[name] = np.sqrt(variances).reshape(value_shape)
        first += size
    return errors
