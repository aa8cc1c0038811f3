"""Prune: empty improbable components."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Key, PyTree

from mpfjax.checks import check_inner_share
from mpfjax.mixture import ParticleMixture
from mpfjax.moves.base import AbstractMove
from mpfjax.operations.segments import spread


class Prune(AbstractMove):
    """Empty the components whose mass is below a share of the heaviest component's.

    Mixture weights are posterior odds (Vermaak et al. 2003, eq. 4). Resampling gives every living
    component some slots, however small its odds; a pruned component leaves its slots to the others.
    With M components, a step loses at most the share (M - 1) `least_share` of the mass, and Ẑ falls
    by at most as much.

    Raises `ValueError` for a share outside (0, 1). Use it after a propagation, before regrouping,
    where hypotheses that turned out wrong hold particles that others need.
    """

    least_share: float = eqx.field(static=True, default=1e-6)

    def __check_init__(self) -> None:
        check_inner_share(least_share=self.least_share)

    approximate = True
    """the mass of the pruned components is lost."""

    weighs = False
    """the observation changes no weight."""

    def __call__(
        self, key: Key[Array, ""], mixture: ParticleMixture, observation: PyTree = None
    ) -> ParticleMixture:
        """Set the weights of improbable components to zero."""
        del key, observation
        masses = mixture.log_mixture_weights
        hopeless = masses < jnp.max(masses) + jnp.log(self.least_share)
        dies = spread(hopeless, mixture.component_indicators)
        return mixture.replace(log_weights=jnp.where(dies, -jnp.inf, mixture.log_weights))
