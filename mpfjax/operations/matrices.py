"""Many small rows and matrices at once: sums, draws, factors.

In numpy: `values.sum(axis=1)`, `rng.choice(n, p=weights[i])` for each row i, `np.linalg.cholesky`
and `np.linalg.solve`. Calls of LAPACK for thousands of tiny matrices cost far more than their
arithmetic. Here one operation does the same column of all matrices.
"""

import math
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

_FEW_COLUMNS = 16
# Larger matrices than these, up to so many of them, are factored in a loop over their columns: most
# of the time until a tracker's first frame is compiling.
_SMALL = 4
_FEW_MATRICES = 64


def row_sums(values: Float[Array, "n d"]) -> Float[Array, " n"]:
    """Σ_k v_ik. A sum over few columns is written out, which a CPU runs twenty times faster."""
    if not 0 < values.shape[1] <= _FEW_COLUMNS:
        return jnp.sum(values, axis=1)
    total = values[:, 0]
    for k in range(1, values.shape[1]):
        total = total + values[:, k]
    return total


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
    chosen = blocks[rows, block]
    if within is None:
        rest = target - (upto[rows, block] - sums[rows, block])
    else:
        rest = within * sums[rows, block]
    column = _first_above(rest, jnp.cumsum(chosen, axis=1), chosen)
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

    def column(j: Any, factors: Float[Array, "n d d"]) -> Float[Array, "n d"]:
        rest = matrices[:, :, j] - jnp.einsum("nik,nk->ni", factors, factors[:, j])
        positive = rest[:, j] > tiny[:, j]
        pivot = jnp.sqrt(jnp.where(positive, rest[:, j], 1.0))
        return jnp.where(positive[:, None], rest / pivot[:, None], 0.0)

    factors = jnp.zeros_like(matrices)
    if d > _SMALL and len(matrices) <= _FEW_MATRICES:

        def with_column(j: Any, factors: Float[Array, "n d d"]) -> Float[Array, "n d d"]:
            below = jnp.arange(d) >= j
            return factors.at[:, :, j].set(jnp.where(below, column(j, factors), 0.0))

        return jax.lax.fori_loop(0, d, with_column, factors)
    for j in range(d):
        factors = factors.at[:, j:, j].set(column(j, factors)[:, j:])
    return factors


def solve_lower(
    factors: Float[Array, "#n d d"], vectors: Float[Array, "n d"]
) -> Float[Array, "n d"]:
    """F⁻¹ v of lower triangular F, by forward substitution; one F for all, or one for each.

    It is written out for the same reason as `cholesky`. LAPACK's own has also been seen to hang
    when a program solves several large batches at once.
    """
    solved = jnp.zeros_like(vectors)
    for i in range(vectors.shape[1]):
        rest = vectors[:, i] - jnp.sum(factors[:, i] * solved, axis=1)
        solved = solved.at[:, i].set(rest / factors[:, i, i])
    return solved
