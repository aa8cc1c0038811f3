"""Gaussians: densities, and the Kalman filter's arithmetic for many particles at once.

There means are (d, n), matrices (d, e, n). With the particles last, every operation runs on
vectors; in stacks (n, d, e) nothing does, and LAPACK is called once for each. A last axis of length
1 is what all particles share.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mpfjax.operations.matrices import coordinates, total, transform
from mpfjax.operations.stored import stored

Squares = Float[Array, "d d #n"]
# The least variance, in units of the rounding error of the numbers it was computed from.
_ROUNDINGS = 4


def particles_last(values: Float[Array, "..."], rank: int) -> Float[Array, "... n"]:
    """(n, ...) or, without a leading n, (...) of this rank, as (..., n) or (..., 1)."""
    return values[..., None] if values.ndim == rank else jnp.moveaxis(values, 0, -1)


def particles_first(values: Float[Array, "... k"], num_particles: int) -> Float[Array, "n ..."]:
    """(..., n) as (n, ...); arrays (..., 1) that all particles share are repeated."""
    if values.shape[-1] == 1:
        # Or each copy would be computed anew.
        shared = stored(values[..., 0])
        return jnp.broadcast_to(shared[None], (num_particles, *shared.shape))
    return jnp.moveaxis(values, -1, 0)


def product(left: Float[Array, "d k #n"], right: Float[Array, "k e #n"]) -> Float[Array, "d e n"]:
    """A B."""
    total = left[:, 0, None] * right[None, 0]
    for k in range(1, left.shape[1]):
        total = total + left[:, k, None] * right[None, k]
    return total


def apply(matrix: Float[Array, "d k #n"], vector: Float[Array, "k #n"]) -> Float[Array, "d n"]:
    """A v."""
    return product(matrix, vector[:, None])[:, 0]


def transpose(matrix: Float[Array, "d e n"]) -> Float[Array, "e d n"]:
    """Aᵀ."""
    return jnp.swapaxes(matrix, 0, 1)


def symmetric(matrix: Float[Array, "d d n"]) -> Float[Array, "d d n"]:
    """(A + Aᵀ) / 2."""
    return 0.5 * (matrix + transpose(matrix))


def sandwich(
    matrix: Float[Array, "d k #n"], covariance: Float[Array, "k k #n"]
) -> Float[Array, "d d n"]:
    """A P Aᵀ, symmetric to the bit."""
    return symmetric(product(product(matrix, covariance), transpose(matrix)))


def cholesky(matrix: Squares, floor: bool = False) -> Float[Array, "d d n"]:
    """The lower triangular L with L Lᵀ = A, for positive semidefinite A.

    A direction without variance, but for rounding, gets a column of zeros; with `floor` the root of
    the rounding on the diagonal, so that L can be divided by.
    """
    factor, variances = without_correlations(matrix)
    eps, tiny = jnp.finfo(matrix.dtype).eps, jnp.finfo(matrix.dtype).tiny
    diagonal = jnp.stack([jnp.abs(row[j]) for j, row in enumerate(matrix)])
    least = _ROUNDINGS * len(diagonal) * eps * diagonal + tiny
    # Chosen before the root, which has no derivative at zero.
    roots = jnp.sqrt(jnp.where(variances > 0, variances, least))
    return factor * (roots if floor else jnp.where(variances > 0, roots, 0.0))[None]


def solve_lower(factor: Squares, right: Float[Array, "d e #n"]) -> Float[Array, "d e n"]:
    """L⁻¹ B, by forward substitution."""
    rows: list[Array] = []
    for i in range(factor.shape[0]):
        rest = right[i]
        for k in range(i):
            rest = rest - factor[i, k][None] * rows[k]
        rows.append(rest / factor[i, i][None])
    return jnp.stack(rows)


def solve_upper(factor: Squares, right: Float[Array, "d e #n"]) -> Float[Array, "d e n"]:
    """L⁻ᵀ B of the lower triangular L, by backward substitution."""
    # Mirrored, the upper triangle is a lower one.
    return solve_lower(transpose(factor)[::-1, ::-1], right[::-1])[::-1]


def without_correlations(matrix: Squares) -> tuple[Float[Array, "d d n"], Float[Array, "d n"]]:
    """L with ones on its diagonal, and D >= 0, with L diag(D) Lᵀ = A, positive semidefinite.

    An entry of D that is zero, but for rounding, gets a column of L without any other entry.
    """
    d = matrix.shape[0]
    least = _ROUNDINGS * d * jnp.finfo(matrix.dtype).eps
    one, zero = jnp.ones_like(matrix[0, 0]), jnp.zeros_like(matrix[0, 0])
    rows: list[list[Array]] = [[zero] * d for _ in range(d)]
    variances: list[Array] = []
    for j in range(d):
        rest = matrix[j, j]
        for k in range(j):
            rest = rest - rows[j][k] ** 2 * variances[k]
        is_positive = rest > least * matrix[j, j] if j else rest > 0
        variances.append(jnp.where(is_positive, rest, 0.0))
        rows[j][j] = one
        for i in range(j + 1, d):
            entry = matrix[i, j]
            for k in range(j):
                entry = entry - rows[i][k] * rows[j][k] * variances[k]
            rows[i][j] = jnp.where(is_positive, entry / jnp.where(is_positive, rest, 1.0), 0.0)
    return jnp.stack([jnp.stack(row) for row in rows]), jnp.stack(variances)


def log_normal(
    residuals: Float[Array, "*shape"], deviations: Float[Array, "..."] | float
) -> Float[Array, "*shape"]:
    """log N(r; 0, σ²) of each number."""
    return -0.5 * (residuals / deviations) ** 2 - jnp.log(deviations) - 0.5 * jnp.log(2 * jnp.pi)


def log_multinormal(
    residuals: Float[Array, "n d"], covariance: Float[Array, "d d"]
) -> Float[Array, " n"]:
    """log N(r; 0, Σ) of each row, with one small solve whatever the number of rows."""
    factor = jnp.linalg.cholesky(covariance)
    identity = jnp.eye(len(factor), dtype=factor.dtype)
    whitening = jax.scipy.linalg.solve_triangular(factor, identity, lower=True)
    log_volume = jnp.sum(jnp.log(jnp.diagonal(factor)))
    # Written out, it is one loop also where many observations are compared with many states.
    whitened = transform(whitening, coordinates(residuals), is_lower=True)
    return total([log_normal(column, 1.0) for column in whitened]) - log_volume


class Gaussian(NamedTuple):
    """N(mean, covariance) of each particle."""

    mean: Float[Array, "d n"]
    covariance: Float[Array, "d d n"]


class Linear(NamedTuple):
    """A x + b + N(0, noise): a step of linear dynamics, or an observation of x."""

    matrix: Float[Array, "e d n"]
    offset: Float[Array, "e n"]
    noise: Float[Array, "e e n"]

    @classmethod
    def of(cls, matrix: Array, offset: Array, noise: Array) -> "Linear":
        """From arrays with the particles first, or one for all of them."""
        return cls(particles_last(matrix, 2), particles_last(offset, 1), particles_last(noise, 2))


def predict(state: Gaussian, dynamics: Linear) -> Gaussian:
    """The law of F x + b + N(0, Q)."""
    matrix, offset, noise = stored(dynamics.matrix), dynamics.offset, dynamics.noise
    covariance = sandwich(matrix, state.covariance) + noise
    return Gaussian(apply(matrix, state.mean) + offset, stored(covariance))


def through(dynamics: Linear, emission: Linear) -> Linear:
    """y of F x + b + N(0, Q) as an observation of x: H F x + H b + c + N(0, H Q Hᵀ + R)."""
    matrix, offset, noise = dynamics
    return Linear(
        product(emission.matrix, matrix),
        apply(emission.matrix, offset) + emission.offset,
        sandwich(emission.matrix, noise) + emission.noise,
    )


def decorrelate(
    dynamics: Linear, mixed: Linear, shared: Float[Array, "d k n"] | None, latent: Array
) -> Linear:
    """The dynamics of x given z_t, where their noises are correlated: v is z_t - f - A x."""
    if shared is None:
        return dynamics
    factor = cholesky(mixed.noise, floor=True)
    half = solve_lower(factor, transpose(shared))
    slope = transpose(solve_upper(factor, half))
    return Linear(
        dynamics.matrix - product(slope, mixed.matrix),
        dynamics.offset + apply(slope, latent - mixed.offset),
        dynamics.noise - product(transpose(half), half),
    )


def update(
    state: Gaussian, observation: Float[Array, "p #n"], emission: Linear
) -> tuple[Gaussian, Float[Array, " n"]]:
    """The law of x given y = H x + c + N(0, R), and log p(y), of each particle.

    R = L D Lᵀ takes the correlations out, and the entries of L⁻¹ y come in one after the other:
    R may be singular, and no sum of a large variance and a small R has to hold both. The covariance
    is in Joseph's form, (I - K h) P (I - K h)ᵀ + r K Kᵀ, where rounding of the gain K counts in the
    second order only; for one entry it takes O(d²). An entry of y that is NaN is missing.
    """
    observation, emission, present = without_missing(observation, emission)
    law, log_density = update_by_all(state, observation, emission)
    missing = jnp.sum((~present).astype(log_density.dtype), axis=0)
    return law, log_density + 0.5 * math.log(2 * math.pi) * missing


def update_by_all(
    state: Gaussian, observation: Float[Array, "p #n"], emission: Linear
) -> tuple[Gaussian, Float[Array, " n"]]:
    """`update` for a y without missing entries: what all particles share stays shared."""
    factor, variances = without_correlations(emission.noise)
    rows = solve_lower(factor, emission.matrix)
    targets = stored(solve_lower(factor, (observation - emission.offset)[:, None])[:, 0])
    log_density = jnp.asarray(-0.5 * math.log(2 * math.pi) * len(rows), rows.dtype)
    for row, target, variance in zip(rows, targets, variances, strict=True):
        state, log_factor = _update_by_one(state, row, target, variance)
        log_density = log_density + log_factor
    return state, log_density


def _update_by_one(
    state: Gaussian, row: Float[Array, "d #n"], target: Float[Array, " #n"], variance: Array
) -> tuple[Gaussian, Float[Array, " n"]]:
    """The law of x given one number, y = h x + N(0, r), and log p(y) without the factor 2 pi."""
    mean, covariance = state
    cross = stored(apply(covariance, row))
    signal = apply(row[None], cross)[0]
    # Rounding may leave a zero variance slightly negative.
    spread = jnp.maximum(signal, 0.0) + variance
    has_spread = spread > 0
    spread = jnp.where(has_spread, spread, jnp.finfo(mean.dtype).tiny)
    precision, log_spread = _once(1 / spread), _once(jnp.log(spread))
    innovation = target - apply(row[None], mean)[0]
    gain = stored(jnp.where(has_spread, precision, 0.0)[None] * cross)
    left = covariance - gain[:, None] * cross[None]
    both = left - apply(left, row)[:, None] * gain[None]
    both = both + variance[None, None] * gain[:, None] * gain[None]
    log_density = -0.5 * (precision * innovation**2 + log_spread)
    return Gaussian(mean + gain * innovation[None], symmetric(both)), log_density


def _once(values: Float[Array, "*rest n"]) -> Float[Array, "*rest n"]:
    """The values, `stored` if all particles share them, each of which would compute them anew."""
    return stored(values) if values.shape[-1] == 1 else values


def without_missing(
    observation: Float[Array, "p #n"], emission: Linear
) -> tuple[Float[Array, "p #n"], Linear, Bool[Array, "p #n"]]:
    """The observation with 0, and its model with variance 1, for each entry that is NaN."""
    present = ~jnp.isnan(observation)
    here = present.astype(emission.matrix.dtype)
    both = present[:, None] & present[None]
    alone = jnp.eye(len(here), dtype=here.dtype)[:, :, None]
    clear = Linear(
        jnp.where(present[:, None], emission.matrix, 0.0),
        jnp.where(present, emission.offset, 0.0),
        jnp.where(both, emission.noise, alone * (1 - here[None])),
    )
    return jnp.where(present, observation, 0.0), clear, present
