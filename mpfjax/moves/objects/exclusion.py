"""Exclusion: components repel each other, so that no two end on one object."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from mpfjax.checks import Positive
from mpfjax.mixture import ParticleMixture
from mpfjax.moves.base import AbstractPropagation, Step, is_missing
from mpfjax.moves.regrouping.features import ByFeatures, summarise


class AbstractExclusion(AbstractPropagation):
    """Lower log-weights by `strength` times the nearness of a particle to the means of others.

    Nearness to one mean μ is exp(-|x - μ|² / (2 radius²)): 1 at the mean, and nearly 0 at three
    times the radius. No exact recursion has this factor; `approximate` is true.
    """

    strength: eqx.AbstractVar[float]
    radius: eqx.AbstractVar[float]

    approximate = True
    """components interact in a way that the model does not have."""

    weighs = False
    """the observation changes no weight."""

    def nearness(self, squared_distances: Float[Array, " *shape"]) -> Float[Array, " *shape"]:
        """exp(-d² / (2 radius²)), of squared distances to a mean."""
        return jnp.exp(-squared_distances / (2 * self.radius**2))


class Exclusion(AbstractExclusion, ByFeatures):
    """Lower the weights of particles near the predicted means of the other components.

        log-weight_i -= strength · Σ_{m ≠ c_i} exp(-|x_i - μ_m|² / (2 radius²))

    The sum runs over living components. μ_m is the plain mean of the propagated particles of
    component m: the mean of its prediction when every step resamples. Distances are in units of
    `scale`.

    This is NOT part of the exact recursion of any paper here. Components interact as objects do in
    a Markov random field, but through their means instead of their states. The filtering
    distribution is then not that of the model, and the marginal likelihood is biased (`approximate`
    is true). Use it after `Propagate`, where each component stands for an object, objects cannot
    share a place, and several components would otherwise end on one look-alike. Never use it where
    components are hypotheses about ONE object.

    Raises `ValueError` for a strength or radius that is not positive.
    """

    strength: Positive = eqx.field(static=True, kw_only=True)
    radius: Positive = eqx.field(static=True, kw_only=True)

    def __call__(self, key: Key[Array, ""], mixture: ParticleMixture, now: Step) -> ParticleMixture:
        """Lower the weight of every particle by its nearness to the means of other components."""
        if mixture.num_components == 1 or is_missing(now):
            return mixture
        features, own = self.features_of(mixture), mixture.component_indicators
        weights = mixture.occupied.astype(features.dtype)
        groups = summarise(features, weights, own, mixture.num_components)
        total = jnp.zeros(mixture.num_particles, features.dtype)
        for m in range(mixture.num_components):
            square = jnp.sum((features - groups.means[m][None]) ** 2, axis=1)
            total += jnp.where((own != m) & (groups.masses[m] > 0), self.nearness(square), 0.0)
        return mixture.weighed(-self.strength * total)
