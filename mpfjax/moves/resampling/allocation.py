"""Allocation: how many slots each component receives in a resampling, and which."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mpfjax.mixture import ParticleMixture
from mpfjax.operations.logarithms import scaled_exp
from mpfjax.operations.prefix_sums import count_starts
from mpfjax.operations.segments import spread
from mpfjax.operations.stored import stored

# Bounds of the share of the slots that is shared equally: the variance of Ẑ is then at most
# 4/3 of the least one at the first, and twice the least one at the second.
EQUAL_PARTS = (1 / 4, 1 / 2)
# Effective particles that keep a mode alive, and that make an estimate of its variance reliable.
FEWEST = 10


class Slots(NamedTuple):
    """The slots of each component's new particles: side by side, empty slots last."""

    components: Int[Array, " n"]
    ranks: Int[Array, " n"]  # within the component
    firsts: Int[Array, " m"]
    filled: Bool[Array, " n"]


def allocate_slots(
    counts: Int[Array, " m"],
    due: Bool[Array, " m"],
    num_slots: int | Int[Array, ""],
    particles_per_component: int | None,
    demands: Float[Array, " m"],
) -> Int[Array, " m"]:
    """How many slots each component gets.

    Components that are not due keep theirs, `counts`. The others share the rest of the slots in
    proportion to `demands` with at least one each; or get `particles_per_component` each.
    """
    if particles_per_component is not None:
        share = jnp.minimum(jnp.asarray(particles_per_component, jnp.int32), num_slots)
        return jnp.where(due, share, counts)
    if counts.shape[0] == 1:
        return jnp.where(due, num_slots, counts)
    pool = num_slots - jnp.sum(counts, dtype=jnp.int32)
    sharers = jnp.maximum(jnp.sum(due, dtype=jnp.int32), 1)
    first = jnp.minimum(pool // sharers, 1)
    share = first + _in_proportion(pool - first * sharers, due, demands)
    return stored(jnp.where(due, share, counts))


def demands_by_variance(
    log_masses: Float[Array, " m"],
    sample_sizes: Float[Array, " m"],
    counts: Int[Array, " m"],
    due: Bool[Array, " m"],
    num_slots: int | Int[Array, ""],
) -> Float[Array, " m"]:
    """The share of the slots that each due component asks for, by mass and variance.

    The mean likelihood of k_m particles has a relative variance v_m / k_m, where v_m is estimated
    by (particles of m) / ESS_m, `counts` over the effective `sample_sizes`. The variance of Ẑ is
    then Σ_m π_m² v_m / k_m, which is least for k_m in proportion to π_m v_m^(1/2) (Neyman 1934).
    Where a component has few particles, v_m is shrunk towards the mean over all components, as if
    `FEWEST` more particles had that mean.

    A mode has to stay alive, and its own moments have an error too. A part e of the slots is
    therefore shared equally: as much as gives each component `FEWEST` effective particles, within
    `EQUAL_PARTS`. The variance of Ẑ is then at most 1 / (1 - e) times the least one (a defensive
    mixture: Hesterberg 1995). All slots are shared equally where this gives `FEWEST` particles or
    less to each.
    """
    dtype = log_masses.dtype
    sharing = jnp.where(due, counts, 0).astype(dtype)
    variances = jnp.maximum(sharing / jnp.maximum(sample_sizes, 1.0), 1.0)
    mean_variance = jnp.sum(sharing * variances) / jnp.maximum(jnp.sum(sharing), 1.0)
    variances = (sharing * variances + FEWEST * mean_variance) / (sharing + FEWEST)

    masses, _ = scaled_exp(jnp.where(due, log_masses, -jnp.inf))
    demands = masses * jnp.sqrt(variances)
    total = jnp.sum(demands)
    sharers = jnp.maximum(jnp.sum(due.astype(dtype)), 1.0)
    slots_each = jnp.asarray(num_slots, dtype) / sharers
    equal_part = jnp.clip(FEWEST * mean_variance / slots_each, *EQUAL_PARTS)
    equal_part = jnp.where((total > 0) & (slots_each > FEWEST), equal_part, 1.0)
    demands = demands / jnp.where(total > 0, total, 1.0)
    return jnp.where(due, equal_part / sharers, 0.0) + (1 - equal_part) * demands


def demands_of_groups(
    mixture: ParticleMixture, groups: Int[Array, " n"], due: Bool[Array, " m"]
) -> Float[Array, " m"]:
    """For each component, one over the number of components of its group that share slots."""
    group = mixture.component_groups(groups)
    rivals = jnp.sum((group[:, None] == group[None]) & due[None], axis=1)
    return 1 / jnp.maximum(rivals, 1).astype(mixture.log_weights.dtype)


def _in_proportion(
    pool: Int[Array, ""], due: Bool[Array, " m"], demands: Float[Array, " m"]
) -> Int[Array, " m"]:
    """Integers that sum to `pool`, each within one of its exact part."""
    shares = jnp.where(due, demands, 0)
    total = jnp.sum(shares)
    shares = jnp.where(total > 0, shares, due.astype(shares.dtype))
    parts = jnp.cumsum(shares) / jnp.maximum(jnp.sum(shares), jnp.finfo(shares.dtype).tiny)
    ends = jnp.round(parts * pool.astype(shares.dtype)).astype(jnp.int32)
    # Despite rounding all slots are given, and none to a component that is not due.
    still_due = jnp.cumsum(due[::-1], dtype=jnp.int32)[::-1] - due.astype(jnp.int32)
    ends = jnp.where(still_due > 0, jnp.minimum(ends, pool), pool)
    return jnp.diff(ends, prepend=0)


def place_slots(targets: Int[Array, " m"], num_particles: int) -> Slots:
    """The slots of each component, given their number for each."""
    firsts = jnp.cumsum(targets, dtype=jnp.int32) - targets
    slot = jnp.arange(num_particles, dtype=jnp.int32)
    components = count_starts(firsts, num_particles)
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
        raise ValueError(f"num_slots: {who} fills every slot, and cannot leave some of them empty")
