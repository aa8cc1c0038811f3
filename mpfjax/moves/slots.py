"""Which slots a rejuvenating move gives to which component."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from mpfjax.mixture import ParticleMixture
from mpfjax.operations.segments import segments_in_order, spread
from mpfjax.operations.stored import stored


class Slots(NamedTuple):
    """Where the new particles of each component will stand: side by side, empty slots last."""

    components: Int[Array, " n"]
    ranks: Int[Array, " n"]  # within the component
    firsts: Int[Array, " m"]
    filled: Bool[Array, " n"]


def deal_slots(
    counts: Int[Array, " m"],
    due: Bool[Array, " m"],
    mixture: ParticleMixture,
    particles_per_component: int | None,
) -> Int[Array, " m"]:
    """How many slots each component gets.

    Components that are not due keep their slots, `counts`. The others share the rest of the usable
    slots equally, or get `particles_per_component` each if that is a number.
    """
    usable, num_slots = mixture.num_usable_slots, mixture.num_particles
    if particles_per_component is not None:
        share = jnp.asarray(min(particles_per_component, num_slots), jnp.int32)
        return jnp.where(counts > 0, share, 0)
    kept = jnp.where(due, 0, counts)
    if counts.shape[0] == 1:
        return jnp.where(due, usable, kept)
    pool = usable - jnp.sum(kept, dtype=jnp.int32)
    sharers = jnp.maximum(jnp.sum(due, dtype=jnp.int32), 1)
    rank = jnp.cumsum(due.astype(jnp.int32)) - 1
    share = pool // sharers + (rank < pool % sharers).astype(jnp.int32)
    return stored(jnp.where(due, share, kept), num_slots + 1)


def place_slots(targets: Int[Array, " m"], num_particles: int) -> Slots:
    """The slots of each component, given how many it gets."""
    firsts = jnp.cumsum(targets) - targets
    slot = jnp.arange(num_particles, dtype=jnp.int32)
    components = segments_in_order(firsts, num_particles)
    return Slots(
        components=components,
        ranks=slot - spread(firsts, components),
        firsts=firsts,
        filled=slot < jnp.sum(targets, dtype=jnp.int32),
    )


def require_equal_rows(mixture: ParticleMixture, who: str) -> None:
    """Raise a `ValueError` unless there is one component, which may fill every slot."""
    if mixture.num_components != 1:
        raise ValueError(f"mixture: {mixture.num_components} components, not one")
    if mixture.usable_slots is not None:
        raise ValueError(f"slots: {who} fills every slot, and cannot leave some of them empty")
