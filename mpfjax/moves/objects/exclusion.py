"""Exclusion: components repel each other, so that no two end on one object."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key, PyTree

from mpfjax.checks import Positive
from mpfjax.mixture import ParticleMixture
from mpfjax.moves.base import AbstractPropagation, Step, is_missing
from mpfjax.moves.regrouping.features import ByFeatures, component_groups, summarise


class Exclusion(AbstractPropagation, ByFeatures):
    """Lower the weights of particles near the predicted means of the other components.

        log-weight_i -= strength · Σ_{m ≠ c_i} exp(-|x_i - μ_m|² / (2 radius²))

    The sum is over active components. μ_m is the unweighted mean of the propagated particles of
    component m: the mean of its prediction if every step resamples. Distances are in units of
    `scale`; the repulsion is nearly 0 at three times the radius.

    - `group`: a function that returns the number of each particle's object, the same within a
      component, as for `Prune`. Components of one object are then rival hypotheses, which do not
      repel each other, and each is weighted by its share of its object's weight. None assigns a
      different object to each component.

    This is NOT part of the exact recursion of any paper here. Components interact as objects do in
    a Markov random field, but through their means instead of their states. The filtering
    distribution is then not that of the model, and the marginal likelihood is biased (`approximate`
    is true). Use it after `Propagate`, if each component represents an object, objects cannot share
    a position, and several components would otherwise end on one of several similar objects. Never
    use it if components are hypotheses about ONE object, unless `group` declares this.

    Raises `ValueError` for a strength or radius that is not positive.
    """

    strength: Positive = eqx.field(static=True, kw_only=True)
    radius: Positive = eqx.field(static=True, kw_only=True)
    group: Callable[[PyTree], Int[Array, " n"]] | None = eqx.field(
        static=True, default=None, kw_only=True
    )

    approximate = True
    """components interact in a way that the model does not have."""

    weighs = False
    """the observation changes no weight."""

    def __call__(self, key: Key[Array, ""], mixture: ParticleMixture, now: Step) -> ParticleMixture:
        """Lower the weight of every particle by its nearness to the means of other objects."""
        if mixture.num_components == 1 or is_missing(now):
            return mixture
        features, labels = self.features_of(mixture), mixture.component_indicators
        weights = mixture.occupied.astype(features.dtype)
        groups = summarise(features, weights, labels, mixture.num_components)
        objects, owners, shares = self._objects(mixture)
        total = jnp.zeros(mixture.num_particles, features.dtype)
        for m in range(mixture.num_components):
            square = jnp.sum((features - groups.means[m][None]) ** 2, axis=1)
            nearness = shares[m].astype(square.dtype) * jnp.exp(-square / (2 * self.radius**2))
            total += jnp.where((objects != owners[m]) & (groups.masses[m] > 0), nearness, 0.0)
        return mixture.reweight(-self.strength * total)

    def _objects(
        self, mixture: ParticleMixture
    ) -> tuple[Int[Array, " n"], Int[Array, " m"], Float[Array, " m"]]:
        """The object of each particle and component, and the component's share of its mass."""
        labels, m = mixture.component_indicators, mixture.num_components
        masses = mixture.log_mixture_weights
        if self.group is None:
            return labels, jnp.arange(m, dtype=labels.dtype), jnp.ones_like(masses)
        objects = self.group(mixture.particles)
        owners = component_groups(mixture, objects)
        of_object = jnp.where(owners[:, None] == owners[None], masses[None], -jnp.inf)
        shares = jnp.exp(masses - jax.nn.logsumexp(of_object, axis=1))
        return objects, owners, jnp.where(mixture.active, shares, 0.0)
