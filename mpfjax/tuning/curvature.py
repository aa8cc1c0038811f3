"""Standard errors from the curvature of the log marginal likelihood."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Key, PyTree

from mpfjax.checks import Count, checked, warn
from mpfjax.filter import Filter
from mpfjax.tuning.bijections import Unconstrained
from mpfjax.tuning.evidence import Score, pose_evidence, warn_of_bias
from mpfjax.tuning.problem import Parameters, Transforms, scores

_MOST_NUMBERS = 50
# Seeds whose Ẑ are averaged, as in `fit`.
_BATCH = 10
# Of a step, in standard errors, and the range of its square that is near enough. At one standard
# error the noise is larger beside the difference, at two a parabola fits too few models.
_DISTANCE = 1.5
_NEAR = (0.4 * _DISTANCE**2, 2.5 * _DISTANCE**2)
_MOST_ROUNDS = 10
_FURTHEST_ROUND = 16.0
# In units in the last place of a parameter: a shorter step is mostly rounding.
_FEWEST_PLACES = 256
# Logarithms and logits have no unit, and a parabola fits up to about one half.
_LONGEST = 0.5
_MOST_UNCERTAIN = 0.125


@checked
def standard_errors(
    key: Key[Array, ""],
    filter: Filter,
    observations: PyTree,
    *,
    parameters: Parameters = None,
    transforms: Transforms = None,
    num_seeds: Count = 100,
    score: Score = "filter",
) -> dict[str, np.ndarray] | None:
    """Standard errors of a filter's parameters at the maximum of the likelihood.

    They are the roots of the diagonal of J I⁻¹ Jᵀ (the delta method). I is the observed information
    in unconstrained coordinates, and J the Jacobian of the parameters. I is computed by central
    differences of the score, with the same seeds on both sides, one and a half standard errors
    away. The score is that of `fit`, with ten seeds at a time, since the mean score of single seeds
    has a bias that makes the errors too small. A few tries determine the distance, starting from
    the size of the score, so the parameters may have any units. Build the filter with
    `gradient="stop"`, or use `score="fisher"`; otherwise there is a warning. The computation takes
    one gradient of `num_seeds` runs, rounded up to whole tens, and for each try two for each
    coordinate; usually two tries, at most ten.

    The arguments are those of `fit`. Noise in I makes the errors too large rather than too small. A
    warning is issued if there are too few seeds: if the standard error of one of the errors is more
    than an eighth of it, by the delta method from the contribution of every ten seeds to I.

    Returns None, with a warning, if I is not positive definite: away from a maximum, along a
    direction that the data do not determine, or with too few seeds. Raises `ValueError` as `fit`
    does, and for fewer than one seed, and more than fifty coordinates.
    """
    problem = pose_evidence(filter, observations, parameters, transforms, score)
    warn_of_bias("standard_errors", problem)
    size = min(num_seeds, _BATCH)
    batches = jax.random.split(key, (-(-num_seeds // size), size))
    reals = problem.start()
    point, unravel = ravel_pytree(reals)
    if point.size > _MOST_NUMBERS:
        raise ValueError(f"parameters: {point.size} numbers; differences do for {_MOST_NUMBERS}")

    def score_at(flat: np.ndarray) -> Float[np.ndarray, "batches d"]:
        at = unravel(jnp.asarray(flat))
        gradients = [scores(keys, problem, at, pooled=True)[1] for keys in batches]
        return np.stack([np.asarray(ravel_pytree(each)[0], float) for each in gradients])

    # By number, how far a step may go.
    longest = np.concatenate([
        np.full(reals[name].size, np.inf if isinstance(transform, Unconstrained) else _LONGEST)
        for name, transform in sorted(problem.transforms.items())
    ])  # fmt: skip
    informations = _informations(score_at, np.asarray(point), longest)
    covariance = _inverse(informations.mean(axis=0))
    if covariance is None:
        what = "the log marginal likelihood has no maximum here, or too few seeds to see it"
        warn(f"standard_errors: {what}", UserWarning)
        return None
    _warn_of_noise(informations, covariance)
    # By the Jacobian of the parameters on their own scale, laid out in the same order.
    _, shaped = ravel_pytree(problem.constrain(reals))
    slope = jax.jacfwd(lambda flat: ravel_pytree(problem.constrain(unravel(flat)))[0])
    jacobian = np.asarray(slope(point), float)
    variances = np.einsum("ij,jk,ik->i", jacobian, covariance, jacobian)
    return jax.tree.map(np.asarray, shaped(jnp.asarray(np.sqrt(variances), point.dtype)))


def _informations(
    score: Callable[[np.ndarray], np.ndarray], centre: np.ndarray, longest: np.ndarray
) -> Float[np.ndarray, "batches d d"]:
    """The observed information, as each batch of seeds has it; NaN where there is none."""
    # In any units, a score is about as large as one over a standard error, if only by the noise of
    # its seeds.
    sizes = np.sqrt(np.mean(score(centre) ** 2, axis=0))
    shortest = _FEWEST_PLACES * np.asarray(np.spacing(np.abs(centre)), float)

    def column(axis: int) -> Float[np.ndarray, "batches d"]:
        """A column for every batch of seeds, by differences over `_DISTANCE` standard errors.

        So far the likelihood tells the points apart, and the noise matters least.
        """
        size, least, most = sizes[axis], shortest[axis], longest[axis]
        step = float(np.clip(_DISTANCE / size if 0 < size < np.inf else 1.0, least, most))
        for _ in range(_MOST_ROUNDS):
            below, above = centre.copy(), centre.copy()
            below[axis] -= step
            above[axis] += step
            # Over the actual distance of the two points, after rounding.
            slopes = (score(below) - score(above)) / (float(above[axis]) - float(below[axis]))
            # Twice the loss of a step in nats, for a parabola.
            loss = abs(slopes[:, axis].mean()) * step**2
            if not np.isfinite(slopes).all():
                # Outside the model's domain.
                most, following = step / 2, step / 8
            elif _NEAR[0] <= loss <= _NEAR[1]:
                break
            else:
                factor = _FURTHEST_ROUND if loss == 0 else _DISTANCE / np.sqrt(loss)
                following = step * np.clip(factor, 1 / _FURTHEST_ROUND, _FURTHEST_ROUND)
            following = float(np.clip(following, least, max(least, most)))
            if following == step:
                break
            step = following
        return slopes

    matrices = np.stack([column(axis) for axis in range(len(sizes))], axis=2)
    return (matrices + matrices.transpose(0, 2, 1)) / 2


def _inverse(information: Float[np.ndarray, "d d"]) -> Float[np.ndarray, "d d"] | None:
    """The inverse, or None for a matrix that is not positive definite, in whatever units."""
    steep = np.diagonal(information)
    if not np.isfinite(information).all() or (steep <= 0).any():
        return None
    scale = 1 / np.sqrt(steep)
    scales = np.outer(scale, scale)
    relative = information * scales
    # At least the rounding error of a zero.
    if np.linalg.eigvalsh(relative)[0] <= 1e-12:
        return None
    return np.linalg.inv(relative) * scales


def _warn_of_noise(
    informations: Float[np.ndarray, "batches d d"], covariance: Float[np.ndarray, "d d"]
) -> None:
    """Warn where errors are uncertain: by the delta method, from what each batch adds to them."""
    num_batches, scale = len(informations), np.diagonal(covariance)
    uncertain, by = np.inf, ""
    if num_batches > 1:
        of_each = np.einsum("ij,bjk,ki->bi", covariance, informations, covariance) / scale
        uncertain = of_each.std(axis=0, ddof=1).max() / 2 / num_batches**0.5
        by = f" by {uncertain:.0%}"
    if uncertain > _MOST_UNCERTAIN:
        what = f"the seeds leave them uncertain{by}; raise num_seeds"
        warn(f"standard_errors: {what}", UserWarning)
