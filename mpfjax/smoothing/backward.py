"""The backward kernel: which particle of s each particle of s + 1 may have come from.

The index of x_s given x_{s+1} has the probabilities W_s^i D(x_{s+1} | x_s^i), W_s the joint weights
of the mixture at s. Component indicators have no part in it, since the weights are joint.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from mpfjax.mixture import ParticleMixture
from mpfjax.models.base import check_log_density
from mpfjax.operations.generator import split, uniform
from mpfjax.operations.indexing import take
from mpfjax.operations.logarithms import exp, finite_or_zero
from mpfjax.operations.matrices import draw_columns

# How many densities are held at once: rows of states are taken together up to this.
MOST_DENSITIES = 2**22
_NO_PAST = "model: log_transition is -inf, or NaN, from every particle of the step before"


def draw(uniforms: Float[Array, " k"], log_weights: Float[Array, " n"]) -> Int[Array, " k"]:
    """Indices by their weights, by the inverse of the cumulative weights."""
    weights = exp(log_weights - finite_or_zero(jnp.max(log_weights)))
    upto = jnp.cumsum(weights)
    # Rounding must not lead past the last particle of positive weight.
    last = jnp.max(jnp.where(weights > 0, jnp.arange(weights.shape[0]), 0))
    indices = jnp.searchsorted(upto, uniforms * upto[-1], side="right")
    return jnp.minimum(indices, last).astype(jnp.int32)


def draw_exactly(
    key: Key[Array, ""],
    model: Any,
    next_states: PyTree,
    mixture: ParticleMixture,
    num_draws: int = 1,
    needed: Bool[Array, " k"] | None = None,
) -> Int[Array, "k draws"]:
    """Indices for each of the next states by W^i D(next | x^i), O(N) for a state.

    An error at run time where a state that is `needed` cannot have come from any particle.
    """
    n = mixture.num_particles

    def log_weights_of(state: PyTree) -> Float[Array, " n"]:
        copies = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (n, *leaf.shape)), state)
        log_density = model.log_transition(copies, mixture.particles)
        check_log_density(log_density, model, "log_transition", n)
        return jnp.where(mixture.occupied, mixture.log_weights + log_density, -jnp.inf)

    def draw_some(inputs: tuple[Array, PyTree]) -> tuple[Array, Array]:
        quantiles, state = inputs
        log_weights = log_weights_of(state)
        largest = jnp.max(log_weights)
        weights = exp(log_weights - finite_or_zero(largest))
        rows = jnp.broadcast_to(weights, (num_draws, n))
        return draw_columns(quantiles, rows), largest

    num_states = jax.tree.leaves(next_states)[0].shape[0]
    quantiles = uniform(key, (num_states, num_draws), mixture.log_weights.dtype)
    together = max(1, min(num_states, MOST_DENSITIES // n))
    inputs = (quantiles, next_states)
    if together == num_states:
        indices, largest = jax.vmap(draw_some)(inputs)
    else:
        indices, largest = jax.lax.map(draw_some, inputs, batch_size=together)
    return _with_a_past(indices, largest, needed)


def walk(
    key: Key[Array, ""],
    model: Any,
    next_states: PyTree,
    mixture: ParticleMixture,
    start: Int[Array, " k"],
    num_steps: int,
    needed: Bool[Array, " k"] | None = None,
) -> Int[Array, "steps k"]:
    """Steps of independent Metropolis-Hastings on the index, whose target is W^i D(next | x^i).

    O(1) for a state and step; the index after each of the steps.
    """
    num_states = start.shape[0]
    dtype = mixture.log_weights.dtype

    def log_density(indices: Int[Array, " k"]) -> Float[Array, " k"]:
        previous = jax.tree.map(lambda leaf: take(leaf, indices), mixture.particles)
        values = model.log_transition(next_states, previous)
        check_log_density(values, model, "log_transition", num_states)
        return values

    def move(
        place: tuple[Int[Array, " k"], Float[Array, " k"]], step_key: Key[Array, ""]
    ) -> tuple[tuple[Int[Array, " k"], Float[Array, " k"]], Int[Array, " k"]]:
        indices, current = place
        key_proposal, key_accept = split(step_key, 2)
        proposed = draw(uniform(key_proposal, (num_states,), dtype), mixture.log_weights)
        new = log_density(proposed)
        # The proposal draws by the weights, which therefore cancel in the acceptance ratio.
        accepted = jnp.log(uniform(key_accept, (num_states,), dtype)) < new - current
        accepted |= current == -jnp.inf
        indices = jnp.where(accepted, proposed, indices)
        return (indices, jnp.where(accepted, new, current)), indices

    first = (start, log_density(start))
    (_, current), indices = jax.lax.scan(move, first, split(key, num_steps))
    return _with_a_past(indices, current, needed)


def _with_a_past(
    indices: Int[Array, "..."], log_density: Float[Array, " k"], needed: Bool[Array, " k"] | None
) -> Int[Array, "..."]:
    lost = ~(log_density > -jnp.inf)
    return eqx.error_if(indices, jnp.any(lost if needed is None else lost & needed), _NO_PAST)
