"""Moves for mixtures whose components stand for objects. The references tell objects apart."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from mpfjax.mixture import ParticleMixture
from mpfjax.moves.base import AbstractPropagation
from mpfjax.moves.objects.exclusion import AbstractExclusion


class ObjectExclusion(AbstractExclusion):
    """Lower the weights of particles near the probable places of other objects.

        log-weight_i -= strength · Σ_m s_m exp(-|x_i - μ_m|² / (2 radius²))

    The sum runs over the components m of other objects; μ_m is the mean of the propagated
    particles, and s_m the component's share of its object's mass. The object of a component is the
    reference that its particles carry (`BoxState`). Components of one object are rival hypotheses
    and do not repel each other. Distances are in units of `scale`, the width and height of a box in
    pixels.

    This is NOT part of the exact recursion. Objects interact as in a Markov random field, but
    through their means instead of their states. The marginal likelihood is biased (`approximate` is
    true). Use it after `Propagate`, where look-alikes cross.
    """

    strength: float = eqx.field(static=True, default=3.0)
    radius: float = eqx.field(static=True, default=0.5)
    scale: tuple[float, float] = eqx.field(static=True, default=(1.0, 1.0))

    def __call__(
        self, key: Key[Array, ""], mixture: ParticleMixture, observation: PyTree
    ) -> ParticleMixture:
        """Lower the weight of every particle according to its distance from the other objects."""
        del key, observation
        states, owners = mixture.particles, component_references(mixture)
        centres = states.box[:, :2] / jnp.array([self.scale], states.box.dtype)
        filled = mixture.occupied.astype(centres.dtype)[:, None]
        counts = jnp.maximum(mixture.component_sums(filled), 1.0)
        means = mixture.component_sums(filled * centres) / counts
        shares = jnp.exp(_log_shares(mixture, owners)).astype(centres.dtype)
        squares = jnp.sum((centres[:, None] - means[None]) ** 2, axis=-1)
        nearness = shares[None] * self.nearness(squares)
        others = states.reference[:, None] != owners[None]
        total = jnp.sum(jnp.where(others, nearness, 0.0), axis=1)
        penalty = self.strength * total.astype(mixture.log_weights.dtype)
        return mixture.replace(log_weights=mixture.log_weights - penalty)


class PruneHypotheses(AbstractPropagation):
    """Empty the components that have become improbable hypotheses about their object.

    A component dies if its mass is less than `least_share` of that of the heaviest component with
    the same reference. Within one object the mixture weights are the posterior odds of its
    hypotheses (Vermaak et al. 2003, eq. 4). Each component that dies takes away at most this share
    of its object's mass. Use it with `Split`, to remove hypotheses that turned out wrong.
    """

    least_share: float = eqx.field(static=True, default=1e-6)

    approximate = True
    """the mass of the pruned components is lost."""

    def __call__(
        self, key: Key[Array, ""], mixture: ParticleMixture, observation: PyTree
    ) -> ParticleMixture:
        """Set the weights of improbable components to zero."""
        del key, observation
        masses = mixture.log_mixture_weights
        rivals = _same_object(mixture, component_references(mixture))
        heaviest = jnp.max(jnp.where(rivals, masses[None], -jnp.inf), axis=1)
        hopeless = mixture.active & (masses < heaviest + jnp.log(self.least_share))
        dies = hopeless[mixture.component_indicators]
        return mixture.replace(log_weights=jnp.where(dies, -jnp.inf, mixture.log_weights))


def best_components(
    mixture: ParticleMixture, num_objects: int
) -> tuple[Int[Array, " k"], Bool[Array, " k"]]:
    """The heaviest component of each object, and whether the object has one at all."""
    own = component_references(mixture)[None] == jnp.arange(num_objects, dtype=jnp.int32)[:, None]
    masses = jnp.where(own & mixture.active[None], mixture.log_mixture_weights[None], -jnp.inf)
    return jnp.argmax(masses, axis=1), jnp.max(masses, axis=1) > -jnp.inf


def component_references(mixture: ParticleMixture) -> Int[Array, " m"]:
    """The reference of each component: the integer nearest to its particles' mean."""
    reference = mixture.particles.reference.astype(mixture.log_weights.dtype)
    return jnp.round(mixture.component_averages(reference)).astype(jnp.int32)


def _same_object(mixture: ParticleMixture, owners: Int[Array, " m"]) -> Bool[Array, "m m"]:
    alive = mixture.active
    return (owners[:, None] == owners[None]) & alive[:, None] & alive[None]


def _log_shares(mixture: ParticleMixture, owners: Int[Array, " m"]) -> Float[Array, " m"]:
    """log of each component's share of the mass of its object, -inf for a dead one."""
    masses = mixture.log_mixture_weights
    rivals = jnp.where(_same_object(mixture, owners), masses[None], -jnp.inf)
    heaviest = jnp.max(rivals, axis=1)
    shift = jnp.where(jnp.isfinite(heaviest), heaviest, 0.0)
    total = jnp.sum(jnp.exp(rivals - shift[:, None]), axis=1)
    log_total = shift + jnp.log(jnp.where(total > 0, total, 1.0))
    return jnp.where(mixture.active, masses - log_total, -jnp.inf)
