"""The propagation around a reference trajectory, as conditional SMC propagates.

A conditional filter keeps one trajectory x*_0, ..., x*_t. At every time it occupies one slot, the
reference slot, which the mixture's memory holds; the other slots are those of an ordinary filter.
Two moves differ: the propagation puts x*_t into the slot, and `Resample`, where it finds the slot
in the memory, gives it at least one offspring. `mpfjax.smoothing.conditional_filter` explains why
this is exact.
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, Key, PyTree

from mpfjax.memory import Memory, Offspring
from mpfjax.mixture import ParticleMixture
from mpfjax.models.base import require
from mpfjax.moves.base import AbstractPropagation, Step
from mpfjax.operations.stored import select_rows, take

REFERENCE = "reference"  # the name of its slot in a mixture's memory


class ReferenceSlot(Memory):
    """The slot of x*_t."""

    slot: Int[Array, ""]

    def reference_slot(self) -> Int[Array, ""]:
        """The slot of x*_t, which always has an offspring."""
        return self.slot

    def after_resampling(
        self, before: ParticleMixture, after: ParticleMixture, offspring: Offspring
    ) -> "ReferenceSlot":
        """The slot of its offspring."""
        assert offspring.reference is not None
        return ReferenceSlot(offspring.reference)


class Reference(NamedTuple):
    """A trajectory that a filter keeps."""

    trajectory: PyTree
    """x*_0, ..., x*_t, leaves (t + 1, ...)."""
    first_slot: Int[Array, ""]
    """the slot of x*_0."""

    def propagation(self, move: Any) -> "ConditionalPropagation":
        """A `Propagate` or `Predict` around the trajectory."""
        return ConditionalPropagation(move, self)


class ConditionalPropagation(AbstractPropagation):
    """Propagate every particle but the one in the reference slot, which moves to x*_t.

    The weight of the reference is that of any particle, L D / q, with q at x*_t, so that a proposal
    needs `log_density`. `move` is a `Propagate` or `Predict`.
    """

    move: Any
    reference: Reference

    def __check_init__(self) -> None:
        if self.move.noise != "independent":
            raise ValueError("filter: conditional SMC needs noise='independent' in its propagation")
        if self.move.proposal is not None:
            require(self.move.proposal, "log_density", "conditional SMC", "proposal")

    def initial_memory(self, now: Step, num_components: int) -> dict[str, PyTree]:
        """The reference slot."""
        return {REFERENCE: ReferenceSlot(self.reference.first_slot)}

    def __call__(self, key: Key[Array, ""], mixture: ParticleMixture, now: Step) -> ParticleMixture:
        """Propagate around x*_t, and weigh as the move does."""
        proposal, previous = self.move.proposal, mixture.particles
        if proposal is None or now.is_missing:
            unseen = dataclasses.replace(now, observation=None)
            moved = self._with_reference(self.move(key, mixture, unseen))
            return moved if now.is_missing else self.move.reweight(moved, now)
        states, log_density = proposal.propose(key, now, previous)
        moved = self._with_reference(mixture.replace(particles=states))
        slot = mixture.memory[REFERENCE].slot

        def of_slot(tree: PyTree) -> PyTree:
            return jax.tree.map(lambda leaf: take(leaf, slot[None]), tree)

        log_own = proposal.log_density(now, of_slot(moved.particles), of_slot(previous))
        log_density = put(log_density, log_own[0], slot)
        return self.move.reweight(moved, now, previous, log_density)

    def _with_reference(self, mixture: ParticleMixture) -> ParticleMixture:
        """The particles of x_t, with x*_t in its slot."""
        slot = mixture.memory[REFERENCE].slot
        states = jax.tree.map(lambda leaf: at(leaf, mixture.t), self.reference.trajectory)
        particles = jax.tree.map(
            lambda leaf, state: put(leaf, state, slot), mixture.particles, states
        )
        return mixture.replace(particles=particles)


def at(values: Array, place: Int[Array, ""]) -> Array:
    """The value at an index that is known to lie in range."""
    return take(values, place[None])[0]


def put(values: Array, value: Array, place: Int[Array, ""]) -> Array:
    """The values with another one at an index."""
    is_place = jnp.arange(values.shape[0], dtype=jnp.int32) == place
    return select_rows(is_place, value[None], values)
