"""Moves around a reference trajectory, which conditional SMC uses in place of a filter's moves.

A conditional filter keeps one trajectory x*_0, ..., x*_t. At every time it occupies one slot, the
reference slot; the other slots are those of an ordinary filter. Two moves differ: the propagation
puts x*_t into the slot, and the resampling gives the slot at least one offspring.
`mpfjax.smoothing.conditional_filter` explains why this is exact.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, Key, PyTree

from mpfjax.mixture import ParticleMixture
from mpfjax.moves.base import AbstractAdaptiveResampling, AbstractPropagation
from mpfjax.moves.propagation.propagate import Predict, Propagate, Reweight, log_transition
from mpfjax.moves.resampling.resample import Resample
from mpfjax.operations.stored import take

REFERENCE = "reference"  # the name of its slot and time in a mixture's memory


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
    component, each with equal probability, has the reference for its parent. `draw_ancestors` says
    how. Other components are resampled as usual. `move` is the filter's own `Resample`.
    """

    move: Resample

    def is_due(self, mixture: ParticleMixture) -> Bool[Array, " m"]:
        """Which components of `mixture` the move would resample."""
        return self.move.is_due(mixture)

    def __call__(
        self, key: Key[Array, ""], mixture: ParticleMixture, observation: PyTree = None
    ) -> ParticleMixture:
        """Resample every component that is due around the reference."""
        reference = mixture.memory[REFERENCE]
        due = self.is_due(mixture)
        resampled, ancestors = self.move.redraw(key, mixture, due, keep=reference["slot"])
        memory = resampled.memory | {REFERENCE: reference | {"slot": ancestors.kept}}
        return resampled.replace(memory=memory)


def at(values: Array, place: Int[Array, ""]) -> Array:
    """The value at an index that is known to lie in range."""
    return take(values, place[None])[0]


def put(values: Array, value: Array, place: Int[Array, ""]) -> Array:
    """The values with another one at an index."""
    is_place = jnp.arange(values.shape[0], dtype=jnp.int32) == place
    return jnp.where(is_place.reshape(-1, *[1] * (values.ndim - 1)), value[None], values)
