"""x_0: its draws, and which of many draws a filter keeps once it sees the first observation."""

from collections.abc import Sequence
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key, PyTree, UInt32

from mpfjax.mixture import ParticleMixture, single_component
from mpfjax.models.base import (
    AbstractStateSpaceModel,
    HasInitialNoise,
    check_states,
    starts_from_noise,
)
from mpfjax.models.conditionally_linear import with_moments
from mpfjax.models.noise import draw_noise
from mpfjax.moves.base import AbstractPropagation
from mpfjax.moves.propagation.marginalised import PropagateMarginalised
from mpfjax.moves.propagation.nested import PropagateNested
from mpfjax.moves.propagation.propagate import Propagate
from mpfjax.moves.resampling.ordering import HILBERT, sorted_order
from mpfjax.operations.floats import default_float
from mpfjax.operations.generator import uniform
from mpfjax.operations.indexing import take
from mpfjax.operations.logarithms import exp, finite_or_zero
from mpfjax.operations.maxima import largest
from mpfjax.operations.prefix_sums import count_starts, sum_before
from mpfjax.operations.stored import stored

# The name of the memory of a filter whose x_0 is chosen.
START = "start"
# A particle that the first observation tells nothing of keeps a quarter of its chance, so that no
# weight is more than four times the mean.
MOST_TRUST = 3 / 4


class StartMemory(NamedTuple):
    """How far the choice of x_0 has got.

    - `is_prior`: the particles are plain draws of x_0, of which nothing was observed.
    - `is_chosen`: they are chosen by the next observation, whose step must not resample them.
    - `log_mass`: the logarithm of the sum of their weights before these were normalised.
    - `checksum`: of the plain draws, by which a mixture that was changed by hand is known.
    """

    is_prior: Bool[Array, ""]
    is_chosen: Bool[Array, ""]
    log_mass: Float[Array, ""]
    checksum: UInt32[Array, ""]

    @classmethod
    def used(cls) -> "StartMemory":
        """Nothing is left to choose."""
        no, nothing = jnp.asarray(False), jnp.zeros((), default_float())
        return cls(no, no, nothing, jnp.zeros((), jnp.uint32))


def at_start(mixture: ParticleMixture) -> ParticleMixture:
    """The mixture of plain draws of x_0, marked as such."""
    memory = StartMemory.used()._replace(is_prior=jnp.asarray(True), checksum=_checksum(mixture))
    return mixture.replace(memory=mixture.memory | {START: memory})


def is_prior(mixture: ParticleMixture) -> Bool[Array, ""]:
    """Whether the mixture has plain draws of x_0, which nobody has replaced by others."""
    memory: StartMemory = mixture.memory[START]
    return memory.is_prior & (memory.checksum == _checksum(mixture))


def started(mixture: ParticleMixture) -> ParticleMixture:
    """The mixture of a filter that has used its choice of x_0."""
    return mixture.replace(memory=mixture.memory | {START: StartMemory.used()})


def leaving_start(mixture: ParticleMixture) -> ParticleMixture:
    """The mixture before a prediction, after which x_0 is not drawn anew."""
    if START not in mixture.memory:
        return mixture
    memory = mixture.memory[START]._replace(is_prior=jnp.asarray(False))
    return mixture.replace(memory=mixture.memory | {START: memory})


def unless_chosen(moved: ParticleMixture, mixture: ParticleMixture) -> ParticleMixture:
    """The resampled mixture, or the one before if x_0 is chosen: its weights are needed."""
    if moved.log_scale is not None and mixture.log_scale is None:
        mixture = mixture.replace(log_scale=jnp.zeros_like(moved.log_scale))
    is_chosen = mixture.memory[START].is_chosen
    return jax.tree.map(lambda new, old: jnp.where(is_chosen, old, new), moved, mixture)


def looking_moves(moves: Sequence[Any], starts_empty: bool) -> list[AbstractPropagation]:
    """The propagations that weigh two draws of x_1; a `ValueError` for others."""
    found = [move for move in moves if isinstance(move, AbstractPropagation)]
    known = (Propagate, PropagateMarginalised, PropagateNested)
    if starts_empty or not found or not all(isinstance(move, known) for move in found):
        raise ValueError(
            "initial_draws: x_0 is chosen where Propagate, PropagateMarginalised or"
            " PropagateNested propagates, and no filter that starts empty has it"
        )
    return found


def sample_initial(
    key: Key[Array, ""],
    model: AbstractStateSpaceModel,
    num_particles: int,
    noise: str = "independent",
) -> PyTree:
    """The particles of x_0, of this noise if the model can; raises for leaves of another length."""
    if noise == "independent" or not starts_from_noise(model):
        particles = model.sample_initial(key, num_particles)
    else:
        maker = cast(HasInitialNoise, model)
        shape = (num_particles, maker.initial_noise_dimension)
        particles = maker.initial_from_noise(draw_noise(noise, key, shape, default_float()))
    check_states(particles, model, "sample_initial", num_particles)
    return with_moments(model, particles)


def choose_initial(
    key: Key[Array, ""],
    mixture: ParticleMixture,
    drawn: PyTree,
    looks: Sequence[tuple[Key[Array, ""], AbstractPropagation]],
    observation: PyTree,
    noise: str,
) -> ParticleMixture:
    """N weighted draws of x_0, chosen for what they say of y_1 among those `drawn`, K N of them.

    Of each x_0 two x_1 are drawn, by the moves of `looks` with their keys, and ν is the mean of
    their likelihoods, shrunk towards the mean of all by the share of its variance that is not x_0's
    (`trusted`). Particles are kept with probabilities in proportion to ν, and weigh 1 / ν. They
    represent x_0 as the pool does, and Ẑ stays unbiased. With "rqmc" `noise` they are kept in order
    along a Hilbert curve.
    """
    num_draws = jax.tree.leaves(drawn)[0].shape[0] // mixture.num_particles
    usable = mixture.usable_slots
    num_drawn = None if usable is None else num_draws * usable
    pool = single_component(drawn, mixture.num_components, num_drawn)
    log_factors = _look(looks, pool, observation)
    chances = trusted(log_factors, pool.occupied.astype(log_factors.dtype))
    chances = stored(jax.lax.stop_gradient(chances))
    order = None
    if noise == "rqmc":
        labels = jnp.where(pool.occupied, 0, pool.num_components)
        order = sorted_order(pool, labels, HILBERT)
    kept = _kept(key, chances, mixture, pool, order)
    particles = jax.tree.map(lambda leaf: take(leaf, kept), drawn)
    chosen = single_component(particles, mixture.num_components, usable)
    trust = take(chances, kept).astype(default_float())
    # No ν is below a quarter, so that their inverses need no logarithms to be summed.
    total = jnp.sum(jnp.where(chosen.occupied, 1 / trust, 0.0))
    log_weights = jnp.where(chosen.occupied, -jnp.log(trust * total), -jnp.inf)
    log_mass = jnp.log(total / jnp.asarray(chosen.num_usable_slots, total.dtype))
    memory = StartMemory.used()._replace(is_chosen=jnp.asarray(True), log_mass=log_mass)
    return chosen.replace(log_weights=log_weights, memory=mixture.memory | {START: memory})


def _checksum(mixture: ParticleMixture) -> UInt32[Array, ""]:
    """The sum of all bits of particles, weights and indicators, as whole numbers that wrap around.

    Sums of numbers would depend on their order, and so on the program that adds them.
    """
    total = jnp.zeros((), jnp.uint32)
    held = (mixture.particles, mixture.log_weights, mixture.component_indicators)
    for number, leaf in enumerate(jax.tree.leaves(jax.lax.stop_gradient(held))):
        bits = _bits(leaf)
        total += jnp.sum(bits, dtype=jnp.uint32) * jnp.uint32(2 * number + 1)
    return total


def _bits(leaf: Array) -> Array:
    if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        leaf = jax.random.key_data(leaf)
    if jnp.issubdtype(leaf.dtype, jnp.complexfloating):
        leaf = jnp.stack([leaf.real, leaf.imag])
    if jnp.issubdtype(leaf.dtype, jnp.floating):
        words = jnp.uint16 if leaf.dtype.itemsize == 2 else jnp.uint32
        leaf = jax.lax.bitcast_convert_type(leaf, words)
    return leaf.astype(jnp.uint32)


def _look(
    looks: Sequence[tuple[Key[Array, ""], AbstractPropagation]],
    pool: ParticleMixture,
    observation: PyTree,
) -> Float[Array, "2 n"]:
    """The logarithms of the weights of two draws of x_1 of each particle, up to a constant."""
    # Stored, so that x_1 is drawn on vectors, and once, not again wherever its likelihood is used.
    twice = lambda leaf: stored(jnp.repeat(leaf, 2, axis=0))  # noqa: E731
    drawn = pool.replace(
        particles=jax.tree.map(twice, pool.particles),
        log_weights=twice(pool.log_weights),
        component_indicators=twice(pool.component_indicators),
        ancestor_indices=twice(pool.ancestor_indices),
        usable_slots=None if pool.usable_slots is None else 2 * pool.usable_slots,
    )
    for move_key, move in looks:
        drawn = move(move_key, drawn, observation)
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


def _kept(
    key: Key[Array, ""],
    chances: Float[Array, " p"],
    mixture: ParticleMixture,
    pool: ParticleMixture,
    order: Int[Array, " p"] | None,
) -> Int[Array, " n"]:
    """Which particle of the pool each slot takes: systematic draws in proportion to ν."""
    weights = jnp.where(pool.occupied, chances, 0.0)
    weights = weights if order is None else take(weights, order)
    num_kept = jnp.asarray(mixture.num_usable_slots, weights.dtype)
    before, total = sum_before(weights)
    # Slot s has the point s + shift, and takes the particle whose interval holds it.
    points = before * (num_kept / total) - uniform(key, (), weights.dtype)
    starts = jnp.ceil(points).astype(jnp.int32)
    places = count_starts(jnp.maximum(starts, 0), mixture.num_particles)
    last = jnp.asarray(pool.num_usable_slots, jnp.int32) - 1
    places = jnp.clip(places, 0, last)
    return places if order is None else take(order, places)
