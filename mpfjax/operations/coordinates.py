"""Points given coordinate by coordinate: a list with an array (n,) for each.

In numpy: `points @ matrix.T`, `np.sum(points**2, axis=1)` and `np.logaddexp.reduce`. Rows of a few
numbers do not run on vectors, and neither do stacks of them. A list of coordinates whose sums are
written out becomes one loop over the points, in which nothing is computed twice.
"""

from collections.abc import Sequence

import jax.numpy as jnp
from jaxtyping import Array, Float

from mpfjax.operations.logarithms import finite_or_zero

Coordinates = Sequence[Float[Array, " n"]]

# Sums over more terms than this are a matrix product: written out they would compile too long.
_FEW = 10


def coordinates(points: Float[Array, "n d"]) -> Coordinates:
    """The columns of an array with a row for each point."""
    return [points[:, i] for i in range(points.shape[1])]


def transformed(
    matrix: Float[Array, "e d"], points: Coordinates, is_lower: bool = False
) -> Coordinates:
    """A x of each point x; `is_lower` says that A has zeros above its diagonal."""
    rows, columns = matrix.shape
    if columns > _FEW:
        found = matrix @ jnp.stack(points)
        return [found[i] for i in range(rows)]
    return [
        total([matrix[i, j] * points[j] for j in range(i + 1 if is_lower else columns)])
        for i in range(rows)
    ]


def total(terms: Coordinates) -> Float[Array, " n"]:
    """The sum of the terms, one after the other; zero where there is none."""
    found = terms[0] if terms else jnp.zeros(())
    for term in terms[1:]:
        found = found + term
    return found


def inner(points: Coordinates, others: Coordinates) -> Float[Array, " n"]:
    """xᵀy of each pair of points."""
    return total([x * y for x, y in zip(points, others, strict=True)])


def log_total(logs: Coordinates) -> Float[Array, " n"]:
    """log Σ exp of the terms, -inf where all are."""
    most = logs[0]
    for term in logs[1:]:
        most = jnp.maximum(most, term)
    most = finite_or_zero(most)
    return jnp.log(total([jnp.exp(term - most) for term in logs])) + most
