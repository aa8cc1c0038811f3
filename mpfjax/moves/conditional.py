"""Moves around a reference trajectory: what conditional SMC does in place of each move.

A conditional filter keeps one trajectory x*_0, ..., x*_t. At every time it stands in one slot, the
reference slot, and the other slots are as any filter's. Two moves are then different: the
propagation puts x*_t into the slot, and the resampling gives the slot at least one offspring.
`mpfjax.smoothing.conditional_filter` says why this is exact.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from mpfjax.mixture import ParticleMixture
from mpfjax.moves.base import AbstractPropagation, AbstractResampling
from mpfjax.moves.propagation import Predict, Propagate, Weigh, log_transition
from mpfjax.moves.resampling import Resample
from mpfjax.moves.slots import Slots, place_slots
from mpfjax.moves.standing import standing_order
from mpfjax.operations.generator import split, uniform
from mpfjax.operations.indexing import take
from mpfjax.operations.segments import order_by_segment, spread

REFERENCE = "reference"  # the name of its slot and time in a mixture's memory
CONDITIONAL_SCHEMES = ("multinomial", "stratified", "systematic")


class ConditionalPropagation(AbstractPropagation):
    """Propagate every particle but the one in the reference slot, which goes to x*_t.

    The weight of the reference is that of any particle: L D / q, with q at x*_t, so that a
    proposal needs `log_density`.

    - `move`: a `Propagate` or `Predict`.
    - `trajectory`: x*_0, ..., x*_t, leaves (t + 1, ...).
    - `first_slot`: where x*_0 stands.
    """

    move: Propagate | Predict
    trajectory: PyTree
    first_slot: Int[Array, ""]

    def initial_memory(self, num_components: int) -> dict[str, PyTree]:
        """The reference slot, and the time at which the particles are."""
        del num_components
        return {REFERENCE: {"slot": self.first_slot, "time": jnp.zeros((), jnp.int32)}}

    def __call__(
        self, key: Key[Array, ""], mixture: ParticleMixture, observation: PyTree
    ) -> ParticleMixture:
        """Propagate around x*_t, and weigh as the move does."""
        move = self.move
        if isinstance(move, Predict):
            return self.predict(key, mixture)
        if move.proposal is None:
            return Weigh(move.model)(key, self.predict(key, mixture), observation)
        proposal, previous = move.proposal, mixture.particles
        states, log_density = proposal.propose(key, observation, previous)
        moved = self._with_reference(mixture.replace(particles=states))
        slot = mixture.memory[REFERENCE]["slot"]
        own = lambda tree: jax.tree.map(lambda leaf: take(leaf, slot[None]), tree)  # noqa: E731
        density: Any = proposal
        log_own = density.log_density(observation, own(moved.particles), own(previous))
        log_density = put(log_density, log_own[0], slot)
        log_ratio = log_transition(move.model, moved.particles, previous) - log_density
        return Weigh(move.model)(key, moved, observation).weighed(log_ratio)

    def predict(self, key: Key[Array, ""], mixture: ParticleMixture) -> ParticleMixture:
        """Draw x_t ~ D(. | x_{t-1}) around x*_t, and leave the weights."""
        return self._with_reference(self.move.predict(key, mixture))

    def _with_reference(self, mixture: ParticleMixture) -> ParticleMixture:
        """The particles at the next time, with x* of that time in its slot."""
        slot, time = (mixture.memory[REFERENCE][name] for name in ("slot", "time"))
        now = jax.tree.map(lambda leaf: at(leaf, time + 1), self.trajectory)
        particles = jax.tree.map(lambda leaf, own: put(leaf, own, slot), mixture.particles, now)
        memory = mixture.memory | {REFERENCE: {"slot": slot, "time": time + 1}}
        return mixture.replace(particles=particles, memory=memory)


class ConditionalResample(AbstractResampling):
    """Resample within components, given that the reference has an offspring.

    It is the law of `Resample`'s ancestor indices, given that a slot of the reference's component,
    each as likely as any other before, has the reference for its parent. Every scheme but the
    residual is one point in the share of each slot, on a line where particle i has a stretch as
    long as its expected number of offspring k w_i:

    - "multinomial": the slot is any of the component's; the other points are independent of it.
    - "stratified" and "systematic": a point v, uniform on the reference's stretch, says both which
      slot it is, the whole part of v, and the shift in that slot's share, v's fraction. In the
      systematic scheme all slots of the component have this shift; in the stratified one, the
      others have their own.

    Other components are resampled as ever. `move` is the filter's own `Resample`.
    """

    move: Resample

    def is_due(self, mixture: ParticleMixture) -> Bool[Array, " m"]:
        """Which components of `mixture` the move would resample."""
        return self.move.is_due(mixture)

    def __call__(
        self, key: Key[Array, ""], mixture: ParticleMixture, observation: PyTree = None
    ) -> ParticleMixture:
        """Resample every component that is due around the reference."""
        due, counts = self.is_due(mixture), mixture.component_counts
        targets = self.move.deal(mixture, due, counts)
        slots = place_slots(targets, mixture.num_particles)
        parents, slot = self._draw(key, mixture, due, targets, slots)
        num_slots = jnp.maximum(targets, 1).astype(mixture.log_weights.dtype)
        log_shares = spread(mixture.log_mixture_weights - jnp.log(num_slots), slots.components)
        kept = take(mixture.log_weights, parents)
        log_weights = jnp.where(spread(due, slots.components), log_shares, kept)
        reference = mixture.memory[REFERENCE] | {"slot": slot}
        return mixture.replace(
            particles=jax.tree.map(lambda leaf: take(leaf, parents), mixture.particles),
            log_weights=jnp.where(slots.filled, log_weights, -jnp.inf),
            component_indicators=slots.components,
            ancestor_indices=take(mixture.ancestor_indices, parents),
            memory=mixture.memory | {REFERENCE: reference},
        )

    def _draw(
        self,
        key: Key[Array, ""],
        mixture: ParticleMixture,
        due: Bool[Array, " m"],
        targets: Int[Array, " m"],
        slots: Slots,
    ) -> tuple[Int[Array, " n"], Int[Array, ""]]:
        """Each slot's parent, and the slot of the reference's offspring."""
        key_reference, key_points = split(key, 2)
        before = mixture.memory[REFERENCE]["slot"]
        order, counts = self._line(mixture)
        place = jnp.argmax(order == before).astype(jnp.int32)
        firsts = jnp.cumsum(counts) - counts
        own = mixture.component_indicators[before]
        weights = take(mixture.component_weights, order)
        standing = take(mixture.component_indicators, order)
        dtype = weights.dtype
        stretches = weights * spread(targets, standing).astype(dtype)
        ends = jnp.cumsum(stretches)
        share = uniform(key_reference, (), dtype)
        first, number = slots.firsts[own], targets[own]
        if self.move.scheme == "multinomial":
            point = first.astype(dtype) + share * number.astype(dtype)
        else:
            point = ends[place] - (1 - share) * stretches[place]
        slot = jnp.clip(jnp.floor(point).astype(jnp.int32), first, first + number - 1)
        points = self._points(key_points, point - jnp.floor(point), own, targets, slots)
        parents = jnp.searchsorted(ends, points, side="right").astype(jnp.int32)
        lowest = spread(firsts, slots.components)
        parents = jnp.clip(parents, lowest, lowest + spread(counts, slots.components) - 1)
        parents = parents.at[slot].set(place)
        if self.move.ess_threshold < 1.0:
            unmoved = lowest + slots.ranks
            parents = jnp.where(spread(due, slots.components), parents, unmoved)
            slot = jnp.where(due[own], slot, first + place - firsts[own])
        return take(order, jnp.clip(parents, 0, mixture.num_particles - 1)), slot

    def _line(self, mixture: ParticleMixture) -> tuple[Int[Array, " n"], Int[Array, " m"]]:
        """The particles component by component, empty slots last, and how many each has."""
        m = mixture.num_components
        labels = jnp.where(mixture.occupied, mixture.component_indicators, m)
        if self.move.sort_by is None:
            return order_by_segment(labels, m)
        order = standing_order(mixture, labels, self.move.sort_by)
        return order, mixture.component_counts

    def _points(
        self,
        key: Key[Array, ""],
        shift: Float[Array, ""],
        own: Int[Array, ""],
        targets: Int[Array, " m"],
        slots: Slots,
    ) -> Float[Array, " n"]:
        """One point for each slot, on the line of all components."""
        n, m, dtype = slots.components.shape[0], targets.shape[0], shift.dtype
        if self.move.scheme == "systematic":
            shifts = put(uniform(key, (m,), dtype), shift, own)
            return jnp.arange(n).astype(dtype) + spread(shifts, slots.components)
        if self.move.scheme == "stratified":
            return jnp.arange(n).astype(dtype) + uniform(key, (n,), dtype)
        lengths = spread(targets, slots.components).astype(dtype)
        firsts = spread(slots.firsts, slots.components).astype(dtype)
        return firsts + lengths * uniform(key, (n,), dtype)


def at(values: Array, place: Int[Array, ""]) -> Array:
    """The value at a place, which is known to lie in range."""
    return take(values, place[None])[0]


def put(values: Array, value: Array, place: Int[Array, ""]) -> Array:
    """The values with another one at a place."""
    is_place = jnp.arange(values.shape[0], dtype=jnp.int32) == place
    return jnp.where(is_place.reshape(-1, *[1] * (values.ndim - 1)), value[None], values)
