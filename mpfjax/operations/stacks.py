"""Many small matrices side by side, (d, e, n), the particles last: products, factors, solutions.

In numpy: `A @ B`, `np.linalg.cholesky` and `np.linalg.solve` of stacks (n, d, e). With the
particles last, every operation runs on vectors; in stacks of small matrices nothing does, and
LAPACK is called once for each. A last axis of length 1 is a matrix that all particles share.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from mpfjax.operations.stored import stored

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


def applied(matrix: Float[Array, "d k #n"], vector: Float[Array, "k #n"]) -> Float[Array, "d n"]:
    """A v."""
    total = matrix[:, 0] * vector[None, 0]
    for k in range(1, matrix.shape[1]):
        total = total + matrix[:, k] * vector[None, k]
    return total


def transposed(matrix: Float[Array, "d e n"]) -> Float[Array, "e d n"]:
    """Aᵀ."""
    return jnp.swapaxes(matrix, 0, 1)


def symmetric(matrix: Float[Array, "d d n"]) -> Float[Array, "d d n"]:
    """(A + Aᵀ) / 2."""
    return 0.5 * (matrix + transposed(matrix))


def sandwiched(
    matrix: Float[Array, "d k #n"], covariance: Float[Array, "k k #n"]
) -> Float[Array, "d d n"]:
    """A P Aᵀ, symmetric to the bit."""
    return symmetric(product(product(matrix, covariance), transposed(matrix)))


def cholesky(matrix: Float[Array, "d d #n"], floor: bool = False) -> Float[Array, "d d n"]:
    """The lower triangular L with L Lᵀ = A, for positive semidefinite A.

    A direction without variance, but for rounding, gets a column of zeros; with `floor` the root of
    the rounding on the diagonal, so that L can be divided by.
    """
    d = matrix.shape[0]
    eps = jnp.finfo(matrix.dtype).eps
    tiny = jnp.finfo(matrix.dtype).tiny
    zero = jnp.zeros_like(matrix[0, 0])
    rows: list[list[Array]] = [[zero] * d for _ in range(d)]
    for j in range(d):
        rest = matrix[j, j]
        for k in range(j):
            rest = rest - rows[j][k] ** 2
        least = _ROUNDINGS * d * eps * jnp.abs(matrix[j, j]) + tiny
        is_positive = rest > least
        pivot = jnp.sqrt(jnp.where(is_positive, rest, least))
        rows[j][j] = pivot if floor else jnp.where(is_positive, pivot, 0.0)
        for i in range(j + 1, d):
            entry = matrix[i, j]
            for k in range(j):
                entry = entry - rows[i][k] * rows[j][k]
            rows[i][j] = entry / pivot if floor else jnp.where(is_positive, entry / pivot, 0.0)
    return jnp.stack([jnp.stack(row) for row in rows])


def solve_lower(
    factor: Float[Array, "d d #n"], right: Float[Array, "d e #n"]
) -> Float[Array, "d e n"]:
    """L⁻¹ B, by forward substitution."""
    rows: list[Array] = []
    for i in range(factor.shape[0]):
        rest = right[i]
        for k in range(i):
            rest = rest - factor[i, k][None] * rows[k]
        rows.append(rest / factor[i, i][None])
    return jnp.stack(rows)


def solve_upper(
    factor: Float[Array, "d d #n"], right: Float[Array, "d e #n"]
) -> Float[Array, "d e n"]:
    """L⁻ᵀ B of the lower triangular L, by backward substitution."""
    d = factor.shape[0]
    rows: list[Array] = []
    for i in reversed(range(d)):
        rest = right[i]
        for k in range(i + 1, d):
            rest = rest - factor[k, i][None] * rows[d - 1 - k]
        rows.append(rest / factor[i, i][None])
    return jnp.stack(rows[::-1])


def without_correlations(
    matrix: Float[Array, "d d #n"],
) -> tuple[Float[Array, "d d n"], Float[Array, "d n"]]:
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
