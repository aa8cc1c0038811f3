"""Nested propagation: each particle draws several x_t, one of which is retained."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Key

from mpfjax.checks import Count
from mpfjax.mixture import ParticleMixture
from mpfjax.moves.base import AbstractPropagationOfEach, AbstractWrapper, Step
from mpfjax.moves.propagation.propagate import Propagate
from mpfjax.operations.logarithms import finite_or_zero
from mpfjax.operations.random import split, uniform
from mpfjax.operations.stored import take


class PropagateNested(AbstractPropagationOfEach, AbstractWrapper):
    """Draw K values of x_t for each particle, and retain one by its weight.

    Draw x_t^ik of particle i has the factor g_ik = L D / q. The particle is weighted by the mean of
    its factors, (1 / K) Σ_k g_ik, and retains draw k with probability g_ik / Σ_j g_ij. This is
    nested sequential Monte Carlo in its simplest form (Naesseth, Lindsten and Schön 2015): a filter
    of K N particles that retains one child of each parent. Ẑ is the estimate of K N particles, and
    unbiased. The model is evaluated K N times, but only N particles are resampled, sorted and
    regrouped.

    - `propagate`: the `Propagate` that draws. With its noise "rqmc" all K N draws are one point
      set, in which the draws of a particle are neighbours.
    - `num_draws`: K.

    Raises `ValueError` for K < 1, and for gradient "stop", which ignores the choice among the
    draws. Use it if the likelihood is narrow and cheap, with four to sixteen draws.
    """

    propagate: Propagate
    num_draws: Count = eqx.field(static=True)

    holds = ("propagate",)
    biases_score = True
    """a derivative does not see which draw is kept."""

    def __check_init__(self) -> None:
        super().__check_init__()
        if self.propagate.gradient == "stop":
            raise ValueError("propagate: gradient 'stop' does not see which draw is kept")

    def __call__(self, key: Key[Array, ""], mixture: ParticleMixture, now: Step) -> ParticleMixture:
        """Propagate every particle and weigh it by y_t."""
        if now.is_missing:
            # Without an observation all draws of a particle have the same weight.
            return self.propagate(key, mixture, now)
        n, k = mixture.num_particles, self.num_draws
        key_draws, key_kept = split(key, 2)
        repeated = mixture.repeat(k)
        repeated = repeated.replace(log_weights=repeated.log_weights - math.log(k))
        families = self.propagate(key_draws, repeated, now)
        shares = uniform(key_kept, (n,), mixture.log_weights.dtype)
        log_weights = families.log_weights.reshape(n, k)
        largest = finite_or_zero(jnp.max(log_weights, axis=1, keepdims=True))
        weights = jnp.exp(log_weights - largest)
        upto = jnp.cumsum(jax.lax.stop_gradient(weights), axis=1)
        shares = shares.astype(upto.dtype)
        # The last is left out: rounding must not select a draw past the end.
        choice = jnp.sum(upto[:, :-1] <= shares[:, None] * upto[:, -1:], axis=1, dtype=jnp.int32)
        places = jnp.arange(n, dtype=jnp.int32) * k + choice
        return mixture.replace(
            particles=jax.tree.map(lambda leaf: take(leaf, places), families.particles),
            log_weights=largest[:, 0] + jnp.log(jnp.sum(weights, axis=1)),
            log_scale=families.log_scale,
        )
