"""The nearest of a few points, for every particle."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mpfjax.operations.matrices import row_sums


def nearest(
    features: Float[Array, "n k"], centroids: Float[Array, "m k"], alive: Bool[Array, " m"]
) -> Int[Array, " n"]:
    """The living centroid nearest to each particle; of equally near ones, the first.

    A running minimum over the centroids: no (m, n) array is made.
    """
    centroids = jnp.where(alive[:, None], centroids, jnp.inf)
    best = jnp.full(features.shape[0], jnp.inf, features.dtype)
    labels = jnp.zeros(features.shape[0], jnp.int32)
    for m in range(centroids.shape[0]):
        distance = row_sums((features - centroids[m][None]) ** 2)
        closer = distance < best
        labels = jnp.where(closer, m, labels)
        best = jnp.where(closer, distance, best)
    return labels
