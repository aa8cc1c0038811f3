"""Pool: all particles to one component."""

import jax.numpy as jnp
from jaxtyping import Array, Int, Key, PyTree

from mpfjax.mixture import ParticleMixture
from mpfjax.moves.base import AbstractRegrouping


class Pool(AbstractRegrouping):
    """Put all particles into component 0, so that the mixture is one particle set.

    The left-hand side of eq. 3 of Smith and Gatica-Perez (2004), read from right to left. Use it
    before a `Resample` in which the components should compete. Exact: a relabelling only.
    """

    def regroup(
        self, key: Key[Array, ""], mixture: ParticleMixture
    ) -> tuple[Int[Array, " n"], dict[str, PyTree]]:
        """Component 0 for every particle."""
        del key
        return jnp.zeros_like(mixture.component_indicators), mixture.memory
