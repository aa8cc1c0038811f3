"""A tempered sampler of x_L given y_1..y_L of a short window, over x_0 and each step's noise.

A particle is a whole path: x_0, or its noise, and the noise of each step; if a model draws x_t by a
key, a separate key for each step, so that x_t is a function of x_0 and of the keys. y_t enters by
powers (Del Moral, Doucet and Jasra 2006). After each power, paths are resampled and moved by
Metropolis steps (resample-move, Gilks and Berzuini 2001; Chopin 2002) for the target p(x_0) Π_{s<t}
L(y_s | x_s) L(y_t | x_t)^power. A step proposes either new noise for step t, which requires one
step, or another x_0 with the same noise, which requires t, because the whole path follows. A pilot
set of independent paths is moved along: it determines the powers and the steps of x_0, so that the
evidence remains unbiased.
"""

from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int, Key, PyTree, UInt32

from mpfjax.mixture import flatten_states
from mpfjax.models.base import is_made_of_noise, model_name, with_inputs
from mpfjax.models.law import law_of, refuse_marginalised
from mpfjax.models.noise import noise_dtype, normal_of, uniform_of
from mpfjax.operations.logarithms import (
    default_float,
    exp,
    finite_max,
    log_sum_exp,
)
from mpfjax.operations.random import bits, normal, split, uniform
from mpfjax.operations.stored import select_rows, take

# Paths of the pilot for each of the sample.
PILOT = 1 / 5
# The part of the pilot that stays effective from one power to the next, the least growth of a power
# as an exponent of 2, and the most powers of one observation, of which the last is 1 in any case.
LEAST_PART, LEAST_GROWTH, MOST_POWERS = 0.8, -48.0, 512
# Moves of the noise after each power of y_t, and the steps that those of x_0 may take there: one
# takes t.
NOISE_MOVES, PATH_STEPS = 6, 12
# The part of the moves of x_0 that are walks; the others add a difference of two of the pilot.
PART_OF_WALKS = 0.4
# The correlation of the noise of a step with its proposal, and the least part of a standard
# deviation of x_0 in a walk.
NOISE_CORRELATION, LEAST_SIZE = 0.7, 2.0**-8


class Window(NamedTuple):
    """y, u, and whether y is present, of some steps; leaves have a leading axis of steps."""

    observations: PyTree
    inputs: PyTree
    present: Bool[Array, " steps"]

    def at(self, s: Int[Array, ""]) -> "Window":
        """The data of one step."""
        return jax.tree.map(lambda leaf: jax.lax.dynamic_index_in_dim(leaf, s, 0, False), self)


class WindowSample(NamedTuple):
    """What the sampler returns."""

    states: PyTree
    """x_L of each particle, equally weighted."""
    log_increments: Float[Array, " steps"]
    """log p(y_s | y_1..y_{s-1}) of each step, whose exponential has no bias in their product."""
    is_rushed: Bool[Array, ""]
    """whether some observation needed more than `MOST_POWERS` powers, and the sample is poor."""


class _Paths(NamedTuple):
    initial: PyTree  # x_0, or the noise that it is made of
    noise: Array  # (n, steps, k), normal; or the words of a key, (n, steps, 2)
    previous: PyTree  # x_{t-1}
    states: PyTree  # x_t
    log_past: Float[Array, " n"]  # log L(y_1..y_{t-1})
    log_likelihood: Float[Array, " n"]  # log L(y_t)


def check_initial_density(model: Any, needed_by: str) -> None:
    """Raise a `ValueError` for a model whose x_0 cannot be moved."""
    refuse_marginalised(model, needed_by, "start from a mixture of your own")
    if is_made_of_noise(model, "initial"):
        return
    if not callable(getattr(model, "log_initial", None)):
        how = "nor makes x_0 of noise, initial_from_noise"
        raise ValueError(
            f"model: {model_name(model)} defines no log_initial, {how}; {needed_by} needs one"
        )
    states = jax.eval_shape(lambda key: model.sample_initial(key, 2), jax.random.key(0))
    for leaf in jax.tree.leaves(states):
        if not jnp.issubdtype(leaf.dtype, jnp.floating):
            which = f"has {leaf.dtype} in x_0, which {needed_by} cannot move"
            raise ValueError(f"model: {model_name(model)} {which}; define initial_from_noise")


def sample_window(
    key: Key[Array, ""], model: Any, window: Window, num_particles: int
) -> WindowSample:
    """x_L ~ p(x_L | y_1..y_L) of N particles, with the evidence of each step.

    - `model`: without inputs; each step's model gets the window's.

    Raises `ValueError` where derivatives are asked for.
    """
    model, window = jax.tree.map(_without_derivative, (model, window))
    key_first, key_steps = split(key, 2)
    num_steps = window.present.shape[0]
    paths = _first_paths(key_first, model, num_particles, num_steps)

    def observe(s: Int[Array, ""], carry: tuple) -> tuple:
        paths, log_increments, is_rushed = carry
        step_key = jax.random.fold_in(key_steps, s)
        paths, log_increment, ran_out = _observe(step_key, model, window, paths, s, num_particles)
        return paths, log_increments.at[s].set(log_increment), is_rushed | ran_out

    first = paths, jnp.zeros(num_steps, default_float()), jnp.zeros((), bool)
    paths, log_increments, is_rushed = jax.lax.fori_loop(0, num_steps, observe, first)
    states = jax.tree.map(lambda leaf: leaf[:num_particles], paths.states)
    return WindowSample(states, log_increments, is_rushed)


def _without_derivative(leaf: Any) -> Any:
    """The leaf, of which a derivative would be wrong without notice: accepted moves have none."""
    return _constant(leaf) if eqx.is_inexact_array(leaf) else leaf


@jax.custom_jvp
def _constant(values: Array) -> Array:
    return values


@_constant.defjvp
def _refuse(primals: Any, tangents: Any) -> Any:
    raise ValueError(
        "filter: with_initialisation and with_restarts have no derivatives in the model"
    )


def _first_paths(key: Key[Array, ""], model: Any, num_particles: int, num_steps: int) -> _Paths:
    """The paths before any observation, and after them those of the pilot."""
    key_initial, key_noise = split(key, 2)
    n = num_particles + max(2, round(PILOT * num_particles))
    if is_made_of_noise(model, "initial"):
        initial = normal(key_initial, (n, model.initial_noise_dimension), default_float())
    else:
        initial = law_of(model).sample_initial(key_initial, n)
    states = _initial_states(model, initial)
    k = law_of(model).noise_dimension(states) if is_made_of_noise(model) else 2
    noise = _noise_of(model, states, bits(key_noise, (num_steps * k, n)))
    return _at_start(initial, noise.reshape(n, num_steps, k), states)


def _observe(
    key: Key[Array, ""], model: Any, window: Window, paths: _Paths, s: Int[Array, ""], n: int
) -> tuple[_Paths, Float[Array, ""], Bool[Array, ""]]:
    """The paths given the window's step s too, its evidence, and whether the powers ran out.

    At first they are only advanced, by the loop that moves them later, so that a model is compiled
    once.
    """
    number = paths.noise.shape[0]
    num_moves = NOISE_MOVES + jnp.maximum(PATH_STEPS // (s + 1), 1)
    num_words = 4 + 2 * flatten_states(paths.initial).shape[1] + paths.noise.shape[2]

    def resample(key: Key[Array, ""], paths: _Paths, log_weights: Float[Array, " n"]) -> _Paths:
        """The sample by its own weights, and the pilot by its own."""
        key_sample, key_pilot = split(key, 2)
        ancestors = systematic_sample(key_sample, log_weights[:n], n)
        of_pilot = n + systematic_sample(key_pilot, log_weights[n:], number - n)
        ancestors = jnp.concatenate([ancestors, of_pilot])
        return jax.tree.map(lambda leaf: take(leaf, ancestors), paths)

    def temper(carry: tuple) -> tuple:
        old_key, old, power, log_increment, count = carry
        key, key_resample, key_moves = split(old_key, 3)
        is_first, rest = count == 0, 1 - power
        growth = jnp.where(count == MOST_POWERS, rest, _growth(old.log_likelihood[n:], rest))
        is_last = power + growth > 1 - 1e-6
        growth, after = jnp.where(is_last, rest, growth), jnp.where(is_last, 1.0, power + growth)
        log_weights = growth * old.log_likelihood
        log_mass = log_sum_exp(log_weights[:n]) - np.log(n)
        paths = resample(key_resample, old, log_weights)
        pilot = flatten_states(paths.initial)[n:]
        key, paths, after, log_mass = jax.tree.map(
            partial(jnp.where, is_first),
            (old_key, old, jnp.zeros_like(after), jnp.zeros_like(log_mass)),
            (key, paths, after, log_mass),
        )

        def move(i: Int[Array, ""], paths: _Paths) -> _Paths:
            words = bits(jax.random.fold_in(key_moves, i), (num_words, number))
            is_of_noise = i < NOISE_MOVES
            new = _propose(words[1:], model, paths, s, pilot, is_of_noise)
            new = jax.tree.map(partial(jnp.where, is_first), paths, new)
            first = jnp.where(is_of_noise, s, 0)
            new = jax.lax.fori_loop(first, s + 1, partial(_advance, model, window), new)
            log_ratio = _log_target(model, new, after) - _log_target(model, paths, after)
            is_accepted = jnp.log(uniform_of(words[0], log_ratio.dtype)) < log_ratio
            return select_rows(is_accepted | is_first, new, paths)

        # Where y_t is no surprise at all, the draws are as good as new ones.
        is_moved = (power > 0) | (after < 1)
        count_moves = jnp.where(is_first, 1, jnp.where(is_moved, num_moves, 0))
        paths = jax.lax.fori_loop(0, count_moves, move, paths)
        return key, paths, after, log_increment + log_mass, count + 1

    zero = jnp.zeros((), default_float())
    first = key, paths, zero, zero, jnp.zeros((), jnp.int32)
    _, paths, _, log_increment, count = jax.lax.while_loop(
        lambda carry: carry[2] < 1, temper, first
    )
    return paths, log_increment, count > MOST_POWERS


def systematic_sample(
    key: Key[Array, ""], log_weights: Float[Array, " n"], number: int | Int[Array, ""]
) -> Int[Array, " n"]:
    """Indices by these weights, of which the first `number` are a systematic sample.

    By a search, which compiles in a fraction of the time that `Resample` takes, and is run seldom.
    """
    n = log_weights.shape[0]
    # Without any weight all are alike.
    log_weights = jnp.where(jnp.max(log_weights) > -jnp.inf, log_weights, 0.0)
    weights = exp(log_weights - finite_max(log_weights))
    cumulative = jnp.cumsum(weights)
    ranks = jnp.arange(n, dtype=weights.dtype) + uniform(key, (), weights.dtype)
    points = ranks / jnp.asarray(number, weights.dtype) * cumulative[-1]
    indices = jnp.searchsorted(cumulative, points, side="right").astype(jnp.int32)
    # Rounding must not lead past the last particle of positive weight.
    return jnp.minimum(indices, jnp.max(jnp.where(weights > 0, jnp.arange(n, dtype=jnp.int32), 0)))


def _growth(log_likelihood: Float[Array, " p"], rest: Float[Array, ""]) -> Float[Array, ""]:
    """The growth of the power, up to the `rest`, that leaves enough of the pilot effective.

    Found on a logarithmic scale, so that it is above zero however narrow the likelihood is. Paths
    without any likelihood are lost with the smallest power, and do not count.
    """
    below = log_likelihood - finite_max(log_likelihood)
    number = jnp.sum((log_likelihood > -jnp.inf).astype(log_likelihood.dtype))
    growths = rest * jnp.exp2(jnp.arange(LEAST_GROWTH, 1 / 8, 1 / 8))
    weights = exp(growths[:, None] * below[None])
    is_enough = jnp.sum(weights, axis=1) ** 2 >= LEAST_PART * number * jnp.sum(weights**2, axis=1)
    return jnp.max(jnp.where(is_enough, growths, growths[0]))


def _propose(
    words: UInt32[Array, "w n"],
    model: Any,
    paths: _Paths,
    s: Int[Array, ""],
    pilot: Array,
    is_of_noise: Bool[Array, ""],
) -> _Paths:
    """The paths with other noise of step s at x_{s-1}, or with the same noise at another x_0.

    Steps of x_0 are walks of many sizes, another in each coordinate, and differences of any two of
    the pilot, which lead from mode to mode.
    """
    (p, d), flat = pilot.shape, flatten_states(paths.initial)
    unravel = jax.vmap(ravel_pytree(jax.tree.map(lambda leaf: leaf[0], paths.initial))[1])
    kind, *pair = uniform_of(words[:3], pilot.dtype)
    sizes, directions = words[3 : 3 + d], words[3 + d : 3 + 2 * d]
    spreads = jnp.std(pilot, axis=0, keepdims=True)
    walk = spreads * LEAST_SIZE ** uniform_of(sizes, pilot.dtype).T
    walk *= normal_of(directions, pilot.dtype).T
    one, other = (take(pilot, (p * place).astype(jnp.int32)) for place in pair)
    initial = unravel(flat + select_rows(kind < PART_OF_WALKS, walk, one - other))
    noise = _noise_of(model, paths.states, words[3 + 2 * d :])
    if is_made_of_noise(model):
        old = jax.lax.dynamic_index_in_dim(paths.noise, s, 1, False)
        noise = NOISE_CORRELATION * old + np.sqrt(1 - NOISE_CORRELATION**2) * noise
    noise = jax.lax.dynamic_update_index_in_dim(paths.noise, noise, s, 1)
    at_start = _at_start(initial, paths.noise, _initial_states(model, initial))
    at_step = paths._replace(
        noise=noise, states=paths.previous, log_likelihood=at_start.log_likelihood
    )
    return jax.tree.map(partial(jnp.where, is_of_noise), at_step, at_start)


def _advance(model: Any, window: Window, s: Int[Array, ""], paths: _Paths) -> _Paths:
    """The paths one step further, to the window's step s."""
    now, noise = window.at(s), jax.lax.dynamic_index_in_dim(paths.noise, s, 1, False)
    law = law_of(with_inputs(model, now.inputs))
    if is_made_of_noise(model):
        states = law.make(noise, paths.states)
    else:

        def draw(words: UInt32[Array, "2"], state: PyTree) -> PyTree:
            alone = jax.tree.map(lambda leaf: leaf[None], state)
            drawn = law.draw(jax.random.wrap_key_data(words), alone)
            return jax.tree.map(lambda leaf: leaf[0], drawn)

        states = jax.vmap(draw)(noise, paths.states)
    values = law.log_likelihood(now.observations, states)
    log_likelihood = jnp.where(now.present, values, 0.0).astype(paths.log_likelihood.dtype)
    log_past = paths.log_past + paths.log_likelihood
    return _Paths(paths.initial, paths.noise, paths.states, states, log_past, log_likelihood)


def _log_target(model: Any, paths: _Paths, power: Any) -> Float[Array, " n"]:
    if is_made_of_noise(model, "initial"):
        log_prior = -0.5 * jnp.sum(paths.initial**2, axis=1)
    else:
        log_prior = law_of(model).log_initial(paths.initial)
    return log_prior + paths.log_past + power * paths.log_likelihood


def _at_start(initial: PyTree, noise: Array, states: PyTree) -> _Paths:
    """Paths before any observation."""
    zeros = jnp.zeros(noise.shape[0], default_float())
    return _Paths(initial, noise, states, states, zeros, zeros)


def _initial_states(model: Any, initial: PyTree) -> PyTree:
    is_noise = is_made_of_noise(model, "initial")
    return law_of(model).make_initial(initial) if is_noise else initial


def _noise_of(model: Any, states: PyTree, words: UInt32[Array, "k n"]) -> Array:
    """Noise of these random bits: normal, or the words of keys."""
    return (normal_of(words, noise_dtype(states)) if is_made_of_noise(model) else words).T
