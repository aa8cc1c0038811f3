"""Split: a component that is spread too far becomes two."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from mpfjax.checks import check_not_negative, check_share, check_whole
from mpfjax.mixture import ParticleMixture
from mpfjax.moves.base import AbstractRegrouping
from mpfjax.moves.features import Features, Scale, separation, summarise
from mpfjax.operations.indexing import take
from mpfjax.operations.segments import segment_argmax, segment_sum, spread_finite


class Split(AbstractRegrouping):
    """Split a component in two where it has become too diffuse.

    Vermaak et al. (2003), section 4, leaves the criterion open. Here weighted 2-means, started from
    the two ends of the component, finds two halves. The component splits if all of these hold:

    - the halves' means are more than `min_deviations` pooled standard deviations apart. The halves
      of a Gaussian are 2.6 apart and those of a uniform distribution 3.5, so 4 splits neither;
    - they are more than `min_distance` apart, in units of `scale`;
    - the lighter half holds at least `min_share` of the component's mass.

    The lighter half takes a free label. If there are too few free labels, the clearest splits come
    first. Raises `ValueError` for a threshold that is negative or a share not in [0, 0.5].
    Exact: a relabelling only.
    """

    min_deviations: float = eqx.field(static=True)
    min_distance: float = eqx.field(static=True)
    min_share: float = eqx.field(static=True)
    num_iterations: int = eqx.field(static=True)
    features: Features

    def __init__(
        self,
        min_deviations: float = 4.0,
        min_distance: float = 0.0,
        *,
        min_share: float = 0.05,
        num_iterations: int = 3,
        features: Callable[[PyTree], Array] | None = None,
        scale: Scale = 1.0,
    ) -> None:
        check_not_negative(min_deviations=min_deviations, min_distance=min_distance)
        check_share(0.5, min_share=min_share)
        check_whole(num_iterations=num_iterations)
        self.min_deviations = min_deviations
        self.min_distance = min_distance
        self.min_share = min_share
        self.num_iterations = num_iterations
        self.features = Features(features, scale)

    def regroup(
        self, key: Key[Array, ""], mixture: ParticleMixture
    ) -> tuple[Int[Array, " n"], dict[str, PyTree]]:
        """The lighter half of every component that is too diffuse, to a free label."""
        del key
        features, m = self.features(mixture), mixture.num_components
        weights = mixture.component_weights
        parent = mixture.component_indicators
        side = self._halve(features, weights, mixture)
        halves = summarise(features, weights, parent + m * side, 2 * m)
        masses = halves.masses.reshape(2, m)
        distance, deviations = separation(
            halves.means[:m], halves.covariances[:m], halves.means[m:], halves.covariances[m:]
        )
        splits = (
            (jnp.min(masses, axis=0) >= self.min_share)
            & (jnp.min(masses, axis=0) > 0)
            & (deviations > self.min_deviations)
            & (distance > self.min_distance)
        )
        lighter = jnp.where(masses[1] <= masses[0], 1, 0)
        labels = free_labels(splits, deviations, mixture.active)
        moves = (side == spread_finite(lighter, parent, 2)) & mixture.occupied
        return jnp.where(moves, spread_finite(labels, parent, m), parent), mixture.memory

    def _halve(
        self, features: Float[Array, "n k"], weights: Float[Array, " n"], mixture: ParticleMixture
    ) -> Int[Array, " n"]:
        """0 or 1 for each particle: which half of its component it belongs to."""
        m, parent = mixture.num_components, mixture.component_indicators
        mean = mixture.component_averages(features)
        one_end = _farthest_members(features, mean, mixture)
        centroids = jnp.concatenate([one_end, _farthest_members(features, one_end, mixture)])

        def iterate(_: int | Int[Array, ""], centroids: Float[Array, "g k"]) -> Float[Array, "g k"]:
            labels = parent + m * _nearer(features, centroids, parent)
            masses = segment_sum(weights, labels, 2 * m)[:, None]
            sums = segment_sum(weights[:, None] * features, labels, 2 * m)
            return jnp.where(masses > 0, sums / jnp.where(masses > 0, masses, 1.0), centroids)

        centroids = jax.lax.fori_loop(0, self.num_iterations, iterate, centroids)
        return _nearer(features, centroids, parent)


def free_labels(
    wanted: Bool[Array, " m"], priority: Float[Array, " m"], active: Bool[Array, " m"]
) -> Int[Array, " m"]:
    """A free label for each component that wants one, by priority; its own where none is left."""
    own = jnp.arange(active.shape[0], dtype=jnp.int32)
    earlier = own[:, None] < own[None]
    ties = (priority[:, None] == priority[None]) & earlier
    goes_first = wanted[:, None] & ((priority[:, None] > priority[None]) | ties)
    rank = jnp.sum(goes_first, axis=0, dtype=jnp.int32)
    free_rank = jnp.cumsum((~active).astype(jnp.int32)) - 1
    matches = ~active[None] & (rank[:, None] == free_rank[None])
    label = jnp.max(jnp.where(matches, own[None], -1), axis=1)
    return jnp.where(wanted & (label >= 0), label, own)


def _nearer(
    features: Float[Array, "n k"], centroids: Float[Array, "g k"], parent: Int[Array, " n"]
) -> Int[Array, " n"]:
    """Which of its own component's two centroids each particle is nearer to."""
    m = centroids.shape[0] // 2
    first = jnp.sum((features - spread_finite(centroids[:m], parent)) ** 2, axis=1)
    second = jnp.sum((features - spread_finite(centroids[m:], parent)) ** 2, axis=1)
    return (second < first).astype(jnp.int32)


def _farthest_members(
    features: Float[Array, "n k"], points: Float[Array, "m k"], mixture: ParticleMixture
) -> Float[Array, "m k"]:
    """In each component, the particle farthest from the component's point."""
    parent = mixture.component_indicators
    distance = jnp.sum((features - spread_finite(points, parent)) ** 2, axis=1)
    distance = jnp.where(mixture.occupied, distance, -1.0)
    return take(features, segment_argmax(distance, parent, mixture.num_components))
