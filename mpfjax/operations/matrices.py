"""Many small rows and matrices at once, the particles first: sums, factors, products.

In numpy: `values.sum(axis=1)`, `rng.choice(n, p=weights[i])`, `np.linalg.cholesky`,
`np.linalg.solve` and `points @ matrix.T`. Calls of LAPACK for thousands of tiny matrices cost far
more than their arithmetic, and rows of a few numbers do not run on vectors. Here one operation does
the same column of all.
"""

import math
from collections.abc import Sequence
from functools import reduce

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from mpfjax.operations.logarithms import finite_or_zero

_FEW_COLUMNS = 16
Coordinates = Sequence[Float[Array, " n"]]
# Sums over more terms than this are a matrix product: written out they would compile too long.
_FEW = 10


def row_sums(values: Float[Array, "n d"]) -> Float[Array, " n"]:
    """Σ_k v_ik. A sum over few columns is written out, which a CPU runs twenty times faster."""
    if not 0 < values.shape[1] <= _FEW_COLUMNS:
        return jnp.sum(values, axis=1)
    return reduce(jnp.add, jnp.unstack(values, axis=1))


def draw_columns(
    uniform: Float[Array, " k"],
    weights: Float[Array, "k n"],
    within: Float[Array, " k"] | None = None,
) -> Int[Array, " k"]:
    """The column of each row that holds the given quantile, in [0, 1), of the row's weights.

    A column of weight zero is not drawn, unless the whole row is zero: then the last column is.
    The search has two levels, blocks of columns and columns in a block, and takes one pass over
    the table. `within` is a second quantile, of a block's weights: in float32, one has too few
    bits to tell a hundred thousand columns apart.
    """
    # In both levels, rounding may put the target on either side of a border, or past the end.
    num_rows, num_columns = weights.shape
    size = _block_size(num_columns)
    num_blocks = -(-num_columns // size)
    padded = jnp.pad(weights, ((0, 0), (0, num_blocks * size - num_columns)))
    blocks = padded.reshape(num_rows, num_blocks, size)
    sums = jnp.sum(blocks, axis=2)
    upto = jnp.cumsum(sums, axis=1)
    target = uniform * upto[:, -1]
    block = _first_above(target, upto, sums)
    rows = jnp.arange(num_rows, dtype=jnp.int32)
    picks = blocks[rows, block]
    if within is None:
        rest = target - (upto[rows, block] - sums[rows, block])
    else:
        rest = within * sums[rows, block]
    column = _first_above(rest, jnp.cumsum(picks, axis=1), picks)
    return jnp.minimum(block * size + column, num_columns - 1)


def _block_size(num_columns: int) -> int:
    """About √n; a divisor of n if there is one, since what is fused with a padding is slow."""
    root = max(math.isqrt(num_columns), 1)
    near = range(max(root // 2, 1), 2 * root + 1)
    divisors = [size for size in near if num_columns % size == 0]
    return min(divisors, key=lambda size: abs(size - root), default=root)


def _first_above(
    target: Float[Array, " k"], upto: Float[Array, "k n"], weights: Float[Array, "k n"]
) -> Int[Array, " k"]:
    """In each row the first place of positive weight whose cumulative sum is above the target.

    If there is none, it is the last place of positive weight; if no place has weight, the last one.
    """
    last = weights.shape[1] - 1
    place = jnp.arange(last + 1, dtype=jnp.int32)[None]
    is_positive = weights > 0
    first = jnp.min(jnp.where(is_positive & (upto > target[:, None]), place, last + 1), axis=1)
    last_positive = jnp.max(jnp.where(is_positive, place, -1), axis=1)
    last_positive = jnp.where(last_positive < 0, last, last_positive)
    return jnp.minimum(first, last_positive)


def cholesky(matrices: Float[Array, "n d d"]) -> Float[Array, "n d d"]:
    """Lower triangular factors F with F Fᵀ = matrix, for positive semidefinite matrices.

    A direction without variance gets a column of zeros. Whether a variance is zero is judged beside
    the coordinate's own variance, so units do not matter. Batched LAPACK calls on thousands of
    tiny matrices cost far more than their arithmetic; here all go through each column at once.
    """
    d = matrices.shape[-1]
    tiny = 8 * d * jnp.finfo(matrices.dtype).eps * jnp.diagonal(matrices, axis1=1, axis2=2)

    factors = jnp.zeros_like(matrices)
    for j in range(d):
        rest = matrices[:, j:, j] - jnp.einsum("nik,nk->ni", factors[:, j:], factors[:, j])
        positive = rest[:, 0] > tiny[:, j]
        pivot = jnp.sqrt(jnp.where(positive, rest[:, 0], 1.0))
        column = jnp.where(positive[:, None], rest / pivot[:, None], 0.0)
        factors = factors.at[:, j:, j].set(column)
    return factors


def solve_lower(
    factors: Float[Array, "#n d d"], vectors: Float[Array, "n d"]
) -> Float[Array, "n d"]:
    """F⁻¹ v of lower triangular F, by forward substitution; one F for all, or one for each.

    It is written out for the same reason as `cholesky`. LAPACK's own has also been seen to hang
    when a program solves several large batches at once.
    """
    solution = jnp.zeros_like(vectors)
    for i in range(vectors.shape[1]):
        rest = vectors[:, i] - jnp.sum(factors[:, i] * solution, axis=1)
        solution = solution.at[:, i].set(rest / factors[:, i, i])
    return solution


def coordinates(points: Float[Array, "n d"]) -> Coordinates:
    """The columns of an array with a row for each point."""
    return [points[:, i] for i in range(points.shape[1])]


def transform(
    matrix: Float[Array, "e d"], points: Coordinates, is_lower: bool = False
) -> Coordinates:
    """A x of each point x; `is_lower` says that A has zeros above its diagonal."""
    rows, columns = matrix.shape
    if columns > _FEW:
        images = matrix @ jnp.stack(points)
        return [images[i] for i in range(rows)]
    return [
        total([matrix[i, j] * points[j] for j in range(i + 1 if is_lower else columns)])
        for i in range(rows)
    ]


def total(terms: Coordinates) -> Float[Array, " n"]:
    """The sum of the terms, one after the other; zero where there is none."""
    return reduce(jnp.add, terms) if terms else jnp.zeros(())


def inner(points: Coordinates, others: Coordinates) -> Float[Array, " n"]:
    """xᵀy of each pair of points."""
    return total([x * y for x, y in zip(points, others, strict=True)])


def log_total(logs: Coordinates) -> Float[Array, " n"]:
    """log Σ exp of the terms, -inf where all are."""
    most = finite_or_zero(reduce(jnp.maximum, logs))
    return jnp.log(total([jnp.exp(term - most) for term in logs])) + most
