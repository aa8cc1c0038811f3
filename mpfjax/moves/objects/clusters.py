"""Clusters of objects: separate particle filters that merge when objects meet.

Two objects are in contact where log ψ ≠ 0 between any of their predicted points. A cluster is a set
of objects linked by contact, directly or through others, and is named by its first object. Its rows
may take any point of each of its objects. Tables (J, n) have a line for each object. The lines of a
cluster's objects agree in the cluster's own quantities, since they are drawn with the same key.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from mpfjax.mixture import ParticleMixture, no_ancestors
from mpfjax.models.base import require
from mpfjax.models.multi_object import MultiObjectModel
from mpfjax.moves.base import Step
from mpfjax.moves.objects.independent import (
    AbstractPropagationByObject,
    draw_rows,
    move_objects,
    rows_of_each,
)
from mpfjax.moves.propagation.propagate import predict
from mpfjax.moves.regrouping.merge import lowest_connected
from mpfjax.moves.resampling.allocation import require_equal_rows
from mpfjax.operations.logarithms import default_float, finite_max, log_sum_exp, scaled_exp
from mpfjax.operations.matrices import draw_columns
from mpfjax.operations.random import split, uniform
from mpfjax.operations.stored import take

Table = Float[Array, "objects n"]
_GOLDEN = (np.sqrt(5) - 1) / 2


class PropagateInClusters(AbstractPropagationByObject):
    """Propagate, weight and resample clusters of objects, which merge when objects meet.

    Each object belongs to one cluster. A cluster has N rows, and a row contains a state of each of
    its objects. The joint distribution is the product of the clusters' distributions. At time 0
    every object is a separate cluster. One step, from rows of equal weight:

    1. *Predict.* Object j's point x^{jl} is drawn by its dynamics from row l, and L_j evaluated.
    2. *Merge.* Clusters are merged if log ψ ≠ 0 between any points of two of their objects,
       directly or through others. Row l of the new cluster is row l of each.
    3. *A single object* is resampled by its likelihood. The mean likelihood is its factor of Ẑ.
    4. *Objects in a cluster are recombined.* Object j's N points are a draw of q_j(x) = N⁻¹ Σ_r
       f_j(x | row r), the deterministic mixture of Owen and Zhou (2000), and serve every row r with
       the weight

           b_rjl = L_j(x^{jl}) f_j(x^{jl} | row r) / Σ_r' f_j(x^{jl} | row r').

       The update of row r is Σ b_r1l b_r2m ... ψ(x^{1l}, x^{2m}) ... over all combinations of
       points. First, N rows are drawn with probability ∝ Π_j Σ_l b_rjl. Then each row draws a point
       for one object after the other, ∝ b times ψ with the points drawn so far, and its weight is
       multiplied by Σ_l b ψ / Σ_l b. Different rows start with different objects. Last, the
       weighted rows are resampled. The factor of Ẑ is the mean score times the mean weight.
    5. The rows of every cluster are shifted, in a circle, by a random number of slots.

    Why it is unbiased. Given the rows, the points of different objects are independent. Each
    object's weighted points are an unbiased estimate of its prediction under any row, so the sum
    over combinations is an unbiased estimate of the cluster's update. Given the past, clusters are
    independent, so the expectation of their product is the product of the exact updates. If ψ is 1
    for all combinations of points of two clusters, that product is the joint update. After step 5
    all pairs of rows of two clusters are equally likely to be aligned, so a merged cluster is an
    unbiased estimate of the product. Whether two clusters merge depends on the points alone, not on
    which rows are aligned.

    In partitioned sampling, the evidence of one object eliminates hypotheses about another, in any
    order. Here it does not, and no object is first in all rows.

    - `start`: every object "apart", or all "together" in one cluster, for an x_0 under which the
      objects are dependent. A cluster never splits, because its objects remain dependent.

    Cost: J x N likelihoods per step, J(J-1) N² / 2 potentials to detect contact, and 2 N² J
    transition densities and J² N² potentials if there is a cluster of several.

    Particle i contains row i of every cluster. The move requires particles of equal weight, which
    x_0 has and which it returns. A row has no single ancestor, and the index -1.
    `memory["clusters"]["labels"]`, (J,), contains the first object of each object's cluster.

    Clusters require `log_transition` of the object model. A model whose state contains more than
    x_t, such as x_{t-1}, also requires `with_history(states, previous_states)`: the states with
    their past taken from the previous states.

    Raises `ValueError` for a mixture of several components, a model of one object, a model without
    `log_transition` if it is required, and an unknown `start`.
    """

    start: Literal["apart", "together"] = eqx.field(static=True, default="apart")

    approximate = False

    def check(self, now: Step, num_particles: int, num_components: int) -> None:
        """Raise a `ValueError` for a model of one object, or without the density it requires."""
        super().check(now, num_particles, num_components)
        if self._may_be_joint(now.model):
            require(now.model.object_model, "log_transition", "PropagateInClusters")

    def _may_be_joint(self, model: Any) -> bool:
        """Whether there can ever be a cluster of several objects."""
        joins = model.interaction is not None or self.start == "together"
        return joins and model.num_objects > 1

    def initial_memory(self, now: Step, num_components: int) -> dict[str, PyTree]:
        """The labels of the clusters."""
        labels = jnp.arange(now.model.num_objects, dtype=jnp.int32)
        labels = jnp.zeros_like(labels) if self.start == "together" else labels
        return {"clusters": {"labels": labels}}

    def __call__(self, key: Key[Array, ""], mixture: ParticleMixture, now: Step) -> ParticleMixture:
        """Merge the clusters that meet, then advance the filter of every cluster by one step.

        Where y_t is missing, all objects are predicted, and clusters stay.
        """
        model = now.model
        if now.is_missing:
            return predict(key, now.law, mixture, "none", "independent")
        require_equal_rows(mixture, "PropagateInClusters")
        num_objects = model.num_objects
        # The objects' keys are those of the joint draw, so that one object is a plain filter.
        keys = split(key, 2 * num_objects + 2)
        keys_objects, keys_rows = keys[:num_objects], keys[num_objects : 2 * num_objects]
        key_inside, key_shift = keys[2 * num_objects :]
        particles, labels = mixture.particles, mixture.memory["clusters"]["labels"]
        points, log_likelihoods = move_objects(model, keys_objects, particles, now.observation)
        common = jax.vmap(finite_max)(log_likelihoods)
        log_likelihoods = log_likelihoods - common[:, None]
        if self._may_be_joint(model):
            labels = lowest_connected(together(labels) | coupled(model, points, labels))
            particles, log_growth = self._update(
                model, (keys_rows, key_inside), particles, points, log_likelihoods, labels
            )
        else:
            rows, log_growth = self._resample_rows(keys_rows, labels, log_likelihoods)
            particles = rows_of_each(points, rows)
        # Row i is then a draw of the product of the clusters: any row of one cluster meets any row
        # of another with the same probability.
        keys_shift = take(split(key_shift, num_objects), labels)
        places = jnp.arange(mixture.num_particles, dtype=jnp.int32)
        particles = rows_of_each(particles, jax.vmap(rotate, (0, None))(keys_shift, places))
        moved = mixture.replace(
            particles=particles,
            ancestor_indices=no_ancestors(mixture),
            memory=mixture.memory | {"clusters": {"labels": labels}},
        ).reweight(log_growth[None], jnp.sum(common)[None])

        def impossible() -> ParticleMixture:
            nothing = jnp.full((1,), -jnp.inf, mixture.log_weights.dtype)
            return predict(key, now.law, mixture, "none", "independent").reweight(nothing)

        return jax.lax.cond(log_growth == -jnp.inf, impossible, lambda: moved)

    def _update(
        self,
        model: Any,
        keys: tuple,
        particles: PyTree,
        points: PyTree,
        log_likelihoods: Table,
        labels: Int[Array, " objects"],
    ) -> tuple[PyTree, Float[Array, ""]]:
        """The clusters' new rows, of equal weight, and log of their factors of Ẑ."""
        keys_rows, key_inside = keys
        key_cross, key_last = split(key_inside, 2)
        together_with = together(labels)
        alone = jnp.sum(together_with, axis=1) == 1
        log_totals, log_sums = scores(model, particles, points, log_likelihoods, alone)
        log_scores = jnp.sum(jnp.where(together_with[:, :, None], log_sums[None], 0.0), axis=1)
        rows, log_growth = self._resample_rows(keys_rows, labels, log_scores)

        def cross() -> tuple[PyTree, Float[Array, ""]]:
            log_point_weights = log_likelihoods - log_totals
            tables = rows, log_point_weights, log_sums, together_with
            moved, log_weights = recombine(model, key_cross, particles, points, *tables)
            keys_last = split(key_last, len(labels))
            last, log_gain = self._resample_rows(keys_last, labels, log_weights)
            # Without this, rounding could redraw equal weights.
            unmoved = jnp.arange(last.shape[1], dtype=last.dtype)
            last = jnp.where(alone[:, None], unmoved[None], last)
            return rows_of_each(moved, last), log_gain

        def stay() -> tuple[PyTree, Float[Array, ""]]:
            return rows_of_each(points, rows), jnp.zeros((), default_float())

        particles, log_gain = jax.lax.cond(jnp.all(alone), stay, cross)
        return particles, log_growth + log_gain

    def _resample_rows(
        self, keys: Key[Array, " objects"], labels: Int[Array, " objects"], log_weights: Table
    ) -> tuple[Int[Array, "objects n"], Float[Array, ""]]:
        """Each object's rows drawn anew, alike in a cluster, and log Π of the mean weights."""
        rows, log_growths = draw_rows(take(keys, labels), log_weights)
        is_first = labels == jnp.arange(len(labels), dtype=labels.dtype)
        return rows, jnp.sum(jnp.where(is_first, log_growths, 0.0))


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

    def touch(pair: tuple) -> Bool[Array, ""]:
        i, j = pair

        def look() -> Bool[Array, ""]:
            over_pairs = jax.vmap(partial(_with_each, interaction), in_axes=(0, None))
            log_psi = over_pairs(*(model.object_states(points, k) for k in pair))
            return jnp.any(log_psi != 0)

        return jax.lax.cond(labels[i] == labels[j], lambda: jnp.zeros((), bool), look)

    pairs = (jnp.asarray(first, jnp.int32), jnp.asarray(second, jnp.int32))
    half = jnp.zeros((num_objects, num_objects), bool).at[pairs].set(jax.lax.map(touch, pairs))
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
    log_likelihoods: Table,
    alone: Bool[Array, " objects"],
) -> tuple[Table, Table]:
    """log Σ_r f_j(x^{jl} | row r) of each point, and log Σ_l b_rjl of each row.

    An object alone needs neither: the score of its row is the likelihood of its own point.
    """

    def score(j: Int[Array, ""]) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
        def shared() -> tuple[Float[Array, " n"], Float[Array, " n"]]:
            log_f = jax.vmap(partial(_log_kernels, model, j), in_axes=(0, None))
            table = log_f(model.object_states(particles, j), model.object_states(points, j))
            log_totals = jax.vmap(log_sum_exp)(table.T)
            log_b = table + (log_likelihoods[j] - log_totals)[None]
            return log_totals, jax.vmap(log_sum_exp)(log_b)

        def single() -> tuple[Float[Array, " n"], Float[Array, " n"]]:
            return jnp.zeros_like(log_likelihoods[j]), log_likelihoods[j]

        return jax.lax.cond(alone[j], single, shared)

    return jax.lax.map(score, jnp.arange(len(alone), dtype=jnp.int32))


def recombine(
    model: MultiObjectModel,
    key: Key[Array, ""],
    particles: PyTree,
    points: PyTree,
    rows: Int[Array, "objects n"],
    log_point_weights: Table,
    log_sums: Table,
    together: Bool[Array, "objects objects"],
) -> tuple[PyTree, Table]:
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
