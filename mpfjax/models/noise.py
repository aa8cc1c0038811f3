"""Standard normal and uniform draws: independent, or distributed evenly over particles."""

from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key, PyTree, UInt32

from mpfjax.operations import random
from mpfjax.operations.logarithms import default_float
from mpfjax.operations.segments import first_places, spread
from mpfjax.operations.stored import stored

Noise = Literal["independent", "rqmc"]
_UNUSED = 9  # bits of 32 that no draw of 23 bits shows


def draw_noise(
    key: Key[Array, ""],
    kind: str,
    shape: tuple[int, ...],
    dtype: jnp.dtype,
    components: Int[Array, " n"] | None = None,
    num_components: int = 1,
    shuffle: bool = False,
) -> Float[Array, "n d"]:
    """Standard normal draws, one row a particle, that cover the normal evenly if not "independent".

    Every single row is exactly normal and independent of the past, so that a sum over particles
    keeps its expectation; rows are negatively dependent, and the sum has less variance.

    "stratified": row i is the Gaussian quantile of the fractional part of i α + U: a lattice
    shifted by one uniform number U in each dimension. α_j = φ_d^{-j}, where φ_d solves
    x^{d+1} = x + 1; for d = 1 it is the golden ratio. Points are dealt to the rows anew each time.

    "rqmc": a randomised point set for each component, whose r-th slot gets point r. Systematic
    resampling of k slots takes its points at (r + U) / k, so slot and noise together are a point
    set of d + 1 dimensions: where particles stand in the order of their states, the step is array
    randomised quasi-Monte Carlo (L'Ecuyer, Lécot and Tuffin 2008). In two dimensions or more,
    point r is that of Sobol, its digits scrambled by a random matrix and shifted. In one it is the
    fractional part of r times the golden ratio plus a random shift: any run of neighbours is then
    spread evenly, as narrow likelihoods ask for. Each component has a shift of its own, so the
    noise of any two particles of different components is independent. Where particles stand as
    they did when they were last moved, the same slot would get the same point again, and two steps
    would be functions of each other. `shuffle` deals the points anew.
    """
    if kind == "independent":
        return random.normal(key, shape, dtype)
    n, d = shape
    key_first, key_second = random.split(key, 2)
    if kind == "stratified":
        ranks = _scramble_ranks(key_second, jnp.arange(n, dtype=jnp.int32)).astype(jnp.uint32)
        points = ranks[:, None] * _multipliers(d)[None] + random.bits(key_first, (d,))[None]
        return normal_of(points, dtype)
    ranks = jnp.arange(n, dtype=jnp.int32)
    shifts = stored(random.bits(key_second, (num_components, d)) >> _UNUSED)
    if components is None or num_components == 1:
        shifts = shifts.T << _UNUSED
    else:
        ranks = stored(ranks - spread(first_places(components, num_components), components))
        of_slots = jnp.stack([spread(shifts[:, k], components) for k in range(d)])
        shifts = stored(of_slots) << _UNUSED
    if shuffle:
        ranks = _scramble_ranks(jax.random.fold_in(key_second, 1), ranks)
    if d == 1:
        points = (ranks.astype(jnp.uint32) * _multipliers(1))[None] + shifts
    else:
        directions = random.scrambled_directions(key_first, d, _num_digits(n))
        points = random.sobol_points(ranks, directions) ^ shifts
    # Drawn row by row, then transposed: operations on short rows are not vectorised.
    return stored(normal_of(points, dtype)).T


def _scramble_ranks(key: Key[Array, ""], ranks: Int[Array, " n"]) -> Int[Array, " n"]:
    dealt = random.scramble(ranks, random.bits(key, ()), _num_digits(ranks.shape[0]))
    return stored(dealt.astype(jnp.int32))


def _num_digits(num_ranks: int) -> int:
    return max((num_ranks - 1).bit_length(), 1)


def normal_of(points: Array, dtype: jnp.dtype) -> Float[Array, "..."]:
    """Quantiles of the standard normal at points in units of 2^-32."""
    return random.normal_quantile(2 * uniform_of(points, dtype) - 1)


def uniform_of(points: Array, dtype: jnp.dtype) -> Float[Array, "..."]:
    """Points in units of 2^-32 as numbers in (0, 1)."""
    # The top 23 bits, at the middle of their cells, keep clear of 0 and 1 in float32 as well.
    return ((points >> _UNUSED).astype(dtype) + 0.5) * jnp.array(2.0**-23, dtype)


def stratified_uniform(key: Key[Array, ""], num_points: int) -> Float[Array, " n"]:
    """Uniform draws on [0, 1), one in each of n equal cells.

    The set is uniform; the order of the draws is that of the cells. No gap is wider than two cells.
    Use it for draws of equal weight, such as x_0.
    """
    cells = jnp.arange(num_points).astype(jnp.result_type(float))
    return (cells + random.uniform(key, (num_points,))) / num_points


def noise_dtype(states: PyTree) -> jnp.dtype:
    """The type of the noise that moves these states: that of their floating point leaves."""
    leaves = jax.tree.leaves(eqx.filter(states, eqx.is_inexact_array))
    return jnp.finfo(jnp.result_type(*leaves)).dtype if leaves else default_float()


def _multipliers(dimension: int) -> UInt32[Array, " d"]:
    """α in units of 2^-32: floating point would lose the fraction of i α for large i."""
    root = 2.0
    for _ in range(64):
        root = (1 + root) ** (1 / (dimension + 1))
    return jnp.array([int(2**32 * root ** -(j + 1)) | 1 for j in range(dimension)], jnp.uint32)
