"""Which slots a resampling move gives to which component."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mpfjax.mixture import ParticleMixture
from mpfjax.operations.segments import segments_in_order, spread
from mpfjax.operations.stored import stored

# A component is dealt at least its equal share divided by this, however little it asks for.
LEAST_SHARE = 10


class Slots(NamedTuple):
    """Where the new particles of each component will stand: side by side, empty slots last."""

    components: Int[Array, " n"]
    ranks: Int[Array, " n"]  # within the component
    firsts: Int[Array, " m"]
    filled: Bool[Array, " n"]


def allocate_slots(
    counts: Int[Array, " m"],
    due: Bool[Array, " m"],
    mixture: ParticleMixture,
    particles_per_component: int | None,
    demands: Float[Array, " m"] | None = None,
) -> Int[Array, " m"]:
    """How many slots each component gets.

    Components that are not due keep their slots, `counts`. The others share the rest of the usable
    slots equally, or in proportion to their `demands`, or get `particles_per_component` each if
    that is a number.
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
    if demands is None:
        share = _evenly(pool, due, sharers)
    else:
        least = jnp.minimum(jnp.maximum(pool // (sharers * LEAST_SHARE), 1), pool // sharers)
        share = least + _in_proportion(pool - least * sharers, due, demands)
    return stored(jnp.where(due, share, kept), num_slots + 1)


def _evenly(
    pool: Int[Array, ""], due: Bool[Array, " m"], sharers: Int[Array, ""]
) -> Int[Array, " m"]:
    """The same number for each, and one more for the first ones where it does not divide."""
    rank = jnp.cumsum(due.astype(jnp.int32)) - 1
    return pool // sharers + (rank < pool % sharers).astype(jnp.int32)


def _in_proportion(
    pool: Int[Array, ""], due: Bool[Array, " m"], demands: Float[Array, " m"]
) -> Int[Array, " m"]:
    """Whole numbers that sum to the pool, each within one of its part."""
    asked = jnp.where(due, demands, 0)
    total = jnp.sum(asked)
    asked = jnp.where(total > 0, asked, due.astype(asked.dtype))
    parts = jnp.cumsum(asked) / jnp.maximum(jnp.sum(asked), jnp.finfo(asked.dtype).tiny)
    ends = jnp.round(parts * pool.astype(asked.dtype)).astype(jnp.int32)
    # Rounding must not leave slots over, nor give any to a component that is not due.
    still_due = jnp.cumsum(due[::-1].astype(jnp.int32))[::-1] - due.astype(jnp.int32)
    ends = jnp.where(still_due > 0, jnp.minimum(ends, pool), pool)
    return jnp.diff(ends, prepend=0)


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
