"""The backward kernel: the distribution of the ancestor at s of a particle at s + 1.

The index of x_s given x_{s+1} has the probabilities W_s^i D(x_{s+1} | x_s^i), where W_s are the
joint weights of the mixture at s. Component indicators do not enter, because the weights are joint.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from mpfjax.mixture import ParticleMixture
from mpfjax.models.base import with_inputs
from mpfjax.models.law import law_of
from mpfjax.operations.logarithms import exp, finite_or_zero
from mpfjax.operations.matrices import draw_columns
from mpfjax.operations.prefix_sums import needs_units, sum_before, to_units, unit_bits
from mpfjax.operations.random import below, split, uniform
from mpfjax.operations.stored import along_rows, take

# How many densities are held at once: rows of states are taken together up to this.
MOST_DENSITIES = 2**22
NO_TRANSITION = "model: log_transition is -inf, or NaN, from every particle of the step before"


def draw(
    key: Key[Array, ""], shape: tuple[int, ...], log_weights: Float[Array, " n"]
) -> Int[Array, "..."]:
    """Indices by their weights, by the inverse of the cumulative weights."""
    n, dtype = log_weights.shape[0], log_weights.dtype
    weights = exp(log_weights - finite_or_zero(jnp.max(log_weights)))
    if needs_units(n, dtype):
        units = to_units(weights * (n / jnp.sum(weights)), unit_bits(n))
        upto = jnp.cumsum(units, dtype=jnp.int32)
        target = below(key, jnp.broadcast_to(upto[-1], shape))
        indices = jnp.searchsorted(upto, target, side="right").astype(jnp.int32)
    else:
        before, total = sum_before(weights)
        target = uniform(key, shape, dtype) * total
        indices = jnp.searchsorted(before, target, side="right").astype(jnp.int32) - 1
    # Rounding must not lead past the last particle of positive weight.
    place = jnp.arange(n, dtype=jnp.int32)
    return jnp.minimum(indices, jnp.max(jnp.where(weights > 0, place, 0)))


def draw_ends(
    key: Key[Array, ""], mixtures: ParticleMixture, number: int
) -> tuple[Int[Array, " k"], PyTree]:
    """Indices and states of particles of the last mixture by their weights."""
    final = jax.tree.map(lambda leaf: leaf[-1], mixtures)
    indices = draw(key, (number,), final.log_weights)
    return indices, jax.tree.map(lambda leaf: take(leaf, indices), final.particles)


def log_kernel_from(model: Any, mixture: ParticleMixture) -> Callable[[PyTree], Array]:
    """log D(state | x^i) of every particle, (n,), as a function of a state."""
    n = mixture.num_particles

    def log_density(state: PyTree) -> Float[Array, " n"]:
        copies = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (n, *leaf.shape)), state)
        return law_of(model).log_transition(copies, mixture.particles)

    return log_density


def draw_exactly(
    key: Key[Array, ""],
    log_density: Callable[[PyTree], Array],
    futures: PyTree,
    mixture: ParticleMixture,
    num_draws: int = 1,
    needed: Bool[Array, " k"] | None = None,
    cost: int = 1,
) -> Int[Array, "k draws"]:
    """Indices for each of the futures by W^i times its density given x^i, O(N) for one.

    `log_density` gives that of one future for all particles, (n,), at the `cost` of so many numbers
    a particle. The index is -1 where a future that is `needed` cannot have come from any particle.
    """
    n = mixture.num_particles

    def draw_some(inputs: tuple[Array, PyTree]) -> tuple[Array, Array]:
        (quantiles, *within), future = inputs
        log_weights = mixture.log_weights + log_density(future)
        log_weights = jnp.where(mixture.occupied, log_weights, -jnp.inf)
        largest = jnp.max(log_weights)
        weights = exp(log_weights - finite_or_zero(largest))
        return draw_columns(quantiles, jnp.broadcast_to(weights, (num_draws, n)), *within), largest

    number = jax.tree.leaves(futures)[0].shape[0]
    dtype = mixture.log_weights.dtype
    keys = split(key, 2) if needs_units(n, dtype) else [key]
    quantiles = [uniform(key, (number, num_draws), dtype) for key in keys]
    together = max(1, min(number, MOST_DENSITIES // (cost * n)))
    inputs = (jnp.stack(quantiles, axis=1), futures)
    if together == number:
        indices, largest = jax.vmap(draw_some)(inputs)
    else:
        indices, largest = jax.lax.map(draw_some, inputs, batch_size=together)
    return _or_none(indices, largest[:, None], None if needed is None else needed[:, None])


def walk(
    key: Key[Array, ""],
    model: Any,
    next_states: PyTree,
    mixture: ParticleMixture,
    start: Int[Array, " k"],
    proposed: Int[Array, " k"],
    needed: Bool[Array, " k"] | None = None,
) -> Int[Array, " k"]:
    """A step of independent Metropolis-Hastings on the index, whose target is W^i D(next | x^i).

    O(1) for a state. `proposed` are draws by the weights alone, which can all be made beforehand.
    The index is -1 as by `draw_exactly`.
    """

    def log_density(indices: Int[Array, " k"]) -> Float[Array, " k"]:
        previous = jax.tree.map(lambda leaf: take(leaf, indices), mixture.particles)
        return law_of(model).log_transition(next_states, previous)

    current, new = log_density(start), log_density(proposed)
    log_uniform = jnp.log(uniform(key, proposed.shape, mixture.log_weights.dtype))
    # The proposal draws by the weights, which therefore cancel in the acceptance ratio.
    accepted = (log_uniform < new - current) | (current == -jnp.inf)
    indices = jnp.where(accepted, proposed, start)
    return _or_none(indices, jnp.where(accepted, new, current), needed)


def log_transitions(model: Any, trajectory: PyTree, inputs: PyTree) -> Float[Array, " t"]:
    """log D(x_s | x_{s-1}) at every step of one trajectory, leaves (t + 1, ...)."""
    before = jax.tree.map(lambda leaf: leaf[:-1], trajectory)
    after = jax.tree.map(lambda leaf: leaf[1:], trajectory)
    if inputs is None:
        return model.log_transition(after, before)

    def at_step(now: PyTree, after: PyTree, before: PyTree) -> Float[Array, ""]:
        states, previous = jax.tree.map(lambda leaf: leaf[None], (after, before))
        return with_inputs(model, now).log_transition(states, previous)[0]

    return jax.vmap(at_step)(inputs, after, before)


def _or_none(
    indices: Int[Array, "..."], log_density: Float[Array, "..."], needed: Bool[Array, "..."] | None
) -> Int[Array, "..."]:
    """The indices, -1 where a future that is needed has no past."""
    lost = ~(log_density > -jnp.inf)
    return jnp.where(lost if needed is None else lost & needed, -1, indices)


def rows_at(indices: Int[Array, " k"], rows: PyTree) -> PyTree:
    """The rows with these indices; those of index -1 have NaN for floating point numbers."""
    chosen = jax.tree.map(lambda leaf: take(leaf, jnp.maximum(indices, 0)), rows)

    def with_nan(leaf: Array) -> Array:
        is_float = jnp.issubdtype(leaf.dtype, jnp.inexact)
        return jnp.where(along_rows(indices < 0, leaf), jnp.nan, leaf) if is_float else leaf

    return jax.tree.map(with_nan, chosen)
