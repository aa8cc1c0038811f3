"""Moves around a reference trajectory, which conditional SMC uses in place of a filter's moves.

A conditional filter keeps one trajectory x*_0, ..., x*_t. At every time it occupies one slot, the
reference slot; the other slots are those of an ordinary filter. Two moves differ: the propagation
puts x*_t into the slot, and the resampling gives the slot at least one offspring.
`mpfjax.smoothing.conditional_filter` explains why this is exact.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, Key, PyTree

from mpfjax.mixture import ParticleMixture
from mpfjax.models.base import require
from mpfjax.moves.base import AbstractPropagation, AbstractResampling
from mpfjax.operations.stored import take

REFERENCE = "reference"  # the name of its slot and time in a mixture's memory


class Reference(NamedTuple):
    """A trajectory that a filter keeps."""

    trajectory: PyTree
    """x*_0, ..., x*_t, leaves (t + 1, ...)."""
    first_slot: Int[Array, ""]
    """the slot of x*_0."""


class ConditionalPropagation(AbstractPropagation):
    """Propagate every particle but the one in the reference slot, which moves to x*_t.

    The weight of the reference is that of any particle, L D / q, with q at x*_t, so that a proposal
    needs `log_density`. `move` is a `Propagate` or `Predict`.
    """

    move: Any
    reference: Reference

    def __check_init__(self) -> None:
        if self.move.noise != "independent":
            raise ValueError(
                "filter: conditional SMC needs draws that are independent of each other, and not"
                f" noise={self.move.noise!r}; take noise='independent'"
            )
        if self.move.proposal is not None:
            require(self.move.proposal, "log_density", "conditional SMC", "proposal")

    def initial_memory(self, num_components: int) -> dict[str, PyTree]:
        """The reference slot, and the time of the particles."""
        del num_components
        time = jnp.zeros((), jnp.int32)
        return {REFERENCE: {"slot": self.reference.first_slot, "time": time}}

    def __call__(
        self, key: Key[Array, ""], mixture: ParticleMixture, observation: PyTree
    ) -> ParticleMixture:
        """Propagate around x*_t, and weigh as the move does."""
        proposal, previous = self.move.proposal, mixture.particles
        if proposal is None:
            return self.move.weighed(self.predict(key, mixture), observation)
        states, log_density = proposal.propose(key, observation, previous)
        moved = self._with_reference(mixture.replace(particles=states))
        slot = mixture.memory[REFERENCE]["slot"]
        own = lambda tree: jax.tree.map(lambda leaf: take(leaf, slot[None]), tree)  # noqa: E731
        log_own = proposal.log_density(observation, own(moved.particles), own(previous))
        log_density = put(log_density, log_own[0], slot)
        return self.move.weighed(moved, observation, previous, log_density)

    def predict(self, key: Key[Array, ""], mixture: ParticleMixture) -> ParticleMixture:
        """Draw x_t ~ D(. | x_{t-1}) around x*_t, and leave the weights."""
        return self._with_reference(self.move.predict(key, mixture))

    def _with_reference(self, mixture: ParticleMixture) -> ParticleMixture:
        """The particles at the next time, with x* of that time in its slot."""
        slot, time = (mixture.memory[REFERENCE][name] for name in ("slot", "time"))
        now = jax.tree.map(lambda leaf: at(leaf, time + 1), self.reference.trajectory)
        particles = jax.tree.map(lambda leaf, own: put(leaf, own, slot), mixture.particles, now)
        memory = mixture.memory | {REFERENCE: {"slot": slot, "time": time + 1}}
        return mixture.replace(particles=particles, memory=memory)


class ConditionalResample(AbstractResampling):
    """Resample within components, given that the reference has an offspring.

    The ancestor indices have the law of those of `Resample`, given that one slot of the reference's
    component, each with equal probability, has the reference for its parent. `draw_ancestors` says
    how. Other components are resampled as usual. `move` is the filter's own `Resample`.
    """

    move: Any

    def is_due(self, mixture: ParticleMixture) -> Bool[Array, " m"]:
        """Which components of `mixture` the move would resample."""
        return self.move.is_due(mixture)

    def would_resample(
        self, mixture: ParticleMixture, observation: PyTree = None
    ) -> Bool[Array, " m"]:
        """Those that are due."""
        return self.move.would_resample(mixture, observation)

    def __call__(
        self, key: Key[Array, ""], mixture: ParticleMixture, observation: PyTree = None
    ) -> ParticleMixture:
        """Resample every component that is due around the reference."""
        return self.redraw(key, mixture, self.is_due(mixture))[0]

    def redraw(
        self, key: Key[Array, ""], mixture: ParticleMixture, due: Bool[Array, " m"]
    ) -> tuple[ParticleMixture, Any]:
        """`Resample.redraw` around the reference."""
        reference = mixture.memory[REFERENCE]
        resampled, ancestors = self.move.redraw(key, mixture, due, keep=reference["slot"])
        memory = resampled.memory | {REFERENCE: reference | {"slot": ancestors.kept}}
        return resampled.replace(memory=memory), ancestors

    @property
    def particles_per_component(self) -> int | None:
        """That of the move."""
        return self.move.particles_per_component


def at(values: Array, place: Int[Array, ""]) -> Array:
    """The value at an index that is known to lie in range."""
    return take(values, place[None])[0]


def put(values: Array, value: Array, place: Int[Array, ""]) -> Array:
    """The values with another one at an index."""
    is_place = jnp.arange(values.shape[0], dtype=jnp.int32) == place
    return jnp.where(is_place.reshape(-1, *[1] * (values.ndim - 1)), value[None], values)
