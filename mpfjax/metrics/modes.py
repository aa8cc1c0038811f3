"""Whether a filter keeps every mode, and the mass that it gives to each."""

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mpfjax.checks import check_finite, check_positive, check_shape, check_type, real_arrays
from mpfjax.mixture import ParticleMixture


def modes_represented(
    positions: Float[Array, "*batch n"],
    occupied: Bool[Array, "*batch n"],
    modes: Float[Array, "*batch k"],
    radius: float,
) -> Bool[Array, "*batch k"]:
    """Whether some particle of positive weight lies within `radius` of each mode.

    Vermaak et al. (2003), section 5.1, count the steps at which both modes are represented; their
    share over a run is its score. Positions, modes and radius are in the state's unit. Use it on a
    model whose modes are known. Raises `ValueError` for anything but arrays, masks of another shape
    than the positions, and a radius that is not positive and finite.
    """
    check_shape("... n", occupied=occupied)
    positions = real_arrays("... n", positions=positions)
    modes = real_arrays("... k", modes=modes)
    if occupied.shape != positions.shape or occupied.dtype != bool:
        raise ValueError(f"occupied: {occupied.dtype}{occupied.shape} is no mask of the positions")
    if modes.shape[:-1] != positions.shape[:-1]:
        raise ValueError(f"modes: shape {modes.shape} does not go with that of {positions.shape}")
    if not isinstance(radius, jax.Array):
        check_positive(radius=radius)
    distance = jnp.abs(positions[..., None, :] - modes[..., :, None])
    return jnp.any((distance < radius) & occupied[..., None, :], axis=-1)


def mass_above(mixture: ParticleMixture, threshold: float) -> Float[Array, ""]:
    """P(x_t > threshold | y_1..y_t) of a scalar state; a particle at the threshold counts half.

    The particles' estimate of `GridFilterRun.mass_above`. With a threshold between two modes it is
    the mass of the upper one. Raises `ValueError` for a threshold that is not finite, and for
    anything but a mixture of scalar states.
    """
    check_type(ParticleMixture, "a ParticleMixture", mixture=mixture)
    shapes = [leaf.shape for leaf in jax.tree.leaves(mixture.particles)]
    if len(shapes) != 1 or math.prod(shapes[0]) != mixture.num_particles:
        raise ValueError(f"mixture: particles of shapes {shapes} are no scalars")
    if not isinstance(threshold, jax.Array):
        check_finite(threshold=threshold)
    positions = jax.tree.leaves(mixture.particles)[0].reshape(mixture.num_particles)
    below = jnp.where(positions < threshold, 0.0, jnp.nan)
    above = jnp.where(positions > threshold, 1.0, jnp.where(positions == threshold, 0.5, below))
    return mixture.average(above.astype(mixture.log_weights.dtype))
