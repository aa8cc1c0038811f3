"""Whether a filter keeps every mode, and how much mass it gives to each."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mpfjax.mixture import ParticleMixture


def modes_represented(
    positions: Float[Array, "*batch n"],
    occupied: Bool[Array, "*batch n"],
    modes: Float[Array, "*batch k"],
    radius: float,
) -> Bool[Array, "*batch k"]:
    """Whether some particle of positive weight lies within `radius` of each mode.

    Vermaak et al. (2003), section 5.1, count the steps at which both modes are represented; their
    share over a run is its score. Positions, modes and radius are in the state's unit. Use it on
    a model whose modes are known.
    """
    distance = jnp.abs(positions[..., None, :] - modes[..., :, None])
    return jnp.any((distance < radius) & occupied[..., None, :], axis=-1)


def mass_above(mixture: ParticleMixture, threshold: float) -> Float[Array, ""]:
    """P(x_t > threshold | y_1..y_t) of a scalar state, a particle at the threshold counting half.

    The particles' estimate of `GridFilterRun.mass_above`. With a threshold between two modes it
    is the mass of the upper one.
    """
    positions = mixture.particles.reshape(mixture.num_particles)
    above = jnp.where(positions > threshold, 1.0, jnp.where(positions == threshold, 0.5, 0.0))
    return mixture.average(above.astype(positions.dtype))
