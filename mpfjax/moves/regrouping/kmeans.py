"""K-means: every particle to the nearest centroid, each centroid to the mean of its particles."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from mpfjax.checks import Count
from mpfjax.mixture import ParticleMixture
from mpfjax.moves.base import AbstractRegrouping, Regrouped
from mpfjax.moves.regrouping.features import ByFeatures
from mpfjax.operations.matrices import row_sums
from mpfjax.operations.segments import segment_argmax, segment_counts, segment_sum
from mpfjax.operations.stored import most_of_runs

# Centroids in one pass over the particles. A program of all 64 takes seconds to compile.
_AT_ONCE = 16


class KMeans(AbstractRegrouping, ByFeatures):
    """Assign particles to the nearest component, by K-means from the components as they are.

    Vermaak et al. (2003), section 4. Every particle counts the same, whatever its weight, so that
    the components cover all places that hold particles. On the quadratic model, K-means by weight
    loses modes. A component keeps its label. A component without a particle is dead and stays dead.

    - `num_iterations`: how often all particles are assigned; the centroids move in between.
    - `reseed`: start from all M components instead, seeded by farthest-first traversal from the
      particle farthest from the mean. For the grouping of x_0.
    - `features`: maps the particles to the numbers by which they are near or far, (n,) or (n, k);
      None takes the whole state, flattened.
    - `scale`: the unit of each feature, or one for all. Distances are measured in it.

    Raises `ValueError` for fewer than one iteration, and a scale that is not positive.
    """

    num_iterations: Count = eqx.field(static=True, default=5)
    reseed: bool = eqx.field(static=True, default=False, kw_only=True)

    def regroup(self, key: Key[Array, ""], mixture: ParticleMixture) -> Regrouped:
        """Each particle to the component whose centroid is nearest."""
        features, occupied, m = self.features_of(mixture), mixture.occupied, mixture.num_components
        if self.reseed:
            alive = jnp.ones(m, bool)
            labels = nearest(features, farthest_first(features, occupied, m), alive)
        else:
            labels = mixture.component_indicators
        filled = jnp.where(occupied[:, None], features, 0.0)

        def iterate(_: int | Int[Array, ""], labels: Int[Array, " n"]) -> Int[Array, " n"]:
            counts, sums = segment_counts(occupied, labels, m), segment_sum(filled, labels, m)
            centroids = sums / jnp.maximum(counts, 1).astype(features.dtype)[:, None]
            return nearest(features, centroids, counts > 0)

        labels = jax.lax.fori_loop(0, self.num_iterations, iterate, labels)
        return labels, mixture.memory


def farthest_first(
    features: Float[Array, "n k"], occupied: Bool[Array, " n"], num_seeds: int
) -> Float[Array, "num_seeds k"]:
    """Seeds for K-means: the particle farthest from the mean, then each farthest from all."""
    weight = occupied.astype(features.dtype)[:, None]
    mean = jnp.sum(weight * features, axis=0) / jnp.maximum(jnp.sum(weight), 1.0)

    everywhere = jnp.zeros(features.shape[0], jnp.int32)

    def farthest(distance: Float[Array, " n"]) -> Float[Array, " k"]:
        return features[segment_argmax(jnp.where(occupied, distance, -1.0), everywhere, 1)[0]]

    def squared_distance(point: Float[Array, " k"]) -> Float[Array, " n"]:
        return jnp.sum((features - point[None]) ** 2, axis=1)

    def add(
        state: tuple[Float[Array, " n"], Float[Array, " k"]], _: None
    ) -> tuple[tuple[Float[Array, " n"], Float[Array, " k"]], Float[Array, " k"]]:
        distance, seed = state
        distance = jnp.minimum(distance, squared_distance(seed))
        return (distance, farthest(distance)), seed

    first = farthest(squared_distance(mean))
    nowhere_near = jnp.full(features.shape[0], jnp.inf, features.dtype)
    _, seeds = jax.lax.scan(add, (nowhere_near, first), length=num_seeds)
    return seeds


def nearest(
    features: Float[Array, "n k"], centroids: Float[Array, "m k"], alive: Bool[Array, " m"]
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
    so_far: tuple[Float[Array, " n"], Int[Array, " n"]],
    features: Float[Array, "n k"],
    centroids: Float[Array, "m k"],
    first: int | Int[Array, ""],
) -> tuple[Float[Array, " n"], Int[Array, " n"]]:
    """The least squared distance so far and whose it is, after these centroids as well."""
    best, labels = so_far
    for m in range(centroids.shape[0]):
        distance = row_sums((features - centroids[m][None]) ** 2)
        closer = distance < best
        labels = jnp.where(closer, first + m, labels)
        best = jnp.where(closer, distance, best)
    return best, labels
