"""x_0: its draws, and the choice among many draws by the first observation."""

from collections.abc import Callable
from typing import Any, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from mpfjax.checks import Count, shown
from mpfjax.mixture import ParticleMixture, single_component
from mpfjax.models.base import (
    AbstractStateSpaceModel,
    check_states,
    is_made_of_noise,
)
from mpfjax.models.conditionally_linear import with_moments
from mpfjax.models.noise import Noise, draw_noise
from mpfjax.moves.base import AbstractMove
from mpfjax.moves.resampling.ancestors import draw_ancestors
from mpfjax.moves.resampling.line import HILBERT, Line, sorted_order
from mpfjax.operations.logarithms import (
    add_gradient,
    default_float,
    exp,
    finite_or_zero,
    largest,
    without_gradient,
)
from mpfjax.operations.random import split
from mpfjax.operations.stored import cond_if_any, most_of_runs, stored, take, whole

# A particle that the first observation tells nothing of keeps a quarter of its chance, so that no
# weight is more than four times the mean.
MOST_TRUST = 3 / 4
# Draws of x_0 for each particle; and in all, where y_1 leaves fewer draws of a pilot than this.
FEW_DRAWS, MANY_DRAWS = 4, 2**17
LEAST_EFFECTIVE = 32.0
LEAST_LOG = -1000.0  # of likelihoods of zero, so that they have a mean


def sample_initial(
    key: Key[Array, ""],
    model: AbstractStateSpaceModel,
    num_particles: int,
    noise: str = "independent",
) -> PyTree:
    """The particles of x_0, of this noise if the model can; raises for leaves of another length."""
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

    Without a K it is four, and there are 2^17 draws in all where the particles that it is given
    show that four are too few: of these, y_1 leaves an effective number of less than 32, and it
    tells more of x_0 than of the step to x_1. A pose in a building is such a state. For thousands
    of short runs of few particles so many draws cost far more than the run.

    Without an observation it does nothing. Where an initial move weighs x_0, the chain's `Resample`
    waits for y_1: it would undo the choice.

    - `propagation`: draws x_1, and weighs it: a `Propagate` or `PropagateNested`, usually the
      filter's own.
    - `num_draws`: K, or None for that choice.
    - `noise`: that of the draws of x_0, as `Filter.initial_noise`. With "rqmc" they are kept in
      order along a Hilbert curve.

    Put it first among `initial_moves`, before those that regroup. Raises `ValueError` for another
    propagation, K < 1 and unknown noise. Use it where the prior is wide beside the likelihood.
    """

    propagation: Any
    num_draws: Count | None = eqx.field(static=True, default=None)
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
        n = mixture.num_particles
        num_rounds = 1 + max(0, MANY_DRAWS - FEW_DRAWS * n) // ((FEW_DRAWS - 1) * n)
        if self.num_draws is not None or num_rounds == 1:
            start = self._round(key, observation, n).mixture
        else:
            start = self._in_rounds(key, mixture, observation, num_rounds)
        own = {name: getattr(mixture, name) for name in ("ancestor_indices", "memory")}
        return start.replace(num_components=mixture.num_components, **own)

    def _in_rounds(
        self, key: Key[Array, ""], mixture: ParticleMixture, observation: PyTree, num_rounds: int
    ) -> ParticleMixture:
        """The choice from one round of draws, or from all of them, by one program."""
        n = mixture.num_particles
        constant, observed, given = without_gradient((self, observation, mixture.particles))
        # The particles given decide, which are draws of their own, so that Ẑ stays unbiased.
        looks = two_looks(jax.random.fold_in(key, 1), constant.propagation, given, observed)
        number = jnp.where(is_wide(looks), num_rounds, 1)
        most = most_of_runs(number)

        def advance(state: tuple) -> tuple:
            t, key, before = state
            after = constant._round(key, observed, n, t, before)
            kept = jax.tree.map(lambda new, old: jnp.where(t < number, new, old), after, before)
            return t + 1, jax.random.fold_in(key, 2), kept

        shapes = jax.eval_shape(lambda: constant._round(key, observed, n))
        nothing = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
        start = (jnp.zeros((), jnp.int32), key, nothing)
        *_, kept = jax.lax.while_loop(lambda state: state[0] < most, advance, start)
        return kept.mixture.replace(particles=self._differentiable(key, kept, num_rounds))

    def _round(
        self,
        key: Key[Array, ""],
        observation: PyTree,
        n: int,
        t: Int[Array, ""] | int = 0,
        before: "Kept | None" = None,
    ) -> "Kept":
        """N of the draws of round t; from the second on, those kept before are N of its draws."""
        key_drawn, key_look, key_kept = split(key, 3)
        k = self.num_draws or FEW_DRAWS
        drawn = sample_initial(key_drawn, self.propagation.model, k * n, self.noise)
        log_factors = two_looks(key_look, self.propagation, drawn, observation)
        places, weights = jnp.arange(k * n, dtype=jnp.int32), jnp.ones(k * n, log_factors.dtype)
        pool = (drawn, log_factors.T, weights, jnp.full_like(places, t), places)
        if before is not None:
            # In units of one draw, of which there have been so many.
            number = n * (1 + (k - 1) * jnp.asarray(t, weights.dtype))
            old_weights = number * exp(before.mixture.log_weights + before.mixture.log_scale)
            mixture, old_factors, *origins = before
            old = (mixture.particles, old_factors.T, old_weights, *origins)
            # One of every K gives way, any of them: a model's draws may stand in line.
            j = jax.random.randint(jax.random.fold_in(key, 3), (), 0, k)

            def put(new: Array, old: Array) -> Array:
                rows = new.reshape(n, k, *new.shape[1:])
                return rows.at[:, j].set(jnp.where(t > 0, old, rows[:, j])).reshape(new.shape)

            pool = jax.tree.map(put, pool, old)
        drawn, log_factors, weights, *origins = pool
        log_factors = log_factors.T
        mixture = chosen(key_kept, drawn, log_factors, n, weights, in_order=self.noise == "rqmc")
        number = (k + (k - 1) * jnp.asarray(t, weights.dtype)) / k
        mixture = mixture.replace(log_scale=mixture.log_scale - jnp.log(number))
        index = mixture.ancestor_indices
        return Kept(mixture, log_factors[:, index], *(take(each, index) for each in origins))

    def _differentiable(self, key: Key[Array, ""], kept: "Kept", num_rounds: int) -> PyTree:
        """The particles kept, with the derivatives of drawing them once more."""
        particles = kept.mixture.particles
        num_drawn = FEW_DRAWS * kept.mixture.num_particles

        def add(state: tuple, t: Int[Array, ""]) -> tuple[tuple, None]:
            key, again = state
            here = kept.rounds == t

            def taken() -> PyTree:
                drawn = sample_initial(
                    split(key, 3)[0], self.propagation.model, num_drawn, self.noise
                )
                rows = lambda leaf: here.reshape(-1, *[1] * (leaf.ndim - 1))  # noqa: E731
                pick = lambda new, old: jnp.where(rows(old), take(new, kept.places), old)  # noqa: E731
                return jax.tree.map(pick, drawn, again)

            again = cond_if_any(jnp.any(here), taken, lambda: again)
            return (jax.random.fold_in(key, 2), again), None

        start = (key, jax.tree.map(jnp.zeros_like, particles))
        (_, again), _ = jax.lax.scan(add, start, jnp.arange(num_rounds, dtype=jnp.int32))
        derive = lambda leaf, source: (  # noqa: E731
            add_gradient(leaf, source) if eqx.is_inexact_array(leaf) else leaf
        )
        return jax.tree.map(derive, particles, again)


class Kept(NamedTuple):
    """The draws that are kept after some rounds, and where they come from."""

    mixture: ParticleMixture
    log_factors: Float[Array, "2 n"]
    rounds: Int[Array, " n"]
    places: Int[Array, " n"]  # among the draws of the round


def two_looks(
    key: Key[Array, ""], propagation: Any, states: PyTree, observation: PyTree
) -> Float[Array, "2 n"]:
    """The log-weights of two draws of x_t of each x_{t-1}, up to a constant."""
    # Stored, so that x_t is drawn on vectors, and once, not wherever its likelihood is used.
    twice = single_component(states).repeated(2).map_slots(stored)
    twice = propagation(key, twice, observation)
    return stored(twice.log_weights).reshape(-1, 2).T


def chosen(
    key: Key[Array, ""],
    drawn: PyTree,
    log_factors: Float[Array, "2 k"],
    num_slots: int,
    draw_weights: Float[Array, " k"] | None = None,
    number: Int[Array, ""] | None = None,
    in_order: bool = False,
) -> ParticleMixture:
    """Of many draws a few, kept with probabilities in proportion to ν and weighing 1 / ν.

    They fill the first `number` slots, or all, in one component; the ancestors are their places
    among the draws. The logarithm of their mass, of which 1 is the mean, is the mixture's
    `log_scale`. With `draw_weights` the draws weigh so much from the start.
    """
    pool = single_component(drawn)
    given = jnp.ones_like(log_factors[0]) if draw_weights is None else draw_weights
    trust = stored(jax.lax.stop_gradient(trusted(log_factors, given)))
    chances = trust if draw_weights is None else stored(trust * given)
    order = sorted_order(pool, pool.component_indicators, HILBERT) if in_order else None
    weights = whole(chances if order is None else take(chances, order), 0.0)
    totals = jnp.sum(weights, keepdims=True)
    line = Line(pool.num_particles, weights, totals, jnp.zeros_like(totals), weights > 0, order)
    targets = jnp.full(1, num_slots if number is None else number, jnp.int32)
    kept = draw_ancestors(key, line, targets, "systematic", num_slots=num_slots)
    trust = take(trust, kept.particles).astype(default_float())
    # No ν is below a quarter, so that their inverses need no logarithms to be summed.
    filled = kept.slots.filled
    total = jnp.sum(jnp.where(filled, 1 / trust, 0.0))
    particles = jax.tree.map(lambda leaf: take(leaf, kept.particles), drawn)
    return single_component(particles).replace(
        log_weights=jnp.where(filled, -jnp.log(trust * total), -jnp.inf),
        log_scale=jnp.log(total / targets[0].astype(total.dtype)) + jnp.log(jnp.mean(given)),
        ancestor_indices=kept.particles,
    )


def is_wide(log_factors: Float[Array, "2 n"]) -> Bool[Array, ""]:
    """Whether y_1 leaves few of the draws of x_0, and tells more of x_0 than of the step to x_1.

    The first is Kish's effective number (Σ L̄)² / Σ L̄², of the mean of two looks at each draw; the
    second that the two are correlated.
    """
    below = jnp.where(log_factors < jnp.inf, log_factors, -jnp.inf)
    relative = jnp.maximum(below - finite_or_zero(largest(below.ravel())), LEAST_LOG)
    mean = jnp.sum(exp(relative), 0)
    deviations = relative - jnp.mean(relative, 1, keepdims=True)
    covariances = deviations @ deviations.T
    tells = 2 * covariances[0, 1] > jnp.sqrt(covariances[0, 0] * covariances[1, 1])
    return (jnp.sum(mean) ** 2 < LEAST_EFFECTIVE * jnp.sum(mean**2)) & tells


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
