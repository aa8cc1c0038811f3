"""The features of the state that regrouping uses, and their units."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Annotated, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int, PyTree

from mpfjax.arrays import POSITIVE, to_numbers
from mpfjax.checks import Checked, check_shape, saying
from mpfjax.mixture import ParticleMixture, flatten_states
from mpfjax.operations.logarithms import as_inexact
from mpfjax.operations.segments import are_masked, column_sums, scaled_exp_of_segments, spread
from mpfjax.operations.stored import stored

# Up to this many features are multiplied one by one, which runs on vectors.
_FEW_FEATURES = 8
Scale = ArrayLike | Sequence[float]
Rows = Float[Array, "n k"]  # the features of each particle


class ByFeatures(Checked):
    """A move for which particles are near or far by their features, measured in `scale`.

    - `features`: maps the particles to (n,) or (n, k) features; None takes the whole state,
      flattened.
    - `scale`: a number, or one a feature: the unit of each, such as the width and height of a box
      in pixels. All distances and thresholds of distance are in this unit.

    Raises `ValueError` for a scale that is not positive.
    """

    features: Callable[[PyTree], Array] | None = eqx.field(static=True, default=None, kw_only=True)
    scale: Annotated[tuple[float, ...], POSITIVE] = eqx.field(
        static=True, default=(1.0,), converter=to_numbers("scale"), kw_only=True
    )

    def features_of(self, mixture: ParticleMixture) -> Rows:
        """The features of every particle, relative to their average, zero in an empty slot.

        Regrouping needs only differences, and values far from zero would lose them to rounding.
        """
        particles = mixture.particles
        if self.features is None:
            values = flatten_states(particles)
        else:
            with saying("features", "called with the particles"):
                values = self.features(particles)
            check_shape(f"{mixture.num_particles} ...", features=values)
        values = as_inexact(values.reshape(mixture.num_particles, -1))
        if len(self.scale) not in (1, values.shape[1]):
            raise ValueError(f"scale: {len(self.scale)} units for {values.shape[1]} features")
        if self.scale != (1.0,):
            # One number is part of the program, where XLA sees that moves have the same.
            one, *others = self.scale
            values = values / (jnp.array(self.scale, values.dtype)[None] if others else one)
        return jnp.where(mixture.occupied[:, None], values - origin(values, mixture)[None], 0.0)


class OnCircles(NamedTuple):
    """The flattened state as features; what goes round becomes a point on its circle.

    - `periods`: of each number of the flattened state, zero for what does not go round. A number of
      period P gives two features, (P / 2π) cos and (P / 2π) sin, so that near ones are as far apart
      as the numbers are.
    """

    periods: tuple[float, ...]

    def __call__(self, states: PyTree) -> Rows:
        """The features of each particle."""
        columns, numbers = [], flatten_states(states).T
        if len(numbers) != len(self.periods):
            raise ValueError(f"periods: {len(self.periods)} for a state of {len(numbers)} numbers")
        for column, period in zip(numbers, self.periods, strict=True):
            r = period / (2 * np.pi)
            columns += [r * jnp.cos(column / r), r * jnp.sin(column / r)] if period else [column]
        return jnp.stack(columns, axis=1)


def origin(values: Rows, mixture: ParticleMixture) -> Float[Array, " k"]:
    """The average over the filled slots, with equal weights."""
    filled = mixture.occupied[:, None]
    total = jnp.sum(jnp.where(filled, values, 0.0), axis=0)
    return total / jnp.maximum(jnp.sum(filled), 1).astype(values.dtype)


class Groups(eqx.Module):
    """The mass, mean and covariance of each group of particles, zero for an empty one."""

    masses: Float[Array, " g"]
    means: Float[Array, "g k"]
    covariances: Float[Array, "g k k"]


def relative_weights(mixture: ParticleMixture) -> Float[Array, " n"]:
    """The weights within each component, in units of its largest; a dead one's are zero."""
    labels, m = mixture.component_indicators, mixture.num_components
    weights, _ = scaled_exp_of_segments(mixture.log_weights, labels, m)
    # Otherwise XLA takes the maximum by a scatter, one particle after the other.
    return weights if are_masked(mixture.num_particles, m) else stored(weights)


def weighted_means(
    features: Rows, weights: Float[Array, " n"], labels: Int[Array, " n"], num_groups: int
) -> tuple[Float[Array, " g"], Float[Array, "g k"]]:
    """The mass and the mean of the particles under each label, zero for an empty one."""
    sums = column_sums(_first_moments(features, weights), labels, num_groups)
    masses = sums[:, 0]
    return masses, sums[:, 1:] / _or_one(masses)[:, None]


def summarise(
    features: Rows, weights: Float[Array, " n"], labels: Int[Array, " n"], num_groups: int
) -> Groups:
    """Weighted mass, mean and covariance of the particles under each label."""
    masses, means = weighted_means(features, weights, labels, num_groups)
    products, entries = _products(features - spread(means, labels), weights)
    covariances = column_sums(products, labels, num_groups) / _or_one(masses)[:, None]
    return Groups(masses, means, covariances[:, entries])


def summarise_about(
    points: Float[Array, "g k"], gaps: Rows, weights: Float[Array, " n"], labels: Int[Array, " n"]
) -> Groups:
    """`summarise` in one pass, of particles that are `gaps` away from a point of their group.

    If the point is many deviations away from the group's mean, the covariance loses digits to
    rounding. Points of K-means are near the means.
    """
    k = points.shape[1]
    products, entries = _products(gaps, weights)
    columns = jnp.concatenate([_first_moments(gaps, weights), products])
    sums = column_sums(columns, labels, len(points))
    masses = sums[:, 0]
    averages = sums[:, 1:] / _or_one(masses)[:, None]
    offsets = averages[:, :k]
    covariances = averages[:, k:][:, entries] - offsets[:, :, None] * offsets[:, None, :]
    return Groups(masses, jnp.where((masses > 0)[:, None], points + offsets, 0.0), covariances)


def _or_one(masses: Float[Array, " g"]) -> Float[Array, " g"]:
    return jnp.where(masses > 0, masses, 1.0)


def _first_moments(features: Rows, weights: Float[Array, " n"]) -> Float[Array, "c n"]:
    """The weights, and the weighted features, column by column."""
    weights = weights.astype(features.dtype)
    return jnp.stack([weights, *map(partial(jnp.multiply, weights), features.T)])


def _products(
    gaps: Rows, weights: Float[Array, " n"]
) -> tuple[Float[Array, "c n"], Int[np.ndarray, "k k"]]:
    """The weighted products of each pair of features, column by column, and the pairs."""
    num_features = gaps.shape[1]
    # A covariance is symmetric: one triangle of it.
    left, right = np.tril_indices(num_features)
    entries = np.zeros((num_features, num_features), int)
    entries[left, right] = entries[right, left] = np.arange(len(left))
    columns, weights = gaps.T, weights.astype(gaps.dtype)
    if num_features > _FEW_FEATURES:
        return weights[None] * columns[left] * columns[right], entries
    pairs = zip(left, right, strict=True)
    return jnp.stack([weights * columns[i] * columns[j] for i, j in pairs]), entries


def separation(
    gap: Float[Array, "*g k"], pooled: Float[Array, "*g k k"]
) -> tuple[Float[Array, " *g"], Float[Array, " *g"]]:
    """The distance between the means of two groups, and the same in pooled standard deviations.

    `gap` is μ_a - μ_b, and `pooled` Σ, the mean of the two covariances. The second number is |gap|
    over the standard deviation along the line through both means, sqrt(uᵀ Σ u). It is Ashman's D:
    below 2, two Gaussians of equal mass are usually said to have no clear gap. Two groups of one
    point each are infinitely many deviations apart, or zero if the points are the same.
    """
    distance = jnp.sqrt(jnp.sum(gap**2, axis=-1))
    spread = jnp.sqrt(jnp.maximum(jnp.einsum("...i,...ij,...j->...", gap, pooled, gap), 0.0))
    at_points = jnp.where(distance > 0, jnp.inf, jnp.zeros_like(distance))
    deviations = distance**2 / jnp.where(spread > 0, spread, 1.0)
    return distance, jnp.where(spread > 0, deviations, at_points)
