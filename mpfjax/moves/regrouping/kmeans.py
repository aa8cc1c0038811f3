"""K-means: every particle to the nearest centroid, each centroid to the mean of its particles."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from mpfjax.checks import check_flag, check_whole
from mpfjax.mixture import ParticleMixture
from mpfjax.moves.base import AbstractRegrouping
from mpfjax.moves.regrouping.features import Features, Scale
from mpfjax.moves.regrouping.nearest import nearest
from mpfjax.operations.segments import segment_argmax, segment_counts, segment_sum


class KMeans(AbstractRegrouping):
    """Assign particles to the nearest component, by K-means from the components as they are.

    Vermaak et al. (2003), section 4. Every particle counts the same, whatever its weight, so that
    the components cover all places that hold particles. On the quadratic model, K-means by weight
    loses modes. A component keeps its label. A component without a particle is dead and stays dead.

    - `num_iterations`: how often all particles are assigned; the centroids move in between.
    - `reseed`: start from all M components instead, seeded by farthest-first traversal from the
      particle farthest from the mean. For the grouping of x_0.
    - `features`, `scale`: see `Features`.

    Raises `ValueError` for fewer than one iteration.
    """

    num_iterations: int = eqx.field(static=True)
    reseed: bool = eqx.field(static=True)
    features: Features

    def __init__(
        self,
        num_iterations: int = 5,
        *,
        reseed: bool = False,
        features: Callable[[PyTree], Array] | None = None,
        scale: Scale = 1.0,
    ) -> None:
        check_whole(num_iterations=num_iterations)
        check_flag(reseed=reseed)
        self.num_iterations = num_iterations
        self.reseed = reseed
        self.features = Features(features, scale)

    def regroup(
        self, key: Key[Array, ""], mixture: ParticleMixture
    ) -> tuple[Int[Array, " n"], dict[str, PyTree]]:
        """Each particle to the component whose centroid is nearest."""
        del key
        features, occupied, m = self.features(mixture), mixture.occupied, mixture.num_components
        if self.reseed:
            alive = jnp.ones(m, bool)
            labels = nearest(features, farthest_first(features, occupied, m), alive)
        else:
            labels = mixture.component_indicators

        def iterate(_: int | Int[Array, ""], labels: Int[Array, " n"]) -> Int[Array, " n"]:
            centroids, alive = _centroids(features, occupied, labels, m)
            return nearest(features, centroids, alive)

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


def _centroids(
    features: Float[Array, "n k"],
    occupied: Bool[Array, " n"],
    labels: Int[Array, " n"],
    num_components: int,
) -> tuple[Float[Array, "m k"], Bool[Array, " m"]]:
    counts = segment_counts(occupied, labels, num_components)
    sums = segment_sum(jnp.where(occupied[:, None], features, 0.0), labels, num_components)
    return sums / jnp.maximum(counts, 1).astype(features.dtype)[:, None], counts > 0
