"""The nearest of a few centroids, for every particle."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mpfjax.operations.islands import most_of_runs
from mpfjax.operations.matrices import row_sums

# Centroids in one pass over the particles. A program of all 64 takes seconds to compile.
_AT_ONCE = 16


def nearest(
    features: Float[Array, "n k"], centroids: Float[Array, "m k"], alive: Bool[Array, " m"]
) -> Int[Array, " n"]:
    """The living centroid nearest to each particle; of equally near ones, the first.

    A running minimum over the centroids: no (m, n) array is made. It ends with the last living one,
    since the free labels are mostly the last.
    """
    n, m = features.shape[0], centroids.shape[0]
    centroids = jnp.where(alive[:, None], centroids, jnp.inf)
    found = jnp.full(n, jnp.inf, features.dtype), jnp.zeros(n, jnp.int32)
    if m <= _AT_ONCE:
        return _nearer(found, features, centroids, 0)[1]
    padding = -m % _AT_ONCE
    centroids = jnp.pad(centroids, ((0, padding), (0, 0)), constant_values=jnp.inf)
    passes = centroids.reshape(-1, _AT_ONCE, centroids.shape[1])
    last = jnp.max(jnp.where(alive, jnp.arange(m, dtype=jnp.int32), 0))
    return jax.lax.fori_loop(
        0,
        most_of_runs(last // _AT_ONCE + 1),
        lambda i, found: _nearer(found, features, passes[i], i * _AT_ONCE),
        found,
    )[1]


def _nearer(
    found: tuple[Float[Array, " n"], Int[Array, " n"]],
    features: Float[Array, "n k"],
    centroids: Float[Array, "m k"],
    first: int | Int[Array, ""],
) -> tuple[Float[Array, " n"], Int[Array, " n"]]:
    """The least squared distance so far and whose it is, after these centroids as well."""
    best, labels = found
    for m in range(centroids.shape[0]):
        distance = row_sums((features - centroids[m][None]) ** 2)
        closer = distance < best
        labels = jnp.where(closer, first + m, labels)
        best = jnp.where(closer, distance, best)
    return best, labels
