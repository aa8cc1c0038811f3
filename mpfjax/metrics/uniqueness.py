"""The number of distinct hypotheses of each object in a joint filter: its impoverishment."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree, Shaped

from mpfjax.checks import check_type
from mpfjax.mixture import ParticleMixture, flatten_states


def uniqueness(mixture: ParticleMixture) -> Float[Array, " objects"]:
    """U/N of each object: its distinct hypotheses as a share of all particles.

    Smith and Gatica-Perez (2004), section 3.1. Two particles hold the same hypothesis of object j
    if its whole state is equal in both. Particles have leaves (n, J, ...); empty slots hold no
    hypothesis. Pass it as `collect` to get it after every step. A weighted resampling within the
    step lowers it for the objects that have moved, as in the paper's figure 4. Raises `ValueError`
    for particles of other shapes.
    """
    _check(mixture)
    distinct = jax.vmap(lambda states: _distinct_rows(states, mixture), in_axes=1)
    return distinct(mixture.particles) / jnp.asarray(
        mixture.num_usable_slots, mixture.log_weights.dtype
    )


def effective_dynamics(mixture: ParticleMixture) -> PyTree:
    """The variance of each object's parameters over the particles: every leaf (J, ...).

    Smith and Gatica-Perez (2004), section 3.1, at the end of a step. Every filled slot counts
    the same, whatever its weight: it measures how far the search reaches, and not the posterior.
    Divided by the variance of the dynamics' noise, it is the percentage of figure 4. Resampling
    lowers it for the first objects of an order; for the last it may exceed 100%. Raises
    `ValueError` for particles of other shapes.
    """
    _check(mixture)
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


def _check(mixture: ParticleMixture) -> None:
    check_type(ParticleMixture, "a ParticleMixture", mixture=mixture)
    shapes = [leaf.shape for leaf in jax.tree.leaves(mixture.particles)]
    if any(len(shape) < 2 for shape in shapes):
        raise ValueError(f"mixture: particles of shapes {shapes} are not of objects, (n, J, ...)")


def _distinct_rows(states: PyTree, mixture: ParticleMixture) -> Float[Array, ""]:
    """How many different rows the filled slots hold."""
    rows = flatten_states(states)
    empty = ~mixture.occupied
    # The last key of a lexicographic sort counts most: the empty slots come last.
    order = jnp.lexsort((*rows.T, empty))
    rows, filled = rows[order], ~empty[order]
    is_new = jnp.any(rows[1:] != rows[:-1], axis=1)
    is_first = jnp.concatenate([jnp.ones(1, bool), is_new])
    return jnp.sum((is_first & filled).astype(mixture.log_weights.dtype))
