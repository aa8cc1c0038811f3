"""x_0: its draws, and the choice among many draws by the first observation."""

from typing import Any, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from mpfjax.checks import Count
from mpfjax.mixture import ParticleMixture, flatten_states, single_component
from mpfjax.models.base import (
    AbstractStateSpaceModel,
    check_states,
    is_made_of_noise,
)
from mpfjax.models.conditionally_linear import is_marginalised, with_moments
from mpfjax.models.noise import Noise, draw_noise
from mpfjax.moves.base import AbstractMove, Step
from mpfjax.moves.propagation.tempered import accepted
from mpfjax.moves.resampling.ancestors import draw_ancestors
from mpfjax.moves.resampling.line import HILBERT, Line, sorted_order
from mpfjax.moves.resampling.resample import Resample
from mpfjax.operations.logarithms import (
    add_gradient,
    default_float,
    exp,
    finite_or_zero,
    largest,
    log_sum_exp,
    without_gradient,
)
from mpfjax.operations.random import normal, split, uniform
from mpfjax.operations.stored import cond_if_any, stored, take, whole

# A particle that the first observation tells nothing of keeps a quarter of its chance, so that no
# weight is more than four times the mean.
MOST_TRUST = 3 / 4
# Draws of x_0 for each particle; for a wide prior so many, but no more than these in all.
FEW_DRAWS, MANY_DRAWS, MOST_DRAWS = 4, 128, 2**17
# A prior is wide where y_1 leaves less than this number of a pilot's draws, and than this part.
LEAST_EFFECTIVE, LEAST_PART = 16.0, 1 / 64
LEAST_LOG = -100.0  # of likelihoods of zero, beside the largest, so that they have a mean
NOWHERE = -1e30  # log ν where y_1 cannot be, so that differences are numbers
# Of a tempered start: the largest last power of ν, and how much two looks at the same x_0 may
# differ in log ν at that; the moves, from the least part of the last power on; and the least part
# of a deviation of x_0 that a step takes. Chosen on a drawn office among 25 settings.
LAST_POWER, NATS = 1 / 2, 2.0
NUM_MOVES, LEAST_POWER, LEAST_SIZE = 36, 2.0**-4, 2.0**-8


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

    Without a K it is four, and more for a wide prior, such as that of a pose in a building. A pilot
    of N draws shows it, where a state has several numbers: y_1 leaves an effective number of less
    than 16 of them, and of N / 64, and tells more of x_0 than of the step to x_1. A model whose x_0
    is made of noise, or that has `log_initial`, a density in all numbers of the state, then has a
    `tempered_start`, any other 128 draws a particle, but at most 2^17 in all. Either costs as much
    as 150 to 300 steps that only propagate, and makes a first result a second later. There is no
    pilot with more than 2^15 particles, nor with "rqmc".

    Without an observation it does nothing. Where an initial move weighs x_0, the chain's `Resample`
    waits for y_1: it would undo the choice.

    The filter's own propagation draws x_1, and weighs it.

    - `num_draws`: K, or None for that choice.
    - `noise`: that of the draws of x_0, as `Filter.initial_noise`. With "rqmc" they are kept in
      order along a Hilbert curve.

    Put it first among `initial_moves`, before those that regroup. Raises `ValueError` for K < 1
    and unknown noise, and in a filter without `Propagate` or `PropagateNested`. Use it where the
    prior is wide beside the likelihood.
    """

    num_draws: Count | None = eqx.field(static=True, default=None)
    noise: Noise = eqx.field(static=True, default="independent")

    def check(self, now: Step, num_particles: int, num_components: int) -> None:
        """Raise a `ValueError` where no move draws x_1 of each x_0."""
        del num_particles, num_components
        require_propagation(now, "x_0 is chosen")

    def __call__(self, key: Key[Array, ""], mixture: ParticleMixture, now: Step) -> ParticleMixture:
        """The mixture of the chosen x_0, in one component; without y_1 the one given."""
        if now.observation is None:
            return mixture
        n = mixture.num_particles
        start = self._selected(key, now, n, self.num_draws or FEW_DRAWS)
        if self._may_be_wide(mixture):
            constant, given = without_gradient((now, mixture.particles))
            keys = jax.random.fold_in(key, 1), jax.random.fold_in(key, 2)
            # Draws of their own decide, so that Ẑ stays unbiased.
            pilot, _ = two_looks(keys[0], constant, given)
            is_needed, last_power = is_wide(pilot), power_of(pilot)
            few, many = start, lambda: self._of_many(keys[1], given, now, last_power)
            dear = cond_if_any(is_needed, many, lambda: few)
            start = jax.tree.map(lambda new, old: jnp.where(is_needed, new, old), dear, few)
        own = {name: getattr(mixture, name) for name in ("ancestor_indices", "memory")}
        return start.replace(num_components=mixture.num_components, **own)

    def _may_be_wide(self, mixture: ParticleMixture) -> bool:
        """On a line few draws suffice; many would be another program to compile."""
        is_line = flatten_states(mixture.particles).shape[1] == 1
        has_room = FEW_DRAWS * mixture.num_particles < MOST_DRAWS
        return self.num_draws is None and self.noise != "rqmc" and has_room and not is_line

    def _of_many(
        self, key: Key[Array, ""], given: PyTree, now: Step, power: Float[Array, ""]
    ) -> ParticleMixture:
        """The start from a wide prior, in which places among the draws have no meaning."""
        n = jax.tree.leaves(given)[0].shape[0]
        if can_be_tempered(now.model, given):
            return tempered_start(key, now, given, power)
        num_draws = max(FEW_DRAWS, min(MANY_DRAWS, MOST_DRAWS // n))
        return self._selected(key, now, n, num_draws)

    def _selected(self, key: Key[Array, ""], now: Step, n: int, num_draws: int) -> ParticleMixture:
        """N of K N draws; a few draws a particle at a time, so that memory has room for them."""
        key_drawn, key_look, key_kept = split(key, 3)
        at_once = next(k for k in range(2 * FEW_DRAWS, 0, -1) if num_draws % k == 0)

        def look(keys: Key[Array, "2"]) -> tuple[PyTree, Float[Array, "k 2"], Float[Array, ""]]:
            drawn = sample_initial(keys[0], now.model, at_once * n, self.noise)
            log_factors, log_scale = two_looks(keys[1], now, drawn)
            return drawn, log_factors.T, log_scale

        if (num_rounds := num_draws // at_once) == 1:
            drawn, log_factors, _ = look(jnp.stack([key_drawn, key_look]))
        else:
            rounds = [jax.random.split(each, num_rounds) for each in (key_drawn, key_look)]
            drawn, log_factors, log_scales = jax.lax.map(look, jnp.stack(rounds, axis=1))
            log_factors += (log_scales - jnp.max(log_scales))[:, None, None]
            flat = lambda leaf: leaf.reshape(-1, *leaf.shape[2:])  # noqa: E731
            drawn, log_factors = jax.tree.map(flat, (drawn, log_factors))
        return chosen(key_kept, drawn, log_factors.T, n, in_order=self.noise == "rqmc")


def require_propagation(now: Step, what: str) -> None:
    """Raise a `ValueError` for a filter none of whose moves draws x_t of each particle."""
    if now.propagation is None:
        raise ValueError(
            f"filter: {what} where Propagate or PropagateNested propagates, and none of its moves"
            " is one"
        )


def two_looks(
    key: Key[Array, ""], now: Step, states: PyTree
) -> tuple[Float[Array, "2 n"], Float[Array, ""]]:
    """The log-weights of two draws of x_t of each x_{t-1}, and their common scale."""
    assert now.propagation is not None
    # Stored, so that x_t is drawn on vectors, and once, not wherever its likelihood is used.
    twice = single_component(states).repeated(2).map_slots(stored)
    twice = now.propagation(key, twice, now)
    return stored(twice.log_weights).reshape(-1, 2).T, twice.log_scale


def chosen(
    key: Key[Array, ""],
    drawn: PyTree,
    log_factors: Float[Array, "2 k"],
    num_slots: int,
    number: Int[Array, ""] | None = None,
    in_order: bool = False,
) -> ParticleMixture:
    """Of many draws a few, kept with probabilities in proportion to ν and weighing 1 / ν.

    They fill the first `number` slots, or all, in one component; the ancestors are their places
    among the draws. The logarithm of their mass, of which 1 is the mean, is the mixture's
    `log_scale`.
    """
    trust = stored(jax.lax.stop_gradient(trusted(log_factors, jnp.ones_like(log_factors[0]))))
    pool = single_component(drawn)
    order = sorted_order(pool, pool.component_indicators, HILBERT) if in_order else None
    weights = whole(trust if order is None else take(trust, order), 0.0)
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
        log_scale=jnp.log(total / targets[0].astype(total.dtype)),
        ancestor_indices=kept.particles,
    )


class Placed(NamedTuple):
    """What a tempered start moves: x_0, or the noise that it is made of, and log ν."""

    places: PyTree
    log_factors: Float[Array, " k"]


def can_be_tempered(model: Any, states: PyTree) -> bool:
    """Whether a random walk on x_0 leaves its law as it is."""
    if is_made_of_noise(model, "initial"):
        return True
    has_density = callable(getattr(model, "log_initial", None)) and not is_marginalised(model)
    return has_density and all(map(eqx.is_inexact_array, jax.tree.leaves(states)))


def tempered_start(
    key: Key[Array, ""],
    now: Step,
    given: PyTree,
    last_power: Float[Array, ""],
) -> ParticleMixture:
    """N particles that represent x_0, most of them where y_1 speaks for them.

    A sampler of Del Moral, Doucet and Jasra (2006): 4 N draws of x_0 are resampled and moved for
    rising powers of ν, the likelihood of y_1 at a draw of x_1 (Andrieu and Roberts 2009). Each move
    is a random walk with a new draw of x_1. Its steps lie between the deviation of `given`, N draws
    of x_0, and 1/256 of it, in each coordinate another, so that some fit a mode of any width. x_0
    is moved itself, or the noise that it is made of. In the end every fourth is kept and weighs
    ν^-`last_power`; the mass of all, with a mean of 1, is the `log_scale`.
    """
    source: Any = now.model
    now, given = without_gradient((now, given))
    propagation: Any = now.propagation
    model: Any = now.model
    n = jax.tree.leaves(given)[0].shape[0]
    of_noise, number, dtype = is_made_of_noise(model, "initial"), FEW_DRAWS * n, default_float()
    key_drawn, key_look, key_stages, key_kept = split(key, 4)
    if of_noise:
        places = normal(key_drawn, (number, model.initial_noise_dimension), dtype)
        scale = jnp.ones((1, 1))
    else:
        places = model.sample_initial(key_drawn, number)
        scale = jnp.std(flatten_states(given), axis=0, keepdims=True)
    to_places = jax.vmap(ravel_pytree(jax.tree.map(lambda leaf: leaf[0], places))[1])

    def states(model: Any, places: PyTree) -> PyTree:
        return with_moments(model, model.initial_from_noise(places) if of_noise else places)

    def log_prior(model: Any, places: PyTree) -> Float[Array, " k"]:
        return -0.5 * jnp.sum(places**2, axis=1) if of_noise else model.log_initial(places)

    def log_look(key: Key[Array, ""], places: PyTree) -> Float[Array, " k"]:
        seen = propagation(key, single_component(states(model, places)), now)
        log_factors = seen.log_weights + seen.log_scale  # up to a constant, which cancels
        return jnp.maximum(jnp.where(log_factors < jnp.inf, log_factors, NOWHERE), NOWHERE)

    def advance(mixture: ParticleMixture, stage: tuple) -> tuple[ParticleMixture, None]:
        key, power, growth = stage
        key_drawn, key_size, key_step, key_look, key_accepted = split(key, 5)
        mixture = mixture.weighed(growth * mixture.particles.log_factors)
        mixture = Resample().resample(key_drawn, mixture)
        here = mixture.particles
        flat = flatten_states(here.places)
        size = scale * LEAST_SIZE ** uniform(key_size, flat.shape, flat.dtype)
        places = to_places(flat + size * normal(key_step, flat.shape, flat.dtype))
        new = Placed(places, log_look(key_look, places))
        log_ratio = power * (new.log_factors - here.log_factors)
        log_ratio += log_prior(model, places) - log_prior(model, here.places)
        return mixture.replace(particles=accepted(key_accepted, log_ratio, new, here)), None

    powers = last_power * LEAST_POWER ** jnp.linspace(1.0, 0.0, NUM_MOVES, dtype=dtype)
    stages = jax.random.split(key_stages, NUM_MOVES), powers, jnp.diff(powers, prepend=0.0)
    start = single_component(Placed(places, log_look(key_look, places)))
    moved, _ = jax.lax.scan(advance, start, stages)
    # One of every four, so that each has the same chance.
    kept = FEW_DRAWS * jnp.arange(n) + jax.random.randint(key_kept, (), 0, FEW_DRAWS)
    places, log_factors = jax.tree.map(lambda leaf: take(leaf, kept), moved.particles)
    log_weights = moved.log_mass - np.log(n) - last_power * log_factors
    if not of_noise:
        log_weights = add_gradient(log_weights, log_prior(source, places))
    log_total = log_sum_exp(log_weights)
    return single_component(states(source, places)).replace(
        log_weights=log_weights - log_total, log_scale=log_total
    )


def is_wide(log_factors: Float[Array, "2 n"]) -> Bool[Array, ""]:
    """Whether y_1 leaves few of the draws of x_0, and tells more of x_0 than of the step to x_1.

    The first is Kish's effective number (Σ L̄)² / Σ L̄², of the mean of two looks at each draw; the
    second that the two are correlated.
    """
    looks = beside_largest(log_factors)
    mean = jnp.sum(exp(looks), 0)
    deviations = looks - jnp.mean(looks, 1, keepdims=True)
    covariances = deviations @ deviations.T
    tells = 2 * covariances[0, 1] > jnp.sqrt(covariances[0, 0] * covariances[1, 1])
    fewest = min(LEAST_EFFECTIVE, LEAST_PART * looks.shape[1])
    return (jnp.sum(mean) ** 2 < fewest * jnp.sum(mean**2)) & tells


def power_of(log_factors: Float[Array, "2 n"]) -> Float[Array, ""]:
    """The last power of a tempered start: the less two looks agree where y_1 speaks for x_0."""
    looks = beside_largest(log_factors)
    weights = jnp.sum(exp(looks), 0)
    ratio = jnp.sum(weights * exp(-jnp.abs(looks[0] - looks[1]))) / jnp.sum(weights)
    return NATS / jnp.maximum(-jnp.log(ratio), NATS / LAST_POWER)


def beside_largest(log_factors: Float[Array, "2 n"]) -> Float[Array, "2 n"]:
    """The same beside the largest, which is 0; none is infinite or no number."""
    below = jnp.where(log_factors < jnp.inf, log_factors, -jnp.inf)
    return jnp.maximum(below - finite_or_zero(largest(below.ravel())), LEAST_LOG)


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
