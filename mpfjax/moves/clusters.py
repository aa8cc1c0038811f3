"""Clusters of objects: particle filters of their own that merge where objects meet."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from mpfjax.mixture import ParticleMixture, single_component
from mpfjax.models.base import require
from mpfjax.models.multi_object import MultiObjectModel, require_multi_object
from mpfjax.moves.base import AbstractPropagation
from mpfjax.moves.resampling import Resample
from mpfjax.operations import default_float, draw_columns, take

INSIDES = ("crossing", "partitioned")
STARTS = ("apart", "together")
_GOLDEN = (np.sqrt(5) - 1) / 2


class PropagateInClusters(AbstractPropagation):
    """Propagate, weigh and resample clusters of objects, which merge where objects touch.

    The objects are parted into clusters, and the joint distribution is the product of the
    clusters' clouds of N rows each. One step, from rows of equal weight:

    1. *An object alone* moves by its dynamics and is resampled by its likelihood. Its factor
       of Ẑ is the mean likelihood.
    2. *The objects of a cluster* move, by `inside`, as described below.
    3. *Merging.* Where any two points of two clusters A and B have log ψ ≠ 0, row r of A is
       given row s of B with probability ∝ Ψ_rs, the product of the ψ between them, and weight
       N⁻¹ Σ_s Ψ_rs; the merged rows are resampled. Where all log ψ are 0 the product of the
       clouds is the joint cloud already, and looking for contact costs no bias.

    Unbiased: given the past, the clouds are drawn independently of each other, and each is an
    unbiased estimate of its own update, so the expectation of their product is the product of
    the exact updates; the ψ between clusters are then weights of the N x N pairs of rows, of
    which step 3 draws N.

    `inside="crossing"` lets objects cross between rows. Object j's N points x^{jl}, one drawn
    from each row, are a draw of q_j(x) = N⁻¹ Σ_r f_j(x | row r), the deterministic mixture of
    Owen and Zhou (2000), and serve every row with the weight

        b_rjl = L_j(x^{jl}) f_j(x^{jl} | row r) / Σ_r' f_j(x^{jl} | row r').

    The update of a row is Σ b_r1l b_r2m ... ψ(x^{1l}, x^{2m}) ... over all combinations of
    points. N rows are drawn ∝ Π_j Σ_l b_rjl; then for each its objects' points, round from a
    random object on, ∝ b times ψ with the points already chosen, the row's weight multiplied by
    Σ b ψ / Σ b; then the rows are resampled. What a row loses by the evidence of one object
    costs another object no hypotheses. `inside="partitioned"` is partitioned
    sampling within the cluster, from a random object on, for a model without a transition density.

    - `start`: every object "apart", or all "together" in one cluster from the start; "together"
      with crossing is shared-proposal crossing alone.
    - `split_after`: None never splits a cluster, which is exact. A number s parts what had no
      contact for s steps, directly or through others, and goes on with the product of the
      marginals: an approximation (`approximate` is true).
    - `scheme`: of resampling, as in `Resample`.

    Cost: J x N likelihoods a step, J(J-1) N² / 2 potentials to find contact, and N² J
    transition densities inside clusters that cross. Particle i holds row i of every cluster,
    turned by a random number of places, all with equal weight; the particles that the move is
    given must be so, as those of x_0 and its own are. A row has no single ancestor, and is its
    own. The clusters are in `memory["clusters"]["labels"]`, (J,): the first object of each
    object's cluster.

    Crossing needs the object model's `log_transition`, and where its state holds more of the
    past than x_t also `with_history(states, previous_states)`, the states with their past
    replaced by that which follows from the previous states.

    Raises `ValueError` for a mixture of several components, a model of one object, a model
    without `log_transition` where it is needed, and an unknown `inside`, `start` or scheme, or
    `split_after` below 1.
    """

    model: MultiObjectModel
    inside: str = eqx.field(static=True, default="crossing")
    start: str = eqx.field(static=True, default="apart")
    split_after: int | None = eqx.field(static=True, default=None)
    scheme: str = eqx.field(static=True, default="systematic")

    def __check_init__(self) -> None:
        require_multi_object(self.model, "PropagateInClusters")
        Resample(self.scheme)  # raises where there is no such scheme
        for name, value, choices in (
            ("inside", self.inside, INSIDES),
            ("start", self.start, STARTS),
        ):
            if value not in choices:
                raise ValueError(f"{name}: {value!r} is not one of {choices}")
        if self.split_after is not None and self.split_after < 1:
            raise ValueError(f"split_after: {self.split_after} is less than 1")
        if self.inside == "crossing" and self._may_be_joint:
            require(self.model.object_model, "log_transition", "inside='crossing'")

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
        """One step of every cluster's filter, and the merging of those that touch."""
        if mixture.num_components != 1:
            raise ValueError(f"mixture: {mixture.num_components} components, not one")
        num_objects = self.model.num_objects
        # The objects' keys are those of the joint draw, so that one object is a plain filter.
        keys = jax.random.split(key, 2 * num_objects + 3)
        keys_objects, keys_rows = keys[:num_objects], keys[num_objects : 2 * num_objects]
        key_inside, key_merge, key_shift = keys[2 * num_objects :]
        seen = self.model.prepare_observation(observation)
        memory = mixture.memory["clusters"]
        labels = memory["labels"]
        step = self._crossed if self.inside == "crossing" else self._partitioned
        particles, log_growth = step(
            (keys_objects, keys_rows, key_inside), mixture.particles, seen, labels
        )
        if self._may_be_joint:
            particles, log_gain, memory = self._merged(key_merge, particles, memory)
            log_growth += log_gain
        particles = _shifted(key_shift, particles, memory["labels"])
        moved = mixture.replace(
            particles=particles,
            log_weights=mixture.log_weights + log_growth.astype(mixture.log_weights.dtype),
            memory=mixture.memory | {"clusters": memory},
        )
        return jax.lax.cond(
            log_growth == -jnp.inf, lambda: self._unweighted(key, mixture), lambda: moved
        )

    def predict(self, key: Key[Array, ""], mixture: ParticleMixture) -> ParticleMixture:
        """Draw x_t ~ D(. | x_{t-1}) of all objects; the clusters stay."""
        return mixture.replace(particles=self.model.sample_transition(key, mixture.particles))

    def _unweighted(self, key: Key[Array, ""], mixture: ParticleMixture) -> ParticleMixture:
        nothing = jnp.full_like(mixture.log_weights, -jnp.inf)
        return self.predict(key, mixture).replace(log_weights=nothing)

    # Inside the clusters. Tables (J, n) have a line for each object; those of its cluster agree
    # where the entry belongs to the cluster, drawn with the same key.

    def _crossed(
        self, keys: tuple, particles: PyTree, seen: PyTree, labels: Int[Array, " objects"]
    ) -> tuple[PyTree, Float[Array, ""]]:
        """The rows after the step, and log of the clusters' factors of Ẑ."""
        keys_objects, keys_rows, key_inside = keys
        objects = jnp.arange(self.model.num_objects, dtype=jnp.int32)

        def move(key: Key[Array, ""], states: PyTree, j: Int[Array, ""]) -> tuple:
            points = self.model.sample_object_transition(key, states, j)
            log_likelihood = self.model.object_log_likelihood(seen, points, j)
            return points, log_likelihood.astype(default_float())

        points, log_likelihoods = jax.vmap(move, in_axes=(0, 1, 0), out_axes=(1, 0))(
            keys_objects, particles, objects
        )
        if not self._may_be_joint:
            rows, log_growths = self._resampled(keys_rows, labels, log_likelihoods)
            return _rows_of_each(points, rows), jnp.sum(log_growths)

        together = _together(labels)
        alone = jnp.sum(together, axis=1) == 1
        log_totals, log_sums = self._scores(particles, points, log_likelihoods, alone)
        log_scores = jnp.sum(jnp.where(together[:, :, None], log_sums[None], 0.0), axis=1)
        rows, log_growths = self._resampled(keys_rows, labels, log_scores)
        key_order, key_points, key_rows = jax.random.split(key_inside, 3)
        order = _rotated(key_order, objects)

        def choose(carry: tuple, inputs: tuple) -> tuple[tuple, None]:
            chosen, log_weights, has_moved = carry
            key, j = inputs

            def cross() -> tuple[PyTree, Float[Array, " n"]]:
                parents = jax.tree.map(lambda leaf: take(leaf, rows[j]), self._of(particles, j))
                own = self._of(points, j)
                log_b = self._log_kernels(own, parents, j)
                log_b += (log_likelihoods[j] - log_totals[j])[None]
                partners = has_moved & together[j]
                log_psi = self._log_potentials(chosen, partners, own)
                picked, log_gain = _draw_columns(key, log_b + log_psi)
                states = jax.tree.map(lambda leaf: take(leaf, picked), own)
                before = take(log_sums[j], rows[j])
                log_gain = jnp.where(jnp.any(partners), log_gain - before, 0.0)
                return self._with_history(states, parents, j), log_gain

            def follow() -> tuple[PyTree, Float[Array, " n"]]:
                own = jax.tree.map(lambda leaf: take(leaf, rows[j]), self._of(points, j))
                return own, jnp.zeros_like(log_weights[0])

            states, log_gain = jax.lax.cond(alone[j], follow, cross)
            chosen = self.model.replace_object(chosen, j, states)
            log_weights += jnp.where(together[j][:, None], log_gain[None], 0.0)
            return (chosen, log_weights, has_moved | (objects == j)), None

        carry = (particles, jnp.zeros_like(log_likelihoods), jnp.zeros(objects.shape, bool))
        inputs = (jax.random.split(key_points, len(objects)), order)
        (chosen, log_weights, _), _ = jax.lax.scan(choose, carry, inputs)
        keys_last = jax.random.split(key_rows, len(objects))
        chosen, log_last = self._settled(keys_last, chosen, log_weights, labels, ~alone)
        return chosen, jnp.sum(log_growths) + log_last

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
                log_f = self._log_kernels(self._of(points, j), self._of(particles, j), j)
                log_totals = _log_sums(log_f.T)
                log_b = log_f + (log_likelihoods[j] - log_totals)[None]
                return log_totals, _log_sums(log_b)

            def own() -> tuple[Float[Array, " n"], Float[Array, " n"]]:
                return jnp.zeros_like(log_likelihoods[j]), log_likelihoods[j]

            return carry, jax.lax.cond(alone[j], own, shared)

        objects = jnp.arange(len(alone), dtype=jnp.int32)
        return jax.lax.scan(score, None, objects)[1]

    def _partitioned(
        self, keys: tuple, particles: PyTree, seen: PyTree, labels: Int[Array, " objects"]
    ) -> tuple[PyTree, Float[Array, ""]]:
        """The same, one object after the other, its cluster resampled after each."""
        keys_objects, keys_rows, key_inside = keys
        objects = jnp.arange(self.model.num_objects, dtype=jnp.int32)
        together = _together(labels)
        order = _rotated(key_inside, objects)

        def stage(carry: tuple, j: Int[Array, ""]) -> tuple[tuple, Float[Array, ""]]:
            particles, has_moved = carry
            states = self.model.sample_object_transition(keys_objects[j], self._of(particles, j), j)
            log_weights = self.model.object_log_likelihood(seen, states, j).astype(default_float())
            if self._may_be_joint and self.model.interaction is not None:
                log_weights += self._log_row_potentials(particles, has_moved & together[j], states)
            particles = self.model.replace_object(particles, j, states)
            rows, log_growth = self._resample(keys_rows[j], log_weights)
            own = jnp.arange(len(rows), dtype=jnp.int32)
            particles = _rows_of_each(
                particles, jnp.where(together[j][:, None], rows[None], own[None])
            )
            return (particles, has_moved | (objects == j)), log_growth

        carry = (particles, jnp.zeros(objects.shape, bool))
        (particles, _), log_growths = jax.lax.scan(stage, carry, order)
        return particles, jnp.sum(log_growths)

    # Between the clusters.

    def _merged(
        self, key: Key[Array, ""], particles: PyTree, memory: dict[str, Array]
    ) -> tuple[PyTree, Float[Array, ""], dict[str, Array]]:
        """The rows of the merged clusters, log of their factor of Ẑ, and the new memory."""
        labels, steps_apart = memory["labels"], memory["steps_apart"]
        touching = self._touching(particles, labels)
        if self.split_after is not None:
            steps_apart = jnp.where(touching, 0, steps_apart + 1)
            labels = _components(_together(labels) & (steps_apart < self.split_after))
        if self.model.interaction is None:
            log_growth = jnp.zeros((), default_float())
            return particles, log_growth, {"labels": labels, "steps_apart": steps_apart}
        merged = _components(_together(labels) | touching)
        particles, log_growth = jax.lax.cond(
            jnp.any(merged != labels),
            lambda: self._merge(key, particles, labels, merged),
            lambda: (particles, jnp.zeros((), default_float())),
        )
        return particles, log_growth, {"labels": merged, "steps_apart": steps_apart}

    def _touching(
        self, particles: PyTree, labels: Int[Array, " objects"]
    ) -> Bool[Array, "objects objects"]:
        """Which objects have points between which ψ ≠ 1, over all pairs of their points.

        Within a cluster that never splits nobody asks.
        """
        num_objects = self.model.num_objects
        if self.model.interaction is None:
            return jnp.zeros((num_objects, num_objects), bool)
        first, second = np.triu_indices(num_objects, 1)

        def touch(carry: None, pair: tuple) -> tuple[None, Bool[Array, ""]]:
            i, j = pair

            def look() -> Bool[Array, ""]:
                return jnp.any(self._log_pairs(self._of(particles, i), self._of(particles, j)) != 0)

            if self.split_after is not None:
                return carry, look()
            return carry, jax.lax.cond(labels[i] == labels[j], lambda: jnp.zeros((), bool), look)

        pairs = (jnp.asarray(first, jnp.int32), jnp.asarray(second, jnp.int32))
        _, touches = jax.lax.scan(touch, None, pairs)
        half = jnp.zeros((num_objects, num_objects), bool).at[pairs].set(touches)
        return half | half.T

    def _merge(
        self,
        key: Key[Array, ""],
        particles: PyTree,
        labels: Int[Array, " objects"],
        merged: Int[Array, " objects"],
    ) -> tuple[PyTree, Float[Array, ""]]:
        """Every cluster's rows dealt to those of the first that it merges with, and so on."""
        num_objects = self.model.num_objects
        num_particles = jax.tree.leaves(particles)[0].shape[0]
        keys = jax.random.split(key, 2 * num_objects)
        order = _side_by_side(labels)
        is_last = jnp.concatenate([jnp.diff(take(labels, order)) != 0, jnp.ones(1, bool)])
        table = jnp.zeros((num_particles, num_particles), default_float())

        def fold(carry: tuple, inputs: tuple) -> tuple[tuple, None]:
            particles, log_weights, log_psi = carry
            key, j, completes = inputs
            # Clusters before this one in the order have their rows already.
            partners = (merged == merged[j]) & (labels < labels[j])
            log_psi += self._log_potentials(particles, partners, self._of(particles, j))

            def deal() -> tuple[PyTree, Float[Array, "objects n"], Float[Array, "n n"]]:
                rows, log_sums = _draw_columns(key, log_psi)
                own = jnp.arange(num_particles, dtype=jnp.int32)
                members = labels == labels[j]
                dealt = _rows_of_each(particles, jnp.where(members[:, None], rows[None], own[None]))
                log_gain = log_sums - jnp.log(jnp.asarray(num_particles, log_sums.dtype))
                gains = jnp.where((merged == merged[j])[:, None], log_gain[None], 0.0)
                return dealt, log_weights + gains, table

            meets = completes & jnp.any(partners)
            return jax.lax.cond(
                meets, deal, lambda: (particles, log_weights, jnp.where(completes, 0.0, log_psi))
            ), None

        log_weights = jnp.zeros((num_objects, num_particles), default_float())
        carry = (particles, log_weights, table)
        inputs = (keys[:num_objects], order, is_last)
        (particles, log_weights, _), _ = jax.lax.scan(fold, carry, inputs)
        grown = jnp.any(_together(merged) & (labels != merged)[None], axis=1)
        return self._settled(keys[num_objects:], particles, log_weights, merged, grown)

    # Parts of the above.

    def _settled(
        self,
        keys: Key[Array, " objects"],
        particles: PyTree,
        log_weights: Float[Array, "objects n"],
        labels: Int[Array, " objects"],
        weighted: Bool[Array, " objects"],
    ) -> tuple[PyTree, Float[Array, ""]]:
        """Rows of equal weight for the clusters that are weighted, and log of their mean weight."""
        rows, log_growths = self._resampled(keys, labels, log_weights)
        own = jnp.arange(log_weights.shape[1], dtype=jnp.int32)
        rows = jnp.where(weighted[:, None], rows, own[None])
        log_growth = jnp.sum(jnp.where(weighted, log_growths, 0.0))
        return _rows_of_each(particles, rows), log_growth

    def _resampled(
        self,
        keys: Key[Array, " objects"],
        labels: Int[Array, " objects"],
        log_weights: Float[Array, "objects n"],
    ) -> tuple[Int[Array, "objects n"], Float[Array, " objects"]]:
        """Each object's rows drawn anew, alike in a cluster, and log of the mean weight of each.

        Only the first object of a cluster counts its mean, so that their sum is log Ẑ.
        """
        rows, log_growths = jax.vmap(self._resample)(take(keys, labels), log_weights)
        is_first = labels == jnp.arange(len(labels), dtype=labels.dtype)
        return rows, jnp.where(is_first, log_growths, 0.0)

    def _resample(
        self, key: Key[Array, ""], log_weights: Float[Array, " n"]
    ) -> tuple[Int[Array, " n"], Float[Array, ""]]:
        """Which rows the new ones are copies of, and log of the mean weight."""
        cloud = single_component(log_weights)
        cloud = cloud.replace(log_weights=cloud.log_weights + log_weights)
        return Resample(self.scheme)(key, cloud).ancestor_indices, cloud.log_mass

    def _of(self, particles: PyTree, j: Int[Array, ""]) -> PyTree:
        return self.model.object_states(particles, j)

    def _with_history(self, states: PyTree, parents: PyTree, j: Int[Array, ""]) -> PyTree:
        """The states as children of other parents than those that they were drawn from."""
        replace_past = getattr(self.model.object_at(j), "with_history", None)
        return states if replace_past is None else replace_past(states, parents)

    def _log_kernels(
        self, points: PyTree, parents: PyTree, j: Int[Array, ""]
    ) -> Float[Array, "n n"]:
        """log f_j(point l | parent k) in line k and column l."""
        model: Any = self.model.object_at(j)
        log_f = _over_pairs(lambda parent, point: model.log_transition(point, parent))
        return log_f(parents, points).astype(default_float())

    def _log_pairs(self, states: PyTree, others: PyTree) -> Float[Array, "n n"]:
        """log ψ of state k and other state l in line k and column l."""
        assert self.model.interaction is not None
        return _over_pairs(self.model.interaction)(states, others).astype(default_float())

    def _log_potentials(
        self, particles: PyTree, partners: Bool[Array, " objects"], points: PyTree
    ) -> Float[Array, "n n"]:
        """Σ log ψ of the partners in row k with point l, in line k and column l."""
        num_points = jax.tree.leaves(points)[0].shape[0]
        total = jnp.zeros((num_points, num_points), default_float())
        if self.model.interaction is None:
            return total

        def add(total: Float[Array, "n n"], inputs: tuple) -> tuple[Float[Array, "n n"], None]:
            i, meets = inputs
            add_pairs = lambda: total + self._log_pairs(self._of(particles, i), points)  # noqa: E731
            return jax.lax.cond(meets, add_pairs, lambda: total), None

        objects = jnp.arange(len(partners), dtype=jnp.int32)
        return jax.lax.scan(add, total, (objects, partners))[0]

    def _log_row_potentials(
        self, particles: PyTree, partners: Bool[Array, " objects"], states: PyTree
    ) -> Float[Array, " n"]:
        """Σ log ψ of the partners in row k with state k."""
        interaction = self.model.interaction
        assert interaction is not None
        objects = jnp.arange(len(partners), dtype=jnp.int32)
        values = jax.vmap(lambda i: interaction(self._of(particles, i), states))(objects)
        return jnp.sum(jnp.where(partners[:, None], values, 0.0), axis=0).astype(default_float())


def _over_pairs(
    function: Callable[[PyTree, PyTree], Float[Array, " n"]],
) -> Callable[[PyTree, PyTree], Float[Array, "n n"]]:
    """A function of the states of equal rows, made one of all pairs of rows."""

    def of_one(state: PyTree, others: PyTree) -> Float[Array, " n"]:
        alike = jax.tree.map(lambda a, b: jnp.broadcast_to(a[None], b.shape), state, others)
        return function(alike, others)

    return jax.vmap(of_one, in_axes=(0, None))


def _draw_columns(
    key: Key[Array, ""], log_table: Float[Array, "n n"]
) -> tuple[Int[Array, " n"], Float[Array, " n"]]:
    """A column of each line, drawn in proportion to its entries, and log of the line's sum.

    One shift is drawn for all lines, whose quantiles follow each other in golden strides: each is
    uniform, and any stretch of lines that are equal draws evenly.
    """
    strides = _GOLDEN * np.arange(log_table.shape[0])
    shift = jax.random.uniform(key, (), log_table.dtype)
    uniform = (jnp.asarray(strides % 1, log_table.dtype) + shift) % 1
    weights = jnp.exp(jax.lax.stop_gradient(log_table) - _finite_max(log_table)[:, None])
    return draw_columns(uniform, weights), _log_sums(log_table)


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
    keys = take(jax.random.split(key, len(labels)), labels)
    return _rows_of_each(particles, jax.vmap(_rotated, in_axes=(0, None))(keys, places))


def _rotated(key: Key[Array, ""], indices: Int[Array, " k"]) -> Int[Array, " k"]:
    """The numbers 0, ..., k-1 from a random one on, and round."""
    return (indices + jax.random.randint(key, (), 0, len(indices), indices.dtype)) % len(indices)


def _side_by_side(labels: Int[Array, " objects"]) -> Int[Array, " objects"]:
    """The objects in ascending order of their labels; counted, since sorts compile slowly."""
    objects = jnp.arange(len(labels), dtype=jnp.int32)
    earlier = _together(labels) & (objects[None] < objects[:, None])
    before = jnp.sum((labels[None] < labels[:, None]) | earlier, axis=1, dtype=jnp.int32)
    return jnp.zeros_like(objects).at[before].set(objects, unique_indices=True)


def _together(labels: Int[Array, " objects"]) -> Bool[Array, "objects objects"]:
    return labels[:, None] == labels[None]


def _components(linked: Bool[Array, "objects objects"]) -> Int[Array, " objects"]:
    """The first object that each can be reached from; `linked` is symmetric."""
    reach = linked | jnp.eye(len(linked), dtype=bool)
    for _ in range(max(len(linked) - 1, 1).bit_length()):
        reach = jnp.any(reach[:, :, None] & reach[None], axis=1)
    return jnp.argmax(reach, axis=1).astype(jnp.int32)
