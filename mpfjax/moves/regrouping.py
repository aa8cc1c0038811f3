"""Regrouping: K-means, merging, splitting, random partition, and pooling into one."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from mpfjax.checks import (
    check_flag,
    check_not_negative,
    check_positive,
    check_share,
    check_whole,
    given,
)
from mpfjax.generator import bits
from mpfjax.mixture import ParticleMixture
from mpfjax.moves.base import AbstractRegrouping
from mpfjax.moves.features import Features, Scale, separation, summarise
from mpfjax.operations import (
    count_upto,
    row_sums,
    segment_argmax,
    segment_counts,
    segment_sum,
    spread,
    take,
)


class KMeans(AbstractRegrouping):
    """A fixed number of K-means iterations, from the components as they are.

    Vermaak et al. (2003), section 4. Each particle counts the same whatever its weight: the
    groups are to cover the places that hold particles, and on the quadratic model weighting
    loses modes. A component without a particle is dead and stays so; a component keeps its label.

    - `num_iterations`: assignments of all particles; the centroids move in between.
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


class Merge(AbstractRegrouping):
    """Merge components that overlap, for as many steps as patience asks.

    Vermaak et al. (2003), section 4, leaves the criterion open. Here two components overlap
    when both hold:

    - their means are less than `max_deviations` pooled standard deviations apart, along the line
      that joins them (Ashman's D; at 1 two equal Gaussians share 62% of their mass, at 2 32%);
    - their means are less than `max_distance` apart, in units of `scale`.

    None leaves out a condition. `patience` is for how many steps in a row (frames) they must
    overlap before they merge, so that two objects that pass each other are not made one. Chains
    of overlapping components merge into one, which keeps the lowest label.

    Raises `ValueError` where both conditions are None, for a threshold that is not positive, or
    for a patience below 1. Exact: a relabelling only.
    """

    max_deviations: float | None = eqx.field(static=True)
    max_distance: float | None = eqx.field(static=True)
    patience: int = eqx.field(static=True)
    features: Features

    def __init__(
        self,
        max_deviations: float | None = 1.0,
        max_distance: float | None = None,
        *,
        patience: int = 1,
        features: Callable[[PyTree], Array] | None = None,
        scale: Scale = 1.0,
    ) -> None:
        if max_deviations is None and max_distance is None:
            raise ValueError("max_deviations, max_distance: at least one must be given")
        check_positive(**given(max_deviations=max_deviations, max_distance=max_distance))
        check_whole(patience=patience)
        self.max_deviations = max_deviations
        self.max_distance = max_distance
        self.patience = patience
        self.features = Features(features, scale)

    def initial_memory(self, num_components: int) -> dict[str, PyTree]:
        """For how many steps each pair of components has overlapped, where patience counts."""
        if self.patience == 1:
            return {}
        return {"overlap_durations": jnp.zeros((num_components, num_components), jnp.int32)}

    def regroup(
        self, key: Key[Array, ""], mixture: ParticleMixture
    ) -> tuple[Int[Array, " n"], dict[str, PyTree]]:
        """Every particle to the lowest label that its component is chained to by overlap."""
        del key
        overlap = self._overlap(mixture)
        memory = mixture.memory
        if self.patience > 1:
            durations = jnp.where(overlap, memory["overlap_durations"] + 1, 0)
            overlap = durations >= self.patience
            memory = memory | {"overlap_durations": durations}
        return spread(lowest_connected(overlap), mixture.component_indicators), memory

    def forget(self, memory: dict[str, PyTree], dead: Bool[Array, " m"]) -> dict[str, PyTree]:
        """No pair with a dead component has overlapped yet."""
        if self.patience == 1:
            return memory
        is_dead = dead[:, None] | dead[None]
        durations = jnp.where(is_dead, 0, memory["overlap_durations"])
        return memory | {"overlap_durations": durations}

    def _overlap(self, mixture: ParticleMixture) -> Bool[Array, "m m"]:
        groups = summarise(
            self.features(mixture),
            mixture.component_weights,
            mixture.component_indicators,
            mixture.num_components,
        )
        distance, deviations = separation(
            groups.means[:, None], groups.covariances[:, None],
            groups.means[None], groups.covariances[None],
        )  # fmt: skip
        overlap = groups.alive[:, None] & groups.alive[None]
        if self.max_deviations is not None:
            overlap &= deviations < self.max_deviations
        if self.max_distance is not None:
            overlap &= distance < self.max_distance
        return overlap


class Split(AbstractRegrouping):
    """Split a component in two where it has become too diffuse.

    Vermaak et al. (2003), section 4, leaves the criterion open. Here each component is parted
    by weighted 2-means, started from its two ends, and splits where all of these hold:

    - the halves' means are more than `min_deviations` pooled standard deviations apart (a
      Gaussian cut in the middle gives 2.6, a uniform cut in the middle 3.5, so that neither
      splits below 4);
    - they are more than `min_distance` apart, in units of `scale`;
    - the lighter half holds at least `min_share` of the component's mass.

    The lighter half takes a free label, the clearest splits first; without a free label nothing
    splits. Raises `ValueError` for a threshold that is negative or a share not in [0, 0.5].
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
        moves = (side == spread(lighter, parent)) & mixture.occupied
        return jnp.where(moves, spread(labels, parent), parent), mixture.memory

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


class Pool(AbstractRegrouping):
    """All particles into component 0, the mixture as one particle set.

    The left-hand side of eq. 3 of Smith and Gatica-Perez (2004), read from right to left. Use it
    before a `Resample` in which the components are to compete. Exact: a relabelling only.
    """

    def regroup(
        self, key: Key[Array, ""], mixture: ParticleMixture
    ) -> tuple[Int[Array, " n"], dict[str, PyTree]]:
        """Component 0 for every particle."""
        del key
        return jnp.zeros_like(mixture.component_indicators), mixture.memory


class RandomPartition(AbstractRegrouping):
    """The particles dealt at random into sets of equal size, without replacement.

    Smith and Gatica-Perez (2004), section 4: C sets of N/C particles each, sizes differing by one
    where C does not divide N; empty slots are dealt after the filled ones. A set's mass is that
    of its particles (eq. 5), so that the distribution stays as it is.

    - `num_sets`: C; None takes as many as the mixture has components.

    Raises `ValueError` for C < 1, or more sets than components. Use it where components are to
    stand for the same distribution, such as `Partitioned` in one order each.
    """

    num_sets: int | None = eqx.field(static=True, default=None)

    def __check_init__(self) -> None:
        check_whole(**given(num_sets=self.num_sets))

    def regroup(
        self, key: Key[Array, ""], mixture: ParticleMixture
    ) -> tuple[Int[Array, " n"], dict[str, PyTree]]:
        """A random set for every particle."""
        n = mixture.num_particles
        num_sets = mixture.num_components if self.num_sets is None else self.num_sets
        if num_sets > mixture.num_components:
            raise ValueError(
                f"num_sets: {num_sets} is more than num_components, {mixture.num_components}"
            )
        # Sets dealt in turn, in an order drawn by sorting: the set stands in a word's lowest bits,
        # random bits above it, and the sets for the empty slots come after all others.
        width = (num_sets - 1).bit_length()
        occupied, index = mixture.occupied, jnp.arange(n, dtype=jnp.int32)
        num_filled = jnp.sum(occupied, dtype=jnp.int32)
        noise = bits(key, (n,)) >> (width + 1) << width
        is_last = (index >= num_filled).astype(jnp.uint32) << 31
        words = jax.lax.sort(is_last | noise | (index % num_sets).astype(jnp.uint32))
        dealt = (words & jnp.uint32((1 << width) - 1)).astype(jnp.int32)
        filled_before = count_upto(occupied, n) - occupied.astype(jnp.int32)
        turn = jnp.where(occupied, filled_before, num_filled + index - filled_before)
        return take(dealt, turn), mixture.memory


def nearest(
    features: Float[Array, "n k"], centroids: Float[Array, "m k"], alive: Bool[Array, " m"]
) -> Int[Array, " n"]:
    """The living centroid nearest to each particle, the lowest of equals.

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


def farthest_first(
    features: Float[Array, "n k"], occupied: Bool[Array, " n"], num_seeds: int
) -> Float[Array, "num_seeds k"]:
    """Seeds for K-means: the particle farthest from the mean, then each farthest from all."""
    weight = occupied.astype(features.dtype)[:, None]
    mean = jnp.sum(weight * features, axis=0) / jnp.maximum(jnp.sum(weight), 1.0)
    distance = jnp.sum((features - mean[None]) ** 2, axis=1)
    seeds = []
    for m in range(num_seeds):
        seed = features[jnp.argmax(jnp.where(occupied, distance, -1.0))]
        to_seed = jnp.sum((features - seed[None]) ** 2, axis=1)
        distance = to_seed if m == 0 else jnp.minimum(distance, to_seed)
        seeds.append(seed)
    return jnp.stack(seeds)


def lowest_connected(adjacent: Bool[Array, "m m"]) -> Int[Array, " m"]:
    """The lowest label in the connected component of each node of a symmetric graph.

    Each node takes the lowest label of its neighbours, then that label's own, until none changes.
    """
    m = adjacent.shape[0]
    own = jnp.arange(m, dtype=jnp.int32)
    reach = adjacent | jnp.eye(m, dtype=bool)

    def lower(state: tuple[Array, Array]) -> tuple[Array, Array]:
        labels, _ = state
        lowest = jnp.min(jnp.where(reach, labels[None], m), axis=1)
        lowest = take(lowest, lowest)
        return lowest, jnp.any(lowest != labels)

    labels, _ = jax.lax.while_loop(lambda state: state[1], lower, (own, jnp.ones((), bool)))
    return labels


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


def _centroids(
    features: Float[Array, "n k"],
    occupied: Bool[Array, " n"],
    labels: Int[Array, " n"],
    num_components: int,
) -> tuple[Float[Array, "m k"], Bool[Array, " m"]]:
    counts = segment_counts(occupied, labels, num_components)
    sums = segment_sum(jnp.where(occupied[:, None], features, 0.0), labels, num_components)
    return sums / jnp.maximum(counts, 1).astype(features.dtype)[:, None], counts > 0


def _nearer(
    features: Float[Array, "n k"], centroids: Float[Array, "g k"], parent: Int[Array, " n"]
) -> Int[Array, " n"]:
    """Which of its own component's two centroids each particle is nearer to."""
    m = centroids.shape[0] // 2
    first = jnp.sum((features - spread(centroids[:m], parent)) ** 2, axis=1)
    second = jnp.sum((features - spread(centroids[m:], parent)) ** 2, axis=1)
    return (second < first).astype(jnp.int32)


def _farthest_members(
    features: Float[Array, "n k"], points: Float[Array, "m k"], mixture: ParticleMixture
) -> Float[Array, "m k"]:
    """In each component, the particle farthest from the component's point."""
    parent = mixture.component_indicators
    distance = jnp.sum((features - spread(points, parent)) ** 2, axis=1)
    distance = jnp.where(mixture.occupied, distance, -1.0)
    return take(features, segment_argmax(distance, parent, mixture.num_components))
