"""x_0: its draws, and the choice among many draws by the first observation."""

from collections.abc import Callable
from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key, PyTree

from mpfjax.checks import Count, shown
from mpfjax.mixture import ParticleMixture, single_component
from mpfjax.models.base import (
    AbstractStateSpaceModel,
    check_states,
    is_made_of_noise,
    saying_that_none_were_given,
)
from mpfjax.models.conditionally_linear import with_moments
from mpfjax.models.noise import Noise, draw_noise
from mpfjax.moves.base import AbstractMove
from mpfjax.moves.resampling.ancestors import draw_ancestors
from mpfjax.moves.resampling.line import HILBERT, Line, sorted_order
from mpfjax.operations.logarithms import default_float, exp, finite_or_zero, largest
from mpfjax.operations.random import split
from mpfjax.operations.stored import stored, take, whole

# A particle that the first observation tells nothing of keeps a quarter of its chance, so that no
# weight is more than four times the mean.
MOST_TRUST = 3 / 4


def sample_initial(
    key: Key[Array, ""],
    model: AbstractStateSpaceModel,
    num_particles: int,
    noise: str = "independent",
) -> PyTree:
    """The particles of x_0, of this noise if the model can; raises for leaves of another length."""
    with saying_that_none_were_given(model):
        if noise == "independent" or not is_made_of_noise(model, "initial"):
            particles = model.sample_initial(key, num_particles)
        else:
            maker = cast(Any, model)
            shape = (num_particles, maker.initial_noise_dimension)
            particles = maker.initial_from_noise(draw_noise(noise, key, shape, default_float()))
        check_states(particles, model, "sample_initial", num_particles)
        return with_moments(model, particles)


class SelectInitial(AbstractMove):
    """An initial move that draws x_0 many times, and keeps the draws that y_1 speaks for.

    K N draws of x_0 take the place of the mixture's N. From each, x_1 is drawn twice, and ν is the
    mean of the two likelihoods of y_1, shrunk towards the mean of all by the share of its variance
    that is not x_0's (`trusted`). N particles are kept with probabilities in proportion to ν, and
    weigh 1 / ν, so that they represent x_0 as all draws do. Their mass is part of the first
    increment, and Ẑ stays unbiased. A wide prior is covered as by K N particles, at the cost of
    2 K more draws of x_1 in the whole run.

    Without an observation it does nothing. Where an initial move weighs x_0, the chain's `Resample`
    waits for y_1: it would undo the choice.

    - `propagation`: draws x_1, and weighs it: a `Propagate` or `PropagateNested`, usually the
      filter's own.
    - `num_draws`: K.
    - `noise`: that of the draws of x_0, as `Filter.initial_noise`. With "rqmc" they are kept in
      order along a Hilbert curve.

    Put it first among `initial_moves`, before those that regroup. Raises `ValueError` for another
    propagation, K < 1 and unknown noise. Use it where the prior is wide beside the likelihood.
    """

    propagation: Any
    num_draws: Count = eqx.field(static=True, default=4)
    noise: Noise = eqx.field(static=True, default="independent")

    def __check_init__(self) -> None:
        if not getattr(self.propagation, "draws_each", False):
            raise ValueError(
                f"propagation: {shown(self.propagation)} does not draw x_1 of each x_0"
            )

    def map_inner(self, change: Callable[[Any], Any]) -> "SelectInitial":
        """The same with another propagation."""
        return SelectInitial(change(self.propagation), self.num_draws, self.noise)

    def __call__(
        self, key: Key[Array, ""], mixture: ParticleMixture, observation: PyTree = None
    ) -> ParticleMixture:
        """The mixture of the chosen x_0, in one component; without y_1 the one given."""
        if observation is None:
            return mixture
        key_drawn, key_look, key_kept = split(key, 3)
        num_drawn = self.num_draws * mixture.num_particles
        drawn = sample_initial(key_drawn, self.propagation.model, num_drawn, self.noise)
        pool = single_component(drawn)
        log_factors = self._look(key_look, pool, observation)
        chances = trusted(log_factors, pool.occupied.astype(log_factors.dtype))
        chances = stored(jax.lax.stop_gradient(chances))
        is_sorted = self.noise == "rqmc"
        order = sorted_order(pool, pool.component_indicators, HILBERT) if is_sorted else None
        weights = whole(chances if order is None else take(chances, order), 0.0)
        totals = jnp.sum(weights, keepdims=True)
        line = Line(num_drawn, weights, totals, jnp.zeros_like(totals), weights > 0, order)
        n = mixture.num_particles
        targets = jnp.full(1, n, jnp.int32)
        kept = draw_ancestors(key_kept, line, targets, "systematic", num_slots=n).particles
        trust = take(chances, kept).astype(default_float())
        # No ν is below a quarter, so that their inverses need no logarithms to be summed.
        total = jnp.sum(1 / trust)
        particles = jax.tree.map(lambda leaf: take(leaf, kept), drawn)
        return single_component(particles, mixture.num_components).replace(
            log_weights=-jnp.log(trust * total),
            log_scale=jnp.log(total / n),
            memory=mixture.memory,
        )

    def _look(
        self, key: Key[Array, ""], pool: ParticleMixture, observation: PyTree
    ) -> Float[Array, "2 n"]:
        """The logarithms of the weights of two draws of x_1 of each particle, up to a constant."""
        # Stored, so that x_1 is drawn on vectors, and once, not wherever its likelihood is used.
        drawn = pool.repeated(2).map_slots(stored)
        drawn = self.propagation(key, drawn, observation)
        return stored(drawn.log_weights).reshape(-1, 2).T


def trusted(log_factors: Float[Array, "2 n"], weights: Float[Array, " n"]) -> Float[Array, " n"]:
    """ν of each particle, with a weighted mean of 1, from two draws of its likelihood.

    Let r be the correlation of the two draws. The mean of both tells E[L | x] with the reliability
    ρ = 2 r / (1 + r) (Spearman 1910, Brown 1910), and 1 + ρ (L̄_i / L̄ - 1) is its best linear
    predictor (Kelley 1927). Where a draw is mostly noise, ρ is near zero and all x are alike.
    Particles without weight do not count, nor do likelihoods that are no number.
    """
    first, second = (
        jnp.where((weights > 0) & (draw < jnp.inf), draw, -jnp.inf) for draw in log_factors
    )
    highest = finite_or_zero(jnp.maximum(largest(first), largest(second)))
    # Stored, so that the exponentials are taken on vectors, and once.
    first, second = (stored(exp(draw - highest)) for draw in (first, second))
    # All sums in one product: each one alone would be a kernel. Where the likelihoods are so much
    # alike that it loses their differences to rounding, trust in these does not matter.
    rows = jnp.stack([first, second, jnp.ones_like(weights)])
    sums = jnp.matmul(weights[None] * rows, rows.T, precision=jax.lax.Precision.HIGHEST)
    number = jnp.where(sums[2, 2] > 0, sums[2, 2], 1.0)
    mean = (sums[0, 2] + sums[1, 2]) / (2 * number)
    common = number * mean**2
    shared, total = sums[0, 1] - common, (sums[0, 0] + sums[1, 1]) / 2 - common
    correlation = jnp.clip(shared / jnp.where(total > 0, total, 1.0), 0.0, 1.0)
    trust = jnp.where(mean > 0, jnp.minimum(2 * correlation / (1 + correlation), MOST_TRUST), 0.0)
    ratios = (first + second) / jnp.where(mean > 0, 2 * mean, 1.0)
    return 1 + trust * (ratios - 1)
