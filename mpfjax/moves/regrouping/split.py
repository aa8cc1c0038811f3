"""Split: a component that has become too diffuse is divided in two."""

from typing import Annotated, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from mpfjax.checks import Count, NotNegative, share
from mpfjax.mixture import ParticleMixture
from mpfjax.moves.base import AbstractRegrouping, Regrouped
from mpfjax.moves.regrouping.features import (
    ByFeatures,
    Rows,
    relative_weights,
    separation,
    summarise_about,
    weighted_means,
)
from mpfjax.operations.logarithms import without_gradient
from mpfjax.operations.matrices import row_sums
from mpfjax.operations.segments import segment_argmax, spread
from mpfjax.operations.stored import VECTOR, cond_if_any, stored, take

# 2-means starts at the two ends, and needs few iterations.
_ITERATIONS = 3


class Split(AbstractRegrouping, ByFeatures):
    """Split a component in two if it has become too diffuse.

    Vermaak et al. (2003), section 4, leaves the criterion open. Here weighted 2-means, started from
    the two ends of the component, determines two halves. The component is split if all of these
    hold:

    - the halves' means are more than `min_deviations` pooled standard deviations apart. The halves
      of a Gaussian are 2.6 apart and those of a uniform distribution 3.5, so 4 splits neither;
    - they are more than `min_distance` apart, in units of `scale`;
    - the lighter half has at least `min_share` of the component's weight.

    The centres of the halves are computed from a sample: every k-th particle, about `sample_size`
    times M of them; None uses all. After resampling, copies are neighbours, so that the sample
    includes every group of copies with a share of at least one in `sample_size`. All particles are
    then used to assign them to halves and to test the conditions.

    The lighter half receives a free label. If there are too few free labels, the clearest splits
    come first. Raises `ValueError` for a threshold that is negative or a share not in [0, 0.5].
    Exact: only labels change.
    """

    min_deviations: NotNegative = eqx.field(static=True, default=4.0)
    min_distance: NotNegative = eqx.field(static=True, default=0.0, kw_only=True)
    min_share: Annotated[float, share(0.5)] = eqx.field(static=True, default=0.05, kw_only=True)
    sample_size: Count | None = eqx.field(static=True, default=32, kw_only=True)

    def regroup(self, key: Key[Array, ""], mixture: ParticleMixture) -> Regrouped:
        """The new indicators: the lighter half of each diffuse component receives a free label."""
        # Computed outside the condition, where XLA shares them with neighbouring moves.
        features, active = self.features_of(mixture), mixture.active
        parent = mixture.component_indicators

        def split() -> Int[Array, " n"]:
            side, lighter, deviations, splits = self._halves(mixture, features)
            labels = free_labels(splits, deviations, active)
            moves = (side == spread(lighter, parent)) & mixture.occupied
            return jnp.where(moves, spread(labels, parent), parent)

        return cond_if_any(jnp.any(~active), split, lambda: parent), mixture.memory

    def is_diffuse(self, mixture: ParticleMixture) -> Bool[Array, " m"]:
        """Which components would be split if each had a free label.

        If `StepInfo.labels_ran_out`, several modes share the label of each of these.
        """
        mixture = without_gradient(mixture)
        return self._halves(mixture, self.features_of(mixture))[-1]

    def _halves(
        self, mixture: ParticleMixture, features: Rows
    ) -> tuple[Int[Array, " n"], Int[Array, " m"], Float[Array, " m"], Bool[Array, " m"]]:
        """Each component cut in two: the half that each particle is in; and of each component the
        lighter half, how many deviations they are apart, and whether that is enough.
        """
        m, size = mixture.num_components, self.sample_size
        weights, parent = relative_weights(mixture), mixture.component_indicators
        particles = _Particles(features, weights, parent, mixture.occupied)
        sample = particles
        if size is not None and mixture.num_particles > size * m:
            sample = _subsample(particles, size * m, mixture)
        centres = _two_means(sample, m)
        side, gaps = _nearer(features, centres, parent)
        halves = summarise_about(centres, gaps, weights, parent + m * side)
        masses = halves.masses.reshape(2, m)
        least_mass, total = jnp.min(masses, axis=0), jnp.sum(masses, axis=0)
        pooled = (halves.covariances[:m] + halves.covariances[m:]) / 2
        distance, deviations = separation(halves.means[:m] - halves.means[m:], pooled)
        splits = (
            (least_mass > 0)
            & (least_mass >= self.min_share * total)
            & (deviations > self.min_deviations)
            & (distance > self.min_distance)
        )
        lighter = jnp.where(masses[1] <= masses[0], 1, 0)
        return side, lighter, deviations, splits


class _Particles(NamedTuple):
    """The quantities of the particles, or of a sample of them, that splitting uses."""

    features: Float[Array, "s k"]
    weights: Float[Array, " s"]
    parent: Int[Array, " s"]
    occupied: Bool[Array, " s"]


def _subsample(particles: _Particles, most: int, mixture: ParticleMixture) -> _Particles:
    """Every k-th of the usable slots, at most `num` of them."""
    room = mixture.num_usable_slots
    stride = -(-room // most)
    number = most if mixture.usable_slots is not None else -(-mixture.num_particles // stride)
    # A multiple of the vector length, without which XLA would not vectorise the sample.
    places = stride * jnp.arange(-(-number // VECTOR) * VECTOR, dtype=jnp.int32)
    inside = places < room
    places = jnp.minimum(places, mixture.num_particles - 1)
    # Stored, since a gather for several runs has them on its second axis, off vectors.
    sample = jax.tree.map(lambda values: stored(take(values, places).T).T, particles)
    return sample._replace(
        weights=jnp.where(inside, sample.weights, 0.0), occupied=sample.occupied & inside
    )


def _two_means(sample: _Particles, m: int) -> Float[Array, "g k"]:
    """The centres of two halves of each component, by weighted 2-means from its two ends."""
    features, weights, parent, _ = sample
    _, means = weighted_means(features, weights, parent, m)
    one_end = _farthest_members(sample, means, m)
    centres = jnp.concatenate([one_end, _farthest_members(sample, one_end, m)])

    def iterate(_: int | Int[Array, ""], centres: Float[Array, "g k"]) -> Float[Array, "g k"]:
        side, _ = _nearer(features, centres, parent)
        masses, means = weighted_means(features, weights, parent + m * side, 2 * m)
        return jnp.where((masses > 0)[:, None], means, centres)

    return jax.lax.fori_loop(0, _ITERATIONS, iterate, centres)


def free_labels(
    is_candidate: Bool[Array, " m"], priority: Float[Array, " m"], active: Bool[Array, " m"]
) -> Int[Array, " m"]:
    """A free label for each component that wants one, by priority; its own where none is left."""
    component = jnp.arange(active.shape[0], dtype=jnp.int32)
    earlier = component[:, None] < component[None]
    ties = (priority[:, None] == priority[None]) & earlier
    goes_first = is_candidate[:, None] & ((priority[:, None] > priority[None]) | ties)
    rank = jnp.sum(goes_first, axis=0, dtype=jnp.int32)
    free_rank = jnp.cumsum(~active, dtype=jnp.int32) - 1
    matches = ~active[None] & (rank[:, None] == free_rank[None])
    label = jnp.max(jnp.where(matches, component[None], -1), axis=1)
    return jnp.where(is_candidate & (label >= 0), label, component)


def _nearer(
    features: Rows, centres: Float[Array, "g k"], parent: Int[Array, " n"]
) -> tuple[Int[Array, " n"], Float[Array, "n k"]]:
    """Which of its own component's two centres each particle is nearer to, and how far from it."""
    m = centres.shape[0] // 2
    to_first = features - spread(centres[:m], parent)
    to_second = features - spread(centres[m:], parent)
    is_second = row_sums(to_second**2) < row_sums(to_first**2)
    is_second = stored(is_second)
    # Column by column: XLA would choose numbers of rows of one number one after the other.
    gaps = jnp.where(is_second[None], to_second.T, to_first.T).T
    return is_second.astype(jnp.int32), gaps


def _farthest_members(
    sample: _Particles, points: Float[Array, "m k"], num_components: int
) -> Float[Array, "m k"]:
    """In each component, the particle farthest from the component's point."""
    distance = row_sums((sample.features - spread(points, sample.parent)) ** 2)
    distance = jnp.where(sample.occupied, distance, -1.0)
    return take(sample.features, segment_argmax(distance, sample.parent, num_components))
