"""Moves around a reference trajectory, which conditional SMC uses in place of a filter's moves.

A conditional filter keeps one trajectory x*_0, ..., x*_t. At every time it occupies one slot, the
reference slot; the other slots are those of an ordinary filter. Two moves differ: the propagation
puts x*_t into the slot, and the resampling gives the slot at least one offspring.
`mpfjax.smoothing.conditional_filter` explains why this is exact.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from mpfjax.mixture import ParticleMixture
from mpfjax.moves.base import AbstractAdaptiveResampling, AbstractPropagation
from mpfjax.moves.propagation.propagate import Predict, Propagate, Reweight, log_transition
from mpfjax.moves.resampling.allocation import Slots, place_slots
from mpfjax.moves.resampling.layout import side_by_side
from mpfjax.moves.resampling.resample import Resample
from mpfjax.moves.resampling.schemes import random_points
from mpfjax.operations.generator import split, uniform
from mpfjax.operations.indexing import take
from mpfjax.operations.positions import Positions, last_before, random_positions
from mpfjax.operations.segments import spread

REFERENCE = "reference"  # the name of its slot and time in a mixture's memory
CONDITIONAL_SCHEMES = ("multinomial", "stratified", "systematic")


class ConditionalPropagation(AbstractPropagation):
    """Propagate every particle but the one in the reference slot, which moves to x*_t.

    The weight of the reference is that of any particle, L D / q, with q at x*_t, so that a proposal
    needs `log_density`.

    - `move`: a `Propagate` or `Predict`.
    - `trajectory`: x*_0, ..., x*_t, leaves (t + 1, ...).
    - `first_slot`: the slot of x*_0.
    """

    move: Propagate | Predict
    trajectory: PyTree
    first_slot: Int[Array, ""]

    def initial_memory(self, num_components: int) -> dict[str, PyTree]:
        """The reference slot, and the time of the particles."""
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
            return Reweight(move.model)(key, self.predict(key, mixture), observation)
        proposal, previous = move.proposal, mixture.particles
        states, log_density = proposal.propose(key, observation, previous)
        moved = self._with_reference(mixture.replace(particles=states))
        slot = mixture.memory[REFERENCE]["slot"]
        own = lambda tree: jax.tree.map(lambda leaf: take(leaf, slot[None]), tree)  # noqa: E731
        density: Any = proposal
        log_own = density.log_density(observation, own(moved.particles), own(previous))
        log_density = put(log_density, log_own[0], slot)
        log_ratio = log_transition(move.model, moved.particles, previous) - log_density
        return Reweight(move.model)(key, moved, observation).weighed(log_ratio)

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


class ConditionalResample(AbstractAdaptiveResampling):
    """Resample within components, given that the reference has an offspring.

    The ancestor indices have the law of those of `Resample`, given that one slot of the reference's
    component, each with equal probability, has the reference for its parent. In every scheme but
    the residual each slot draws one point of a line, on which particle i has an interval as long as
    its expected number of offspring k w_i:

    - "multinomial": the slot is any of the component's; the other points are independent of it.
    - "stratified" and "systematic": a point v is drawn uniformly on the reference's interval. Its
      integer part is the slot, and its fractional part is the shift within that slot's unit
      interval. In the systematic scheme all slots of the component have this shift; in the
      stratified scheme the others have their own.

    Other components are resampled as usual. `move` is the filter's own `Resample`.
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
        reference = mixture.memory[REFERENCE]["slot"]
        own, n = mixture.component_indicators[reference], mixture.num_particles
        # All filled slots take part, since the reference's weight may underflow.
        line = side_by_side(mixture, mixture.occupied, self.move.sort_by, without_gaps=True)
        place = jnp.argmax(line.order == reference).astype(jnp.int32)
        stretches = line.expected(targets)
        before, _ = line.positions(stretches, targets, slots)
        first, number = slots.firsts[own], targets[own]
        if self.move.scheme == "multinomial":
            point = random_positions(key_reference, number[None])
            point = Positions(first + point.whole[0], point.fraction[0])
        else:
            share = uniform(key_reference, (), stretches.dtype)
            point = Positions(before.whole[place], before.fraction[place])
            point = point.moved_by(share * stretches[place])
        slot = jnp.clip(point.whole, first, first + number - 1)
        points = self._points(key_points, point.fraction, own, targets, slots)
        parents = last_before(before, points, n)
        firsts = jnp.cumsum(line.counts) - line.counts
        lowest = spread(firsts, slots.components)
        parents = jnp.clip(parents, lowest, lowest + spread(line.counts, slots.components) - 1)
        parents = parents.at[slot].set(place)
        if self.move.ess_threshold < 1.0:
            unmoved = lowest + slots.ranks
            parents = jnp.where(spread(due, slots.components), parents, unmoved)
            slot = jnp.where(due[own], slot, first + place - firsts[own])
        return line.particles_at(jnp.clip(parents, 0, n - 1)), slot

    def _points(
        self,
        key: Key[Array, ""],
        shift: Float[Array, ""],
        own: Int[Array, ""],
        targets: Int[Array, " m"],
        slots: Slots,
    ) -> Positions:
        """One point for each slot, on the line of all components."""
        n, m, dtype = slots.components.shape[0], targets.shape[0], shift.dtype
        own_slots = jnp.arange(n, dtype=jnp.int32)
        if self.move.scheme == "systematic":
            shifts = put(uniform(key, (m,), dtype), shift, own)
            return Positions(own_slots, spread(shifts, slots.components))
        if self.move.scheme == "stratified":
            return Positions(own_slots, uniform(key, (n,), dtype))
        return random_points(key, slots, targets)


def at(values: Array, place: Int[Array, ""]) -> Array:
    """The value at an index that is known to lie in range."""
    return take(values, place[None])[0]


def put(values: Array, value: Array, place: Int[Array, ""]) -> Array:
    """The values with another one at an index."""
    is_place = jnp.arange(values.shape[0], dtype=jnp.int32) == place
    return jnp.where(is_place.reshape(-1, *[1] * (values.ndim - 1)), value[None], values)
