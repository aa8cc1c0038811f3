"""Standard normal and uniform draws: independent, or spread evenly over all particles."""

import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from mpfjax.operations.generator import bits, normal, normal_quantile, uniform


def independent_normal(
    key: Key[Array, ""], shape: tuple[int, ...], dtype: jnp.dtype
) -> Float[Array, "n d"]:
    """Independent standard normal draws."""
    return normal(key, shape, dtype)


def stratified_normal(
    key: Key[Array, ""], shape: tuple[int, ...], dtype: jnp.dtype
) -> Float[Array, "n d"]:
    """Standard normal draws, one row a particle, that together cover the normal evenly.

    Row i is the Gaussian quantile of the fractional part of i α + U: a lattice shifted by one
    uniform number U in each dimension. α_j = φ_d^{-j}, where φ_d solves x^{d+1} = x + 1; for d = 1
    it is the golden ratio. Every single row is exactly normal and independent of the past, so a
    sum over particles keeps its expectation. Rows are negatively dependent, so the sum has less
    variance. Most is gained among the offspring of one parent, which are neighbours after
    resampling.
    """
    n, d = shape
    # Fractions of 2^32 in integers: floating point would lose the fraction of i α for large i.
    multipliers = jnp.array([int(2**32 * alpha) | 1 for alpha in _lattice(d)], jnp.uint32)
    shift = bits(key, (d,))
    points = jnp.arange(n, dtype=jnp.uint32)[:, None] * multipliers[None] + shift[None]
    # The top 23 bits, at the middle of their cells, keep clear of -1 and 1 in float32 as well.
    centred = ((points >> 9).astype(dtype) + 0.5) * jnp.array(2.0**-22, dtype) - 1
    return normal_quantile(centred)


def stratified_uniform(key: Key[Array, ""], num_points: int) -> Float[Array, " n"]:
    """Uniform draws on [0, 1), one in each of n equal cells.

    The set is uniform; the order of the draws is that of the cells. No gap is wider than two cells.
    Use it for draws of equal weight, such as x_0.
    """
    cells = jnp.arange(num_points).astype(jnp.result_type(float))
    return (cells + uniform(key, (num_points,))) / num_points


def _lattice(dimension: int) -> list[float]:
    root = 2.0
    for _ in range(64):
        root = (1 + root) ** (1 / (dimension + 1))
    return [root ** -(j + 1) for j in range(dimension)]


NOISES = {"independent": independent_normal, "stratified": stratified_normal}
