"""Clusters of objects: particle filters of their own that merge where objects meet."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from mpfjax.checks import check_one_of, check_whole, given
from mpfjax.mixture import ParticleMixture, single_component
from mpfjax.models.base import require
from mpfjax.models.multi_object import MultiObjectModel, require_multi_object
from mpfjax.moves.base import AbstractPropagation
from mpfjax.moves.resampling import Resample
from mpfjax.moves.slots import require_all_slots
from mpfjax.operations.floats import default_float
from mpfjax.operations.generator import split, uniform
from mpfjax.operations.indexing import take
from mpfjax.operations.logarithms import finite_max
from mpfjax.operations.matrices import draw_columns

STARTS = ("apart", "together")
_GOLDEN = (np.sqrt(5) - 1) / 2


class PropagateInClusters(AbstractPropagation):
    """Propagate, weigh and resample clusters of objects, which merge where objects meet.

    The objects are parted into clusters, and the joint distribution is the product of the
    clusters' clouds of N rows each. At the start every object is a cluster. One step, from rows
    of equal weight:

    1. *Predict.* Object j's point x^{jl} is drawn by its dynamics from row l, and L_j evaluated.
    2. *Merge.* Clusters become one where log ψ ≠ 0 between any points of two of their objects,
       directly or through others. Row l of the new cluster is row l of each.
    3. *An object alone* is resampled by its likelihood, whose mean is its factor of Ẑ.
    4. *Objects in a cluster cross between rows.* Object j's N points are a draw of
       q_j(x) = N⁻¹ Σ_r f_j(x | row r), the deterministic mixture of Owen and Zhou (2000), and
       serve every row r with the weight

           b_rjl = L_j(x^{jl}) f_j(x^{jl} | row r) / Σ_r' f_j(x^{jl} | row r').

       The update of row r is Σ b_r1l b_r2m ... ψ(x^{1l}, x^{2m}) ... over all combinations of
       points. N rows are drawn ∝ Π_j Σ_l b_rjl, and then for each its objects' points, ∝ b times
       ψ with the points already chosen, the row's weight multiplied by Σ_l b ψ / Σ_l b. A row
       starts with an object of its own and goes round, so that no object goes first in all of
       them. The weighted rows are resampled; the factor of Ẑ is the mean score times the mean
       weight.
    5. Every cluster's rows are turned by a random number of places.

    Unbiased: given the rows, points of different objects are independent and each object's
    weighted points are an unbiased estimate of its prediction under any row, so the sum over
    combinations is one of the cluster's update. Given the past, clusters are independent, so
    that the expectation of their product is the product of the exact updates, and where no ψ
    between clusters differs from 1 on any combination of their points, that product is the joint
    update already. After step 5 all pairs of rows of two clusters are equally likely to stand
    side by side, so a merged cluster is an unbiased estimate of the product; and whether they
    merge depends on the points alone, not on who stands beside whom.

    What a row loses by the evidence of one object costs another object no hypotheses, which is
    what partitioned sampling in any order suffers from; and no object goes first in all rows.

    - `start`: every object "apart", or all "together" in one cluster, as for an x_0 under which
      the objects are not independent.
    - `split_after`: None never splits a cluster, which is exact. A number s parts what had no
      contact for s steps, directly or through others, and goes on with the product of the
      marginals: an approximation (`approximate` is true).
    - `scheme`: of resampling, as in `Resample`.

    Cost: J x N likelihoods a step, J(J-1) N² / 2 potentials to find contact, and 2 N² J
    transition densities and J² N² potentials where there is a cluster of several.

    Particle i holds row i of every cluster, all with equal weight; the particles that the move
    is given must be so, as those of x_0 and its own are. A row has no single ancestor, and is
    its own. The clusters are in `memory["clusters"]["labels"]`, (J,): the first object of each
    object's cluster.

    Clusters need the object model's `log_transition`, and where its state holds more of the
    past than x_t also `with_history(states, previous_states)`, the states with their past
    replaced by that which follows from the previous states.

    Raises `ValueError` for a mixture of several components, a model of one object, a model
    without `log_transition` where it is needed, and an unknown `start` or scheme, or
    `split_after` below 1.
    """

    model: MultiObjectModel
    start: str = eqx.field(static=True, default="apart")
    split_after: int | None = eqx.field(static=True, default=None)
    scheme: str = eqx.field(static=True, default="systematic")

    def __check_init__(self) -> None:
        require_multi_object(self.model, "PropagateInClusters")
        Resample(self.scheme)  # raises where there is no such scheme
        check_one_of(STARTS, start=self.start)
        check_whole(**given(split_after=self.split_after))
        if self._may_be_joint:
            require(self.model.object_model, "log_transition", "PropagateInClusters")

    @property
    def approximate(self) -> bool:
        """Whether clusters are split again."""
        return self.split_after is not None

    @property
    def _may_be_joint(self) -> bool:
        """Whether there can ever be a cluster of several objects."""
        joins = self.model.interaction is not None or self.start == "together"
        return joins and self.model.num_objects > 1

    def initial_memory(self, num_components: int) -> dict[str, PyTree]:
        """The clusters' labels, and for how many steps each two objects had no contact."""
        del num_components
        num_objects = self.model.num_objects
        labels = jnp.arange(num_objects, dtype=jnp.int32)
        if self.start == "together":
            labels = jnp.zeros_like(labels)
        steps_apart = jnp.zeros((num_objects, num_objects), jnp.int32)
        return {"clusters": {"labels": labels, "steps_apart": steps_apart}}

    def __call__(
        self, key: Key[Array, ""], mixture: ParticleMixture, observation: PyTree
    ) -> ParticleMixture:
        """One step of every cluster's filter, those that meet merged before."""
        if mixture.num_components != 1:
            raise ValueError(f"mixture: {mixture.num_components} components, not one")
        require_all_slots(mixture, "PropagateInClusters")
        num_objects = self.model.num_objects
        # The objects' keys are those of the joint draw, so that one object is a plain filter.
        keys = split(key, 2 * num_objects + 2)
        keys_objects, keys_rows = keys[:num_objects], keys[num_objects : 2 * num_objects]
        key_inside, key_shift = keys[2 * num_objects :]
        seen = self.model.prepare_observation(observation)
        particles, memory = mixture.particles, mixture.memory["clusters"]

        def move(key: Key[Array, ""], states: PyTree, j: Int[Array, ""]) -> tuple:
            points = self.model.sample_object_transition(key, states, j)
            log_likelihood = self.model.object_log_likelihood(seen, points, j)
            return points, log_likelihood.astype(default_float())

        points, log_likelihoods = jax.vmap(move, in_axes=(0, 1, 0), out_axes=(1, 0))(
            keys_objects, particles, jnp.arange(num_objects, dtype=jnp.int32)
        )
        common = jax.vmap(finite_max)(log_likelihoods)
        log_likelihoods = log_likelihoods - common[:, None]
        if self._may_be_joint:
            memory = self._regrouped(points, memory)
            particles, log_growth = self._updated(
                (keys_rows, key_inside), particles, points, log_likelihoods, memory["labels"]
            )
        else:
            rows, log_growth = self._resampled(keys_rows, memory["labels"], log_likelihoods)
            particles = _rows_of_each(points, rows)
        particles = _shifted(key_shift, particles, memory["labels"])
        moved = mixture.replace(
            particles=particles, memory=mixture.memory | {"clusters": memory}
        ).weighed(log_growth[None], jnp.sum(common)[None])
        return jax.lax.cond(
            log_growth == -jnp.inf, lambda: self._unweighted(key, mixture), lambda: moved
        )

    def predict(self, key: Key[Array, ""], mixture: ParticleMixture) -> ParticleMixture:
        """Draw x_t ~ D(. | x_{t-1}) of all objects; the clusters stay."""
        return mixture.replace(particles=self.model.sample_transition(key, mixture.particles))

    def _unweighted(self, key: Key[Array, ""], mixture: ParticleMixture) -> ParticleMixture:
        nothing = jnp.full((1,), -jnp.inf, mixture.log_weights.dtype)
        return self.predict(key, mixture).weighed(nothing)

    def _updated(
        self,
        keys: tuple,
        particles: PyTree,
        points: PyTree,
        log_likelihoods: Float[Array, "objects n"],
        labels: Int[Array, " objects"],
    ) -> tuple[PyTree, Float[Array, ""]]:
        """The clusters' new rows, of equal weight, and log of their factors of Ẑ."""
        keys_rows, key_inside = keys
        key_cross, key_last = split(key_inside, 2)
        together = _together(labels)
        alone = jnp.sum(together, axis=1) == 1
        log_totals, log_sums = self._scores(particles, points, log_likelihoods, alone)
        log_scores = jnp.sum(jnp.where(together[:, :, None], log_sums[None], 0.0), axis=1)
        rows, log_growth = self._resampled(keys_rows, labels, log_scores)

        def cross() -> tuple[PyTree, Float[Array, ""]]:
            chosen, log_weights = self._crossed(
                key_cross, particles, points, rows, log_likelihoods - log_totals, log_sums, together
            )
            keys_last = split(key_last, len(labels))
            last, log_gain = self._resampled(keys_last, labels, log_weights)
            # Rounding could still redraw equal weights.
            unmoved = jnp.arange(last.shape[1], dtype=last.dtype)
            last = jnp.where(alone[:, None], unmoved[None], last)
            return _rows_of_each(chosen, last), log_gain

        def stay() -> tuple[PyTree, Float[Array, ""]]:
            return _rows_of_each(points, rows), jnp.zeros((), default_float())

        particles, log_gain = jax.lax.cond(jnp.all(alone), stay, cross)
        return particles, log_growth + log_gain

    def _regrouped(self, points: PyTree, memory: dict[str, Array]) -> dict[str, Array]:
        """The clusters of the objects whose predicted points are given."""
        touching = self._touching(points, memory["labels"])
        links, steps_apart = _together(memory["labels"]), memory["steps_apart"]
        if self.split_after is not None:
            steps_apart = jnp.where(touching, 0, steps_apart + 1)
            links = links & (steps_apart < self.split_after)
        return {"labels": _components(links | touching), "steps_apart": steps_apart}

    def _touching(
        self, points: PyTree, labels: Int[Array, " objects"]
    ) -> Bool[Array, "objects objects"]:
        """Which objects have points between which ψ ≠ 1, over all pairs of their points.

        Within a cluster that never splits nobody asks.
        """
        num_objects, interaction = self.model.num_objects, self.model.interaction
        if interaction is None:
            return jnp.zeros((num_objects, num_objects), bool)
        first, second = np.triu_indices(num_objects, 1)

        def touch(carry: None, pair: tuple) -> tuple[None, Bool[Array, ""]]:
            i, j = pair

            def look() -> Bool[Array, ""]:
                log_psi = _over_pairs(interaction)(self._of(points, i), self._of(points, j))
                return jnp.any(log_psi != 0)

            if self.split_after is not None:
                return carry, look()
            return carry, jax.lax.cond(labels[i] == labels[j], lambda: jnp.zeros((), bool), look)

        pairs = (jnp.asarray(first, jnp.int32), jnp.asarray(second, jnp.int32))
        _, touches = jax.lax.scan(touch, None, pairs)
        half = jnp.zeros((num_objects, num_objects), bool).at[pairs].set(touches)
        return half | half.T

    # Tables (J, n) have a line for each object; those of its cluster agree where the entry
    # belongs to the cluster, drawn with the same key.

    def _scores(
        self,
        particles: PyTree,
        points: PyTree,
        log_likelihoods: Float[Array, "objects n"],
        alone: Bool[Array, " objects"],
    ) -> tuple[Float[Array, "objects n"], Float[Array, "objects n"]]:
        """log Σ_r f_j(x^{jl} | row r) of each point, and log Σ_l b_rjl of each row.

        An object alone needs neither: its row is worth what its own point is.
        """

        def score(carry: None, j: Int[Array, ""]) -> tuple[None, tuple]:
            def shared() -> tuple[Float[Array, " n"], Float[Array, " n"]]:
                model: Any = self.model.object_at(j)
                log_f = _over_pairs(lambda parent, point: model.log_transition(point, parent))
                table = log_f(self._of(particles, j), self._of(points, j)).astype(default_float())
                log_totals = _log_sums(table.T)
                log_b = table + (log_likelihoods[j] - log_totals)[None]
                return log_totals, _log_sums(log_b)

            def own() -> tuple[Float[Array, " n"], Float[Array, " n"]]:
                return jnp.zeros_like(log_likelihoods[j]), log_likelihoods[j]

            return carry, jax.lax.cond(alone[j], own, shared)

        objects = jnp.arange(len(alone), dtype=jnp.int32)
        return jax.lax.scan(score, None, objects)[1]

    def _crossed(
        self,
        key: Key[Array, ""],
        particles: PyTree,
        points: PyTree,
        rows: Int[Array, "objects n"],
        log_point_weights: Float[Array, "objects n"],
        log_sums: Float[Array, "objects n"],
        together: Bool[Array, "objects objects"],
    ) -> tuple[PyTree, Float[Array, "objects n"]]:
        """The points that each row takes, and what its cluster's weight is multiplied by."""
        num_objects, num_particles = log_sums.shape
        key_start, key_points = split(key, 2)
        ks = jnp.arange(num_particles, dtype=jnp.int32)
        starts = _rotated(key_start, jnp.arange(num_objects, dtype=jnp.int32))[ks % num_objects]
        alone = jnp.sum(together, axis=1) == 1
        by_object = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 1, 0), points)

        def choose(carry: tuple, inputs: tuple) -> tuple[tuple, None]:
            chosen, log_weights, has_moved = carry
            key, rank = inputs
            objects = (starts + rank) % num_objects  # whose turn it is in each row
            parent_rows = rows[objects, ks]
            parents = jax.tree.map(lambda leaf: leaf[parent_rows, objects], particles)
            own = jax.tree.map(lambda leaf: leaf[objects], by_object)
            log_b = jax.vmap(self._log_kernels)(objects, parents, own)
            log_b = log_b + log_point_weights[objects]
            partners = has_moved & together[objects]
            log_psi = self._log_potentials(chosen, partners, own)
            picked, log_gain = _draw_columns(key, log_b + log_psi)
            before = log_sums[objects, parent_rows]
            # A row without weight is in line only where the whole cluster has none.
            counts = jnp.any(partners, axis=1) & (before != -jnp.inf)
            log_gain = jnp.where(counts, log_gain - jnp.where(counts, before, 0.0), 0.0)
            picked = jnp.where(alone[objects], parent_rows, picked)
            states = jax.tree.map(lambda leaf: leaf[picked, objects], points)
            states = jax.vmap(self._with_history)(objects, states, parents)
            chosen = self.model.replace_object(chosen, objects, states)
            log_weights += jnp.where(together[objects].T, log_gain[None], 0.0)
            moves = objects[:, None] == jnp.arange(num_objects, dtype=jnp.int32)[None]
            return (chosen, log_weights, has_moved | moves), None

        has_moved = jnp.zeros((num_particles, num_objects), bool)
        carry = (particles, jnp.zeros_like(log_sums), has_moved)
        inputs = (
            split(key_points, num_objects),
            jnp.arange(num_objects, dtype=jnp.int32),
        )
        (chosen, log_weights, _), _ = jax.lax.scan(choose, carry, inputs)
        return chosen, log_weights

    # Parts of the above.

    def _resampled(
        self,
        keys: Key[Array, " objects"],
        labels: Int[Array, " objects"],
        log_weights: Float[Array, "objects n"],
    ) -> tuple[Int[Array, "objects n"], Float[Array, ""]]:
        """Each object's rows drawn anew, alike in a cluster, and log Π of the mean weights."""
        resample = Resample(self.scheme)

        def draw(key: Key[Array, ""], log_weights: Float[Array, " n"]) -> tuple:
            cloud = single_component(log_weights).weighed(log_weights)
            return resample(key, cloud).ancestor_indices, cloud.log_mass

        rows, log_growths = jax.vmap(draw)(take(keys, labels), log_weights)
        is_first = labels == jnp.arange(len(labels), dtype=labels.dtype)
        return rows, jnp.sum(jnp.where(is_first, log_growths, 0.0))

    def _of(self, particles: PyTree, j: Int[Array, ""]) -> PyTree:
        return self.model.object_states(particles, j)

    def _log_kernels(self, j: Int[Array, ""], parent: PyTree, points: PyTree) -> Float[Array, " n"]:
        """log f_j of the points of one object given one parent."""
        model: Any = self.model.object_at(j)
        return model.log_transition(points, _alike(parent, points)).astype(default_float())

    def _with_history(self, j: Int[Array, ""], state: PyTree, parent: PyTree) -> PyTree:
        """The state as a child of another parent than the one that it was drawn from."""
        replace_past = getattr(self.model.object_at(j), "with_history", None)
        if replace_past is None:
            return state
        many = lambda state: jax.tree.map(lambda leaf: leaf[None], state)  # noqa: E731
        return jax.tree.map(lambda leaf: leaf[0], replace_past(many(state), many(parent)))

    def _log_potentials(
        self, chosen: PyTree, partners: Bool[Array, "n objects"], points: PyTree
    ) -> Float[Array, "n n"]:
        """Σ log ψ of the partners in row k with its point l, in line k and column l."""
        interaction, num = self.model.interaction, len(partners)
        total = jnp.zeros((num, num), default_float())
        if interaction is None:
            return total
        of_row = jax.vmap(lambda state, points: interaction(_alike(state, points), points))

        def add(total: Float[Array, "n n"], inputs: tuple) -> tuple[Float[Array, "n n"], None]:
            i, meets = inputs
            log_psi = of_row(self._of(chosen, i), points).astype(total.dtype)
            return total + jnp.where(meets[:, None], log_psi, 0.0), None

        objects = jnp.arange(partners.shape[1], dtype=jnp.int32)
        return jax.lax.scan(add, total, (objects, partners.T))[0]


def _alike(state: PyTree, others: PyTree) -> PyTree:
    """The same state beside each of the others."""
    return jax.tree.map(lambda a, b: jnp.broadcast_to(a[None], b.shape), state, others)


def _over_pairs(
    function: Callable[[PyTree, PyTree], Float[Array, " n"]],
) -> Callable[[PyTree, PyTree], Float[Array, "n n"]]:
    """A function of the states of equal rows, made one of all pairs of rows."""
    of_one = lambda state, others: function(_alike(state, others), others)  # noqa: E731
    return jax.vmap(of_one, in_axes=(0, None))


def _draw_columns(
    key: Key[Array, ""], log_table: Float[Array, "n n"]
) -> tuple[Int[Array, " n"], Float[Array, " n"]]:
    """A column of each line, drawn in proportion to its entries, and log of the line's sum.

    One shift is drawn for all lines, whose quantiles follow each other in golden strides: each is
    uniform, and any stretch of lines that are equal draws evenly.
    """
    strides = _GOLDEN * np.arange(log_table.shape[0])
    shift = uniform(key, (), log_table.dtype)
    quantiles = (jnp.asarray(strides % 1, log_table.dtype) + shift) % 1
    weights = jnp.exp(jax.lax.stop_gradient(log_table) - _finite_max(log_table)[:, None])
    return draw_columns(quantiles, weights), _log_sums(log_table)


def _log_sums(log_table: Float[Array, "k n"]) -> Float[Array, " k"]:
    """log Σ exp of every line, -inf where all of it is, with a finite gradient there."""
    shift = _finite_max(log_table)
    total = jnp.sum(jnp.exp(log_table - shift[:, None]), axis=1)
    empty = total == 0  # NaN is not: it must come out as NaN
    return jnp.where(empty, -jnp.inf, jnp.log(jnp.where(empty, 1.0, total)) + shift)


def _finite_max(log_table: Float[Array, "k n"]) -> Float[Array, " k"]:
    largest = jnp.max(jax.lax.stop_gradient(log_table), axis=1)
    return jnp.where(jnp.isfinite(largest), largest, 0.0)


def _rows_of_each(particles: PyTree, rows: Int[Array, "objects n"]) -> PyTree:
    """Every object's states from rows of its own."""
    gather = jax.vmap(take, in_axes=(1, 0), out_axes=1)
    return jax.tree.map(lambda leaf: gather(leaf, rows), particles)


def _shifted(key: Key[Array, ""], particles: PyTree, labels: Int[Array, " objects"]) -> PyTree:
    """The rows of every cluster turned by a random number of places.

    Row i is then a draw of the product of the clouds: any two rows of two clusters meet in it
    with the same probability.
    """
    places = jnp.arange(jax.tree.leaves(particles)[0].shape[0], dtype=jnp.int32)
    keys = take(split(key, len(labels)), labels)
    return _rows_of_each(particles, jax.vmap(_rotated, in_axes=(0, None))(keys, places))


def _rotated(key: Key[Array, ""], indices: Int[Array, " k"]) -> Int[Array, " k"]:
    """The numbers 0, ..., k-1 from a random one on, and round."""
    return (indices + jax.random.randint(key, (), 0, len(indices), indices.dtype)) % len(indices)


def _together(labels: Int[Array, " objects"]) -> Bool[Array, "objects objects"]:
    return labels[:, None] == labels[None]


def _components(linked: Bool[Array, "objects objects"]) -> Int[Array, " objects"]:
    """The first object that each can be reached from; `linked` is symmetric."""
    reach = linked | jnp.eye(len(linked), dtype=bool)
    for _ in range(max(len(linked) - 1, 1).bit_length()):
        reach = jnp.any(reach[:, :, None] & reach[None], axis=1)
    return jnp.argmax(reach, axis=1).astype(jnp.int32)
