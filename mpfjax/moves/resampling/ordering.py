"""The order of the particles of a component: by a number, or along a Hilbert curve."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree, UInt32

from mpfjax.checks import check_callable, saying, shown
from mpfjax.mixture import ParticleMixture, points
from mpfjax.operations.logarithms import as_inexact
from mpfjax.operations.segments import column_sums, spread
from mpfjax.operations.sorting import (
    bits_per_dimension,
    hilbert_index,
    order_by_key,
    sortable_bits,
)
from mpfjax.operations.stored import stored

HILBERT = "hilbert"
SortBy = Callable[[PyTree], Array] | str
_STEEPNESS = 1.702  # the logistic function of this multiple is nearly the normal CDF


def check_sort_by(sort_by: SortBy | None) -> None:
    """Raise a `ValueError` for what is neither a function, nor "hilbert", nor None."""
    if sort_by is not None and not (isinstance(sort_by, str) and sort_by == HILBERT):
        check_callable('a function of the particles, nor "hilbert"', sort_by=sort_by)


def sorted_order(
    mixture: ParticleMixture, labels: Int[Array, " n"], sort_by: SortBy
) -> Int[Array, " n"]:
    """The indices of the particles by label, in [0, M], and within each label by `sort_by`.

    Particles are sorted by one coordinate, or along a Hilbert curve through several. Each
    coordinate is standardised by the mean and deviation of the particle's component.
    """
    rows = _coordinates(mixture, sort_by)
    if rows.shape[0] == 1:
        if jnp.dtype(rows.dtype).itemsize > 4:
            return jnp.lexsort((rows[0], labels)).astype(jnp.int32)
        keys = sortable_bits(rows[0])
    else:
        num_bits = bits_per_dimension(rows.shape[0])
        keys = hilbert_index(_cells(as_inexact(rows), mixture, num_bits), num_bits)
    return order_by_key(keys, labels, mixture.num_components + 1)


def _coordinates(mixture: ParticleMixture, sort_by: SortBy) -> Array:
    """The coordinates by which the particles are sorted, (d, n): a row for each."""
    n = mixture.num_particles
    if isinstance(sort_by, str):
        leaves = [
            leaf.reshape(n, -1)
            for leaf in jax.tree.leaves(points(mixture.particles))
            if jnp.issubdtype(leaf.dtype, jnp.floating)
        ]
        if sum(leaf.shape[1] for leaf in leaves) == 0:
            raise ValueError(
                f"sort_by: {sort_by!r}, which noise='rqmc' stands for, sorts by the state's"
                " floating point numbers, and it has none; give a function of the particles"
            )
        dtype = jnp.result_type(*leaves)
        return jnp.concatenate([leaf.astype(dtype).T for leaf in leaves])
    with saying("in sort_by, which is called with the particles"):
        values: Any = sort_by(mixture.particles)
    if not isinstance(values, jax.Array | np.ndarray) or jnp.iscomplexobj(values):
        raise ValueError(f"sort_by: it returned {shown(values)}, no real array")
    if values.ndim not in (1, 2) or values.shape[0] != n or values.size == 0:
        raise ValueError(
            f"sort_by: it returned shape {values.shape}, not a number a particle, ({n},), nor"
            f" a few, ({n}, d)"
        )
    return jnp.asarray(values).reshape(n, -1).T


def _cells(
    rows: Float[Array, "d n"], mixture: ParticleMixture, num_bits: int
) -> UInt32[Array, "d n"]:
    """The cell of each coordinate, of 2^num_bits cells that hold about equally many particles."""
    labels, m = mixture.component_indicators, mixture.num_components
    rows = jnp.where(mixture.occupied[None], rows, 0.0)
    weights = mixture.component_weights.astype(rows.dtype)
    averages = lambda rows: column_sums(weights[None] * rows, labels, m)  # noqa: E731
    # The result of a gather is stored: operations fused with it would not be vectorised.
    own = lambda values: stored(  # noqa: E731
        jnp.stack([spread(column, labels) for column in jnp.nan_to_num(values).T])
    )
    centred = rows - own(averages(rows))
    variances = averages(centred**2)
    # Particles at a single point are all in the same cell.
    is_spread = (variances > 0) & (variances < jnp.inf)
    scales = own(jnp.where(is_spread, _STEEPNESS / jnp.sqrt(variances), 1.0))
    shares = jax.nn.sigmoid(centred * scales)
    size = float(1 << num_bits)
    return jnp.clip(jnp.nan_to_num(shares) * size, 0.0, size - 1).astype(jnp.uint32)
