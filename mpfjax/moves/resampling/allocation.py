"""Which slots a resampling move gives to which component."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mpfjax.mixture import ParticleMixture
from mpfjax.operations.logarithms import scaled_exp
from mpfjax.operations.segments import segments_in_order, spread
from mpfjax.operations.stored import stored

# A component is dealt at least its equal share divided by this, however little it asks for.
LEAST_SHARE = 10
# For the least error, so many particles say what a component needs; fewer do not.
FEWEST = 10
# A mode dies at a step with a probability of about exp(-5) if so many effective particles stay.
SURVIVORS = 5


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
    least: Float[Array, ""] | None = None,
) -> Int[Array, " m"]:
    """How many slots each component gets.

    Components that are not due keep their slots, `counts`. The others share the rest of the usable
    slots equally, or in proportion to their `demands`, or get `particles_per_component` each if
    that is a number. With demands, each first gets its equal share where that is `FEWEST` or less,
    and else `least`, of half an equal share at most; None is a tenth of an equal share.
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
        equal_share = pool // sharers
        if least is None:
            kept_alive = jnp.maximum(pool // (sharers * LEAST_SHARE), 1)
        else:
            needed = jnp.minimum(least, equal_share.astype(least.dtype) / 2).astype(jnp.int32)
            kept_alive = jnp.maximum(needed, FEWEST)
        first = jnp.minimum(kept_alive, equal_share)
        share = first + _in_proportion(pool - first * sharers, due, demands)
    return stored(jnp.where(due, share, kept), num_slots + 1)


def demands_for_least_error(
    mixture: ParticleMixture, due: Bool[Array, " m"]
) -> tuple[Float[Array, " m"], Float[Array, ""]]:
    """What each component asks for, and how many slots keep a mode alive.

    The mean likelihood of k_m particles has a relative variance in proportion to v_m / k_m, with
    v_m = (particles of m) / ESS_m from the weights as they are. So log Ẑ and the mixture weights
    err by sums Σ_m a_m² v_m / k_m, which k_m in proportion to a_m v_m^(1/2) make least (Neyman
    1934):

    - log Ẑ, by later observations: a_m² = π_m. What counts is E[p_m²], where p_m is the mass that
      component m of today will have been given. p_m is a martingale from π_m on; its square is
      expected to be π_m² if nothing more is learned, and π_m if all is settled, which is most.
    - the mixture weights, summed over components: dπ_m = π_m (e_m - Σ_l π_l e_l) for errors e, so
      a_m² = π_m² [(1 - π_m)² + Σ_{l ≠ m} π_l²]. Two components ask for the same, whatever π is.

    The demand is the mean of the two solutions: neither variance is more than twice the least one.
    Where a component has few particles, v_m is drawn towards the mean over all, by `FEWEST`.
    """
    weights, _ = scaled_exp(mixture.log_weights)
    counts = mixture.component_counts.astype(weights.dtype)
    sums = mixture.component_sums(weights)
    divisor = jnp.where(sums > 0, sums, 1.0)
    # Divided one after the other: the square of a small mass is zero.
    variances = counts * (mixture.component_sums(weights**2) / divisor) / divisor
    variances = jnp.clip(variances, 1.0, jnp.maximum(counts, 1.0))
    sharing = jnp.where(due, counts, 0.0)
    mean_variance = jnp.sum(sharing * variances) / jnp.maximum(jnp.sum(sharing), 1.0)
    variances = (counts * variances + FEWEST * mean_variance) / (counts + FEWEST)

    masses = sums / jnp.sum(sums)
    # Not 1 - π, which rounding would make zero.
    others = jnp.where(jnp.eye(len(masses), dtype=bool), 0.0, masses[None])
    of_masses = masses * jnp.sqrt(jnp.sum(others, axis=1) ** 2 + jnp.sum(others**2, axis=1))
    spreads = jnp.where(due, jnp.sqrt(variances), 0.0)
    demands = _as_shares(jnp.sqrt(masses) * spreads) + _as_shares(of_masses * spreads)
    return demands, SURVIVORS * mean_variance


def _as_shares(demands: Float[Array, " m"]) -> Float[Array, " m"]:
    total = jnp.sum(demands)
    return demands / jnp.where(total > 0, total, 1.0)


def _evenly(
    pool: Int[Array, ""], due: Bool[Array, " m"], sharers: Int[Array, ""]
) -> Int[Array, " m"]:
    """The same number for each, and one more for the first ones where it does not divide."""
    rank = jnp.cumsum(due.astype(jnp.int32)) - 1
    share = jax.lax.div(pool, sharers)  # neither is negative
    return share + (rank < pool - share * sharers).astype(jnp.int32)


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
