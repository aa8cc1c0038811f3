"""The Kalman filter's arithmetic for many particles at once, the particles last.

Means are (d, n), covariances (d, d, n); what is shared by all particles has a last axis of 1.
"""

import math
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mpfjax.operations.stacks import (
    applied,
    product,
    sandwiched,
    solve_lower,
    symmetric,
    without_correlations,
)
from mpfjax.operations.stored import stored


class Gaussian(NamedTuple):
    """N(mean, covariance) of each particle."""

    mean: Float[Array, "d n"]
    covariance: Float[Array, "d d n"]


class Linear(NamedTuple):
    """A x + b + N(0, noise): a step of linear dynamics, or an observation of x."""

    matrix: Float[Array, "e d n"]
    offset: Float[Array, "e n"]
    noise: Float[Array, "e e n"]


def predict(state: Gaussian, dynamics: Linear) -> Gaussian:
    """The law of F x + b + N(0, Q)."""
    matrix, offset, noise = stored(dynamics.matrix), dynamics.offset, dynamics.noise
    covariance = sandwiched(matrix, state.covariance) + noise
    return Gaussian(applied(matrix, state.mean) + offset, stored(covariance))


def through(dynamics: Linear, seen: Linear) -> Linear:
    """y of F x + b + N(0, Q) as an observation of x: H F x + H b + c + N(0, H Q Hᵀ + R)."""
    matrix, offset, noise = dynamics
    return Linear(
        product(seen.matrix, matrix),
        applied(seen.matrix, offset) + seen.offset,
        sandwiched(seen.matrix, noise) + seen.noise,
    )


def update(
    state: Gaussian, observation: Float[Array, "p #n"], seen: Linear
) -> tuple[Gaussian, Float[Array, " n"]]:
    """The law of x given y = H x + c + N(0, R), and log p(y), of each particle.

    R = L D Lᵀ takes the correlations out, and the entries of L⁻¹ y come in one after the other:
    R may be singular, and no sum of a large variance and a small R has to hold both. The covariance
    is in Joseph's form, (I - K h) P (I - K h)ᵀ + r K Kᵀ, where rounding of the gain K counts in the
    second order only; for one entry it takes O(d²). An entry of y that is NaN is missing.
    """
    observation, seen, present = without_missing(observation, seen)
    law, log_density = update_by_all(state, observation, seen)
    missing = jnp.sum((~present).astype(log_density.dtype), axis=0)
    return law, log_density + 0.5 * math.log(2 * math.pi) * missing


def update_by_all(
    state: Gaussian, observation: Float[Array, "p #n"], seen: Linear
) -> tuple[Gaussian, Float[Array, " n"]]:
    """The same where no entry of y is missing: what all particles share stays shared."""
    factor, variances = without_correlations(seen.noise)
    rows = solve_lower(factor, seen.matrix)
    targets = stored(solve_lower(factor, (observation - seen.offset)[:, None])[:, 0])
    log_density = jnp.asarray(-0.5 * math.log(2 * math.pi) * len(rows), rows.dtype)
    for row, target, variance in zip(rows, targets, variances, strict=True):
        state, log_factor = _update_by_one(state, row, target, variance)
        log_density = log_density + log_factor
    return state, log_density


def _update_by_one(
    state: Gaussian, row: Float[Array, "d #n"], target: Float[Array, " #n"], variance: Array
) -> tuple[Gaussian, Float[Array, " n"]]:
    """The same for one number, h x + N(0, r), and log p(y) but for the factor 2 pi."""
    mean, covariance = state
    seen = stored(applied(covariance, row))
    known = applied(row[None], seen)[0]
    # Rounding may leave a zero variance slightly negative.
    spread = jnp.maximum(known, 0.0) + variance
    has_spread = spread > 0
    spread = jnp.where(has_spread, spread, jnp.finfo(mean.dtype).tiny)
    precision, log_spread = _once(1 / spread), _once(jnp.log(spread))
    missed = target - applied(row[None], mean)[0]
    gain = stored(jnp.where(has_spread, precision, 0.0)[None] * seen)
    left = covariance - gain[:, None] * seen[None]
    both = left - applied(left, row)[:, None] * gain[None]
    both = both + variance[None, None] * gain[:, None] * gain[None]
    log_density = -0.5 * (precision * missed**2 + log_spread)
    return Gaussian(mean + gain * missed[None], symmetric(both)), log_density


def _once(values: Float[Array, "*rest n"]) -> Float[Array, "*rest n"]:
    """The values, `stored` if all particles share them, each of which would compute them anew."""
    return stored(values) if values.shape[-1] == 1 else values


def without_missing(
    observation: Float[Array, "p #n"], seen: Linear
) -> tuple[Float[Array, "p #n"], Linear, Bool[Array, "p #n"]]:
    """The same without the entries that are NaN: in their place stands a zero of variance 1."""
    present = ~jnp.isnan(observation)
    here = present.astype(seen.matrix.dtype)
    both = present[:, None] & present[None]
    alone = jnp.eye(len(here), dtype=here.dtype)[:, :, None]
    clear = Linear(
        jnp.where(present[:, None], seen.matrix, 0.0),
        jnp.where(present, seen.offset, 0.0),
        jnp.where(both, seen.noise, alone * (1 - here[None])),
    )
    return jnp.where(present, observation, 0.0), clear, present
