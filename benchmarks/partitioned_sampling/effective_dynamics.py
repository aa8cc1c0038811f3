"""How far the particles of each object reach."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree, Shaped

from mpfjax import ParticleMixture


def effective_dynamics(mixture: ParticleMixture) -> PyTree:
    """The variance of each object's parameters over the particles: every leaf (J, ...).

    Smith and Gatica-Perez (2004), section 3.1, at the end of a step. Every filled slot counts
    the same, whatever its weight: it measures how far the search reaches, and not the posterior.
    Divided by the variance of the dynamics' noise, it is the percentage of figure 4. Resampling
    lowers it for the first objects of an order; for the last it may exceed 100%.
    """
    occupied = mixture.occupied

    def variance(leaf: Shaped[Array, "n objects *rest"]) -> Float[Array, "objects *rest"]:
        if not jnp.issubdtype(leaf.dtype, jnp.floating):
            leaf = leaf.astype(mixture.log_weights.dtype)
        filled = occupied.reshape(-1, *[1] * (leaf.ndim - 1))
        count = jnp.maximum(jnp.sum(occupied.astype(leaf.dtype)), 1.0)
        mean = jnp.sum(jnp.where(filled, leaf, 0.0), axis=0) / count
        squares = jnp.where(filled, (leaf - mean[None]) ** 2, 0.0)
        return jnp.sum(squares, axis=0) / count

    return jax.tree.map(variance, mixture.particles)
