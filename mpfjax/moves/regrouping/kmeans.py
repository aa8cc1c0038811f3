"""K-means: particles are assigned to the nearest centroid, centroids moved to their means."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from mpfjax.checks import Count
from mpfjax.mixture import ParticleMixture
from mpfjax.moves.base import AbstractRegrouping, Regrouped
from mpfjax.moves.regrouping.features import ByFeatures, Rows
from mpfjax.operations.matrices import row_sums
from mpfjax.operations.segments import segment_argmax, segment_counts, segment_sum
from mpfjax.operations.stored import most_of_runs

Nearest = tuple[Float[Array, " n"], Int[Array, " n"]]
# Centroids in one pass over the particles. A program of all 64 takes seconds to compile.
_AT_ONCE = 16


class KMeans(AbstractRegrouping, ByFeatures):
    """Assign particles to the nearest component, by K-means from the existing components.

    Vermaak et al. (2003), section 4. Every particle counts equally, regardless of its weight, so
    that the components cover all regions with particles. On the quadratic model, K-means by weight
    loses modes. A component keeps its label. A component without particles is empty and remains
    empty.

    - `num_iterations`: how often all particles are assigned; the centroids move in between.
    - `reseed`: start from all M components instead, seeded by farthest-first traversal from the
      particle farthest from the mean. Use it to group x_0.
    - `features`: maps the particles to the coordinates by which distances are measured, (n,) or (n,
      k); None uses the whole state, flattened.
    - `scale`: the unit of each feature, or one for all.

    Raises `ValueError` for fewer than one iteration, and a scale that is not positive.
    """

    num_iterations: Count = eqx.field(static=True, default=5)
    reseed: bool = eqx.field(static=True, default=False, kw_only=True)

    def regroup(self, key: Key[Array, ""], mixture: ParticleMixture) -> Regrouped:
        """The component with the nearest centroid, for each particle."""
        features, occupied, m = self.features_of(mixture), mixture.occupied, mixture.num_components
        labels = mixture.component_indicators
        if self.reseed:
            labels = farthest_first(features, occupied, m)
        filled = jnp.where(occupied[:, None], features, 0.0)

        def iterate(_: int | Int[Array, ""], labels: Int[Array, " n"]) -> Int[Array, " n"]:
            counts, sums = segment_counts(occupied, labels, m), segment_sum(filled, labels, m)
            centroids = sums / jnp.maximum(counts, 1).astype(features.dtype)[:, None]
            return nearest(features, centroids, counts > 0)

        labels = jax.lax.fori_loop(0, self.num_iterations, iterate, labels)
        return labels, mixture.memory


def farthest_first(features: Rows, occupied: Bool[Array, " n"], num_seeds: int) -> Int[Array, " n"]:
    """The nearest of so many seeds to each particle.

    The first is the particle farthest from the mean, and each other the one farthest from all
    before it.
    """
    weight = occupied.astype(features.dtype)[:, None]
    mean = jnp.sum(weight * features, axis=0) / jnp.maximum(jnp.sum(weight), 1.0)
    everywhere = jnp.zeros(features.shape[0], jnp.int32)
    nowhere_near = jnp.full(features.shape[0], jnp.inf, features.dtype)

    def add(
        i: Int[Array, ""], state: tuple[Float[Array, " k"], Float[Array, " n"], Int[Array, " n"]]
    ) -> tuple[Float[Array, " k"], Float[Array, " n"], Int[Array, " n"]]:
        point, least, labels = state
        distance = row_sums((features - point[None]) ** 2)
        labels = jnp.where(distance < least, jnp.maximum(i, 0).astype(labels.dtype), labels)
        least = jnp.minimum(least, distance)
        farthest = segment_argmax(jnp.where(occupied, least, -1.0), everywhere, 1)[0]
        # The mean, which comes before them, is no seed.
        return features[farthest], jnp.where(i < 0, jnp.inf, least), labels

    return jax.lax.fori_loop(-1, num_seeds, add, (mean, nowhere_near, everywhere))[2]


def nearest(
    features: Rows, centroids: Float[Array, "m k"], alive: Bool[Array, " m"]
) -> Int[Array, " n"]:
    """The living centroid nearest to each particle; of equally near ones, the first.

    A running minimum over the centroids: no (m, n) array is made. It ends with the last living one,
    since the free labels are mostly the last.
    """
    n, m = features.shape[0], centroids.shape[0]
    centroids = jnp.where(alive[:, None], centroids, jnp.inf)
    so_far = jnp.full(n, jnp.inf, features.dtype), jnp.zeros(n, jnp.int32)
    if m <= _AT_ONCE:
        return _nearer(so_far, features, centroids, 0)[1]
    padding = -m % _AT_ONCE
    centroids = jnp.pad(centroids, ((0, padding), (0, 0)), constant_values=jnp.inf)
    passes = centroids.reshape(-1, _AT_ONCE, centroids.shape[1])
    last = jnp.max(jnp.where(alive, jnp.arange(m, dtype=jnp.int32), 0))
    return jax.lax.fori_loop(
        0,
        most_of_runs(last // _AT_ONCE + 1),
        lambda i, so_far: _nearer(so_far, features, passes[i], i * _AT_ONCE),
        so_far,
    )[1]


def _nearer(
    so_far: Nearest, features: Rows, centroids: Float[Array, "m k"], first: int | Int[Array, ""]
) -> Nearest:
    """The least squared distance so far and whose it is, after these centroids as well."""
    best, labels = so_far
    for m in range(centroids.shape[0]):
        distance = row_sums((features - centroids[m][None]) ** 2)
        closer = distance < best
        labels = jnp.where(closer, first + m, labels)
        best = jnp.where(closer, distance, best)
    return best, labels
