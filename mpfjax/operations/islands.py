"""Sums over islands of particles, and exchanges between them.

In numpy, islands would be a leading axis. Here they are two named axes, one of devices and one of
islands on a device. Outside `run_islands` there is one island.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from mpfjax.operations.logarithms import finite_max, log_sum_exp

DEVICE_AXIS = "mpfjax_devices"
ISLAND_AXIS = "mpfjax_islands"


def num_islands() -> int:
    """The number of islands; 1 outside `run_islands`."""
    try:
        # Constants, known during tracing.
        return jax.lax.psum(1, ISLAND_AXIS) * jax.lax.psum(1, DEVICE_AXIS)
    except NameError:
        return 1


def sum_over_islands(value: Array) -> Array:
    """The sum over all islands of what each has; the value itself where there is one."""
    return value if num_islands() == 1 else jax.lax.psum(value, (ISLAND_AXIS, DEVICE_AXIS))


def island_index() -> Int[Array, ""]:
    """The index of this island, from 0. Only inside `run_islands`."""
    first = jax.lax.axis_index(DEVICE_AXIS) * jax.lax.psum(1, ISLAND_AXIS)
    return first + jax.lax.axis_index(ISLAND_AXIS)


def over_islands(value: Array) -> Array:
    """The values of all islands, in their order, on a new leading axis; the same for each.

    The order does not depend on the number of devices, and so a sum does not either.
    """
    on_device = jax.lax.all_gather(value, ISLAND_AXIS)
    everywhere = jax.lax.all_gather(on_device, DEVICE_AXIS)
    return everywhere.reshape(-1, *value.shape)


def excess_over_islands(
    log_scale: Float[Array, ""], log_largest: Float[Array, ""], log_sum: Float[Array, ""]
) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]:
    """The excess of an island's scale over that of all islands, and log of the mass of all.

    The log mass of an island is given in three parts, scale + largest + sum. That of all islands is
    returned in two, total + scale. So rounding of a large part does not destroy a small one. Each
    island sends O(1) numbers. Outside `run_islands` there is one island, and its excess is 0.
    """
    if num_islands() == 1:
        return jnp.zeros_like(log_sum), log_sum, log_scale + log_largest
    scales, largest, sums = over_islands(jnp.stack([log_scale, log_largest, log_sum])).T
    counts = sums > -jnp.inf
    # Part by part, which is exact; an island without mass does not count.
    common = finite_max(jnp.where(counts, scales, -jnp.inf))
    shift = finite_max(jnp.where(counts, (scales - common) + largest, -jnp.inf))
    log_total = log_sum_exp(sums + (((scales - common) + largest) - shift))
    return ((log_scale - common) + log_largest) - shift, log_total, common + shift
