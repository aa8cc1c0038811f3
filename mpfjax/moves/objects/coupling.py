"""Objects that meet: contact, the clusters that follow from it, and what their rows exchange.

Two objects are in contact where log ψ ≠ 0 between any of their predicted points. A cluster is a set
of objects linked by contact, directly or through others, and is named by its first object. Its rows
may take any point of each of its objects: the mathematics of step 4 of `PropagateInClusters`.
Tables (J, n) have a line for each object. The lines of a cluster's objects agree in the cluster's
own quantities, since they are drawn with the same key.
"""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from mpfjax.models.multi_object import MultiObjectModel
from mpfjax.operations.logarithms import default_float, log_sum_exp, scaled_exp
from mpfjax.operations.matrices import draw_columns
from mpfjax.operations.random import split, uniform

_GOLDEN = (np.sqrt(5) - 1) / 2


def coupled(
    model: MultiObjectModel, points: PyTree, labels: Int[Array, " objects"]
) -> Bool[Array, "objects objects"]:
    """Which objects have points between which ψ ≠ 1, over all pairs of their points.

    It is not computed within a cluster, which never splits.
    """
    num_objects, interaction = model.num_objects, model.interaction
    if interaction is None:
        return jnp.zeros((num_objects, num_objects), bool)
    first, second = np.triu_indices(num_objects, 1)

    def touch(carry: None, pair: tuple) -> tuple[None, Bool[Array, ""]]:
        i, j = pair

        def look() -> Bool[Array, ""]:
            over_pairs = jax.vmap(partial(_with_each, interaction), in_axes=(0, None))
            log_psi = over_pairs(*(model.object_states(points, k) for k in pair))
            return jnp.any(log_psi != 0)

        return carry, jax.lax.cond(labels[i] == labels[j], lambda: jnp.zeros((), bool), look)

    pairs = (jnp.asarray(first, jnp.int32), jnp.asarray(second, jnp.int32))
    _, touches = jax.lax.scan(touch, None, pairs)
    half = jnp.zeros((num_objects, num_objects), bool).at[pairs].set(touches)
    return half | half.T


def together(labels: Int[Array, " objects"]) -> Bool[Array, "objects objects"]:
    """Which two objects are in one cluster."""
    return labels[:, None] == labels[None]


def _with_each(function: Callable[..., Array], state: PyTree, others: PyTree) -> Array:
    """A function of the states of equal rows, of one state and many others."""
    repeated = jax.tree.map(lambda a, b: jnp.broadcast_to(a[None], b.shape), state, others)
    return function(repeated, others)


def scores(
    model: MultiObjectModel,
    particles: PyTree,
    points: PyTree,
    log_likelihoods: Float[Array, "objects n"],
    alone: Bool[Array, " objects"],
) -> tuple[Float[Array, "objects n"], Float[Array, "objects n"]]:
    """log Σ_r f_j(x^{jl} | row r) of each point, and log Σ_l b_rjl of each row.

    An object alone needs neither: the score of its row is the likelihood of its own point.
    """

    def score(carry: None, j: Int[Array, ""]) -> tuple[None, tuple]:
        def shared() -> tuple[Float[Array, " n"], Float[Array, " n"]]:
            log_f = jax.vmap(partial(_log_kernels, model, j), in_axes=(0, None))
            table = log_f(model.object_states(particles, j), model.object_states(points, j))
            log_totals = jax.vmap(log_sum_exp)(table.T)
            log_b = table + (log_likelihoods[j] - log_totals)[None]
            return log_totals, jax.vmap(log_sum_exp)(log_b)

        def single() -> tuple[Float[Array, " n"], Float[Array, " n"]]:
            return jnp.zeros_like(log_likelihoods[j]), log_likelihoods[j]

        return carry, jax.lax.cond(alone[j], single, shared)

    objects = jnp.arange(len(alone), dtype=jnp.int32)
    return jax.lax.scan(score, None, objects)[1]


def recombine(
    model: MultiObjectModel,
    key: Key[Array, ""],
    particles: PyTree,
    points: PyTree,
    rows: Int[Array, "objects n"],
    log_point_weights: Float[Array, "objects n"],
    log_sums: Float[Array, "objects n"],
    together: Bool[Array, "objects objects"],
) -> tuple[PyTree, Float[Array, "objects n"]]:
    """The points that each row takes, and the factor of its cluster's weight."""
    num_objects, num_particles = log_sums.shape
    key_start, key_points = split(key, 2)
    ks = jnp.arange(num_particles, dtype=jnp.int32)
    starts = rotate(key_start, jnp.arange(num_objects, dtype=jnp.int32))[ks % num_objects]
    alone = jnp.sum(together, axis=1) == 1
    by_object = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 1, 0), points)
    strides = _GOLDEN * np.arange(num_particles) % 1

    def choose(carry: tuple, inputs: tuple) -> tuple[tuple, None]:
        moved, log_weights, has_moved = carry
        key, rank = inputs
        objects = (starts + rank) % num_objects  # whose turn it is in each row
        parent_rows = rows[objects, ks]
        parents = jax.tree.map(lambda leaf: leaf[parent_rows, objects], particles)
        object_points = jax.tree.map(lambda leaf: leaf[objects], by_object)
        log_b = jax.vmap(partial(_log_kernels, model))(objects, parents, object_points)
        log_b = log_b + log_point_weights[objects]
        partners = has_moved & together[objects]
        log_psi = _log_potentials(model, moved, partners, object_points)
        log_table = log_b + log_psi
        # One random shift serves all rows, and the quantile of each next row is a golden-ratio step
        # further: each is uniform, and a run of equal rows draws evenly.
        quantiles = (strides.astype(log_table.dtype) + uniform(key, (), log_table.dtype)) % 1
        weights, _ = jax.vmap(scaled_exp)(jax.lax.stop_gradient(log_table))
        places, log_gain = draw_columns(quantiles, weights), jax.vmap(log_sum_exp)(log_table)
        before = log_sums[objects, parent_rows]
        # A row without weight is drawn only if no row of the cluster has any.
        counts = jnp.any(partners, axis=1) & (before != -jnp.inf)
        log_gain = jnp.where(counts, log_gain - jnp.where(counts, before, 0.0), 0.0)
        places = jnp.where(alone[objects], parent_rows, places)
        states = jax.tree.map(lambda leaf: leaf[places, objects], points)
        states = model.object_with_history(states, parents, objects)
        moved = model.replace_object(moved, objects, states)
        log_weights += jnp.where(together[objects].T, log_gain[None], 0.0)
        moves = objects[:, None] == jnp.arange(num_objects, dtype=jnp.int32)[None]
        return (moved, log_weights, has_moved | moves), None

    has_moved = jnp.zeros((num_particles, num_objects), bool)
    carry = (particles, jnp.zeros_like(log_sums), has_moved)
    inputs = (split(key_points, num_objects), jnp.arange(num_objects, dtype=jnp.int32))
    (moved, log_weights, _), _ = jax.lax.scan(choose, carry, inputs)
    return moved, log_weights


def _log_kernels(
    model: MultiObjectModel, j: Int[Array, ""], parent: PyTree, points: PyTree
) -> Float[Array, " n"]:
    """log f_j of the points of one object given one parent."""

    def log_f(parents: PyTree, points: PyTree) -> Float[Array, " n"]:
        return model.object_log_transition(points, parents, j)

    return _with_each(log_f, parent, points).astype(default_float())


def _log_potentials(
    model: MultiObjectModel, moved: PyTree, partners: Bool[Array, "n objects"], points: PyTree
) -> Float[Array, "n n"]:
    """Σ log ψ of the partners in row k with its point l, in line k and column l."""
    interaction, num = model.interaction, len(partners)
    total = jnp.zeros((num, num), default_float())
    if interaction is None:
        return total
    of_row = jax.vmap(partial(_with_each, interaction))

    def add(total: Float[Array, "n n"], inputs: tuple) -> tuple[Float[Array, "n n"], None]:
        i, meets = inputs
        log_psi = of_row(model.object_states(moved, i), points).astype(total.dtype)
        return total + jnp.where(meets[:, None], log_psi, 0.0), None

    objects = jnp.arange(partners.shape[1], dtype=jnp.int32)
    return jax.lax.scan(add, total, (objects, partners.T))[0]


def rotate(key: Key[Array, ""], indices: Int[Array, " k"]) -> Int[Array, " k"]:
    """The numbers 0, ..., k-1 in a circle, starting from a random one."""
    return (indices + jax.random.randint(key, (), 0, len(indices), indices.dtype)) % len(indices)
