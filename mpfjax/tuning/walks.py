"""Metropolis steps of Gaussian random walks, and how these learn their covariance."""

import math
from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int, Key

from mpfjax.arrays import POSITIVE
from mpfjax.checks import saying
from mpfjax.operations.matrices import cholesky
from mpfjax.tuning.densities import Point, chosen
from mpfjax.tuning.problem import Reals

# The best scale of a random walk in d dimensions is this over sqrt(d), times the target's own
# deviations (Gelman, Roberts and Gilks 1996).
_BEST_SCALE = 2.38
_LEARNING_EXPONENT = 0.6


class RandomWalk(eqx.Module):
    """u + F z, z standard normal, with F Fᵀ from the covariance of a posterior.

    The numbers of u stand in the order of their names.
    """

    factor: Float[Array, "d d"]
    mean: Float[Array, " d"]
    covariance: Float[Array, "d d"]
    log_scale: Float[Array, ""]

    def adapted(
        self,
        points: Float[Array, "chains d"],
        step: Int[Array, ""],
        acceptance: Float[Array, ""] | None,
    ) -> "RandomWalk":
        """The walk after one more point of each chain.

        Adaptive Metropolis (Haario, Saksman and Tamminen 2001) in the stochastic approximation of
        Andrieu and Thoms (2008, algorithm 4), with gains (step + 2)^-0.6. The scale follows the
        acceptance, where that is given; noise in a likelihood would drive it to zero.
        """
        gain = (jnp.asarray(step, points.dtype) + 2.0) ** -_LEARNING_EXPONENT
        centred = points - self.mean[None]
        mean = self.mean + gain * jnp.mean(centred, axis=0)
        spread = jnp.matmul(centred.T, centred, precision="highest") / points.shape[0]
        covariance = self.covariance + gain * (spread - self.covariance)
        log_scale = self.log_scale
        if acceptance is not None:
            # The share of steps that the best random walk accepts.
            best = 0.44 if points.shape[1] == 1 else 0.234
            log_scale = log_scale + gain * (acceptance - best)
        factor = jnp.exp(log_scale) * factor_of(covariance)
        return RandomWalk(factor, mean, covariance, log_scale)


def random_walk(deviations: Reals, starts: Reals) -> RandomWalk:
    """The walk with these deviations, and with the mean of the chains' starts."""
    scales, _ = ravel_pytree(deviations)
    points = jax.vmap(lambda reals: ravel_pytree(reals)[0])(starts)
    covariance = jnp.diag(scales**2) / (_BEST_SCALE**2 / len(scales))
    nothing = jnp.zeros((), scales.dtype)
    return RandomWalk(jnp.diag(scales), jnp.mean(points, axis=0), covariance, nothing)


def factor_of(covariance: Float[Array, "d d"]) -> Float[Array, "d d"]:
    """F of the best random walk on a target of this covariance."""
    return cholesky(covariance[None])[0] * math.sqrt(_BEST_SCALE**2 / len(covariance))


def metropolis_step(
    key: Key[Array, ""],
    factor: Float[Array, "d d"],
    point: Point,
    evaluate: Callable[[Key[Array, ""], Reals], tuple[Point, dict[str, Array]]],
) -> tuple[Point, Bool[Array, ""], dict[str, Array]]:
    """A step of the walk u + F z, accepted or not: the point, whether it moved, what was no number.

    `evaluate` gives the point at other parameters by a key that is always new, and which of its
    densities were no numbers.
    """
    key_walk, key_fresh, key_accept = jax.random.split(key, 3)
    u, unravel = ravel_pytree(point.reals)
    noise = jax.random.normal(key_walk, u.shape, u.dtype)
    reals = unravel(u + jnp.matmul(factor, noise, precision="highest"))
    proposed, invalid = evaluate(key_fresh, reals)
    gain = proposed.log_density - point.log_density  # where it is NaN, the step is rejected
    accepted = jnp.log(jax.random.uniform(key_accept, (), gain.dtype)) < gain
    return chosen(accepted, proposed, point), accepted, invalid


def checked_deviations(values: float | Mapping[str, Any], start: Reals) -> Reals:
    """The deviation of each unconstrained number; a `ValueError` for anything else."""
    by_name = values if isinstance(values, Mapping) else dict.fromkeys(start, values)
    if set(by_name) != set(start):
        raise ValueError(f"proposal_deviations: those of {sorted(by_name)}, not of {sorted(start)}")
    deviations = {}
    for name, u in start.items():
        with saying(f"proposal_deviations of {name}"):
            deviations[name] = jnp.broadcast_to(jnp.asarray(by_name[name], u.dtype), u.shape)
        POSITIVE.check(deviations[name], f"proposal_deviations: {name}")
    return deviations
