"""x_t given y_1..y_t of few steps: a tempered sampler of x_0 and of the noise of each step.

A particle is a whole path: x_0, or the noise that it is made of, and the noise of each step; where
a model draws x_t by a key, a key of its own for each step, so that x_t is a function of x_0 and of
the keys. y_t enters by powers (Del Moral, Doucet and Jasra 2006). After each, paths are resampled
and moved by Metropolis steps (resample-move, Gilks and Berzuini 2001; Chopin 2002) for the target
p(x_0) Π_{s<t} L(y_s | x_s) L(y_t | x_t)^power. Other noise of step t is proposed, which costs a
step, or another x_0 with the noise kept, which costs t, since the whole path follows. A pilot of
paths with draws of its own, moved along with them, decides the powers and lends the steps of x_0,
so that Ẑ is unbiased.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int, Key, PyTree, UInt32

from mpfjax.checks import shown
from mpfjax.mixture import flatten_states, single_component
from mpfjax.models.base import innermost, is_made_of_noise, takes_inputs, with_inputs
from mpfjax.models.conditionally_linear import is_marginalised, is_mixed, with_moments
from mpfjax.models.law import law_of
from mpfjax.models.noise import noise_dtype, normal_of, uniform_of
from mpfjax.moves.resampling.ancestors import draw_ancestors
from mpfjax.moves.resampling.line import in_line
from mpfjax.operations.logarithms import (
    add_gradient,
    default_float,
    exp,
    finite_max,
    log_sum_exp,
    without_gradient,
)
from mpfjax.operations.random import bits, normal, split
from mpfjax.operations.rows import select_rows
from mpfjax.operations.stored import take

# Paths of the pilot for each of the cloud.
PILOT = 1 / 5
# The part of the pilot that stays effective from one power to the next, and the most powers of one
# observation, of which the last is 1 in any case.
LEAST_PART, MOST_POWERS = 0.8, 64
# Moves of the noise after each power of y_t, and the steps that those of x_0 may take there: one
# takes t.
NOISE_MOVES, PATH_STEPS = 6, 12
# Of the moves of x_0 those that are walks; the others are differences of two of the pilot.
OF_WALKS = 0.4
# What a move leaves of the noise of a step, and the least part of a deviation of x_0 in a walk.
KEPT_NOISE, LEAST_SIZE = 0.7, 2.0**-8


class Window(NamedTuple):
    """Some steps: what is observed and known beside it, and which observations are there."""

    observations: PyTree
    inputs: PyTree
    present: Bool[Array, " steps"]

    def at(self, s: Int[Array, ""]) -> "Window":
        """One step."""
        return jax.tree.map(lambda leaf: jax.lax.dynamic_index_in_dim(leaf, s, 0, False), self)


class Paths(NamedTuple):
    """x_0 and the noise of each step, and what follows of them."""

    places: PyTree  # x_0, or the noise that it is made of
    noise: Array  # (n, steps, k), normal; or the words of a key, (n, steps, 2)
    before: PyTree  # x_{t-1}
    states: PyTree  # x_t
    log_before: Float[Array, " n"]  # log L(y_1..y_{t-1})
    log_last: Float[Array, " n"]  # log L(y_t)


def check_start(model: Any, needed_by: str) -> None:
    """Raise a `ValueError` for a model whose x_0 cannot be moved, or whose inputs are hidden."""
    has_density = callable(getattr(model, "log_initial", None)) and not is_marginalised(model)
    if not is_made_of_noise(model, "initial") and not has_density:
        how = "nor makes x_0 of noise, initial_from_noise"
        raise ValueError(f"model: {shown(model)} defines no log_initial, {how}; {needed_by}")
    if takes_inputs(model) and not hasattr(innermost(model), "inputs"):
        raise ValueError(f"model: {shown(model)} has inputs but no field `inputs`; {needed_by}")


def inputs_of(model: Any) -> PyTree:
    """u_t of a model that has been given them."""
    return getattr(innermost(model), "inputs", None)


def first_paths(key: Key[Array, ""], model: Any, num_particles: int, num_steps: int) -> Paths:
    """The paths before any observation, and after them those of the pilot."""
    key_places, key_noise = split(key, 2)
    model, n = without_gradient(model), num_particles + max(2, round(PILOT * num_particles))
    if is_made_of_noise(model, "initial"):
        places = normal(key_places, (n, model.initial_noise_dimension), default_float())
    else:
        places = model.sample_initial(key_places, n)
    states = _initial(model, places)
    k = _noise_size(model, states)
    noise = _noise_of(model, states, bits(key_noise, (num_steps * k, n)))
    return _unseen(places, noise.reshape(n, num_steps, k), states)


def observe(
    key: Key[Array, ""], model: Any, window: Window, paths: Paths, t: Int[Array, ""], n: int
) -> tuple[Paths, Float[Array, ""]]:
    """The paths given y_t too, t from 1 on, and log p(y_t | y_1..y_{t-1}), of the first n."""
    model, window, paths = without_gradient((model, window, paths))
    paths, number = _advanced(model, window, t - 1, paths), paths.noise.shape[0]
    is_pilot = jnp.arange(number) >= n
    targets = jnp.array([n, number - n], jnp.int32)
    num_moves = NOISE_MOVES + jnp.maximum(PATH_STEPS // t, 1)
    num_words = 4 + 2 * flatten_states(paths.places).shape[1] + paths.noise.shape[2]

    def resampled(key: Key[Array, ""], paths: Paths, log_weights: Float[Array, " n"]) -> Paths:
        most = jnp.where(is_pilot, jnp.max(log_weights[n:]), jnp.max(log_weights[:n]))
        # Without any mass they stay as they are.
        log_weights = jnp.where(most > -jnp.inf, log_weights, 0.0)
        mixture = single_component(paths.places, 2).replace(
            log_weights=log_weights, component_indicators=is_pilot.astype(jnp.int32)
        )
        line = in_line(mixture)
        parents = draw_ancestors(key, line, targets, "systematic", num_slots=number).particles
        return jax.tree.map(lambda leaf: take(leaf, parents), paths)

    def stage(carry: tuple) -> tuple:
        key, paths, power, log_mean, count = carry
        key, key_drawn, key_moves = split(key, 3)
        growth = _growth(paths.log_last[n:], 1 - power)
        after = jnp.where((count == MOST_POWERS) | (power + growth > 1 - 1e-6), 1.0, power + growth)
        log_weights = (after - power) * paths.log_last
        log_mean += log_sum_exp(log_weights[:n]) - np.log(n)
        paths = resampled(key_drawn, paths, log_weights)
        pilot = flatten_states(paths.places)[n:]

        def move(i: Int[Array, ""], paths: Paths) -> Paths:
            words = bits(jax.random.fold_in(key_moves, i), (num_words, number))
            is_of_noise = i < NOISE_MOVES
            new = _proposed(words[1:], model, paths, t, pilot, is_of_noise)
            first = jnp.where(is_of_noise, t - 1, 0)
            new = jax.lax.fori_loop(first, t, partial(_advanced, model, window), new)
            log_ratio = _log_target(model, new, after) - _log_target(model, paths, after)
            accepted = jnp.log(uniform_of(words[0], log_ratio.dtype)) < log_ratio
            return select_rows(accepted, new, paths)

        # Where y_t is no surprise at all, the draws are as good as new ones.
        is_moved = (power > 0) | (after < 1)
        paths = jax.lax.fori_loop(0, jnp.where(is_moved, num_moves, 0), move, paths)
        return key, paths, after, log_mean, count + 1

    zero = jnp.zeros((), default_float())
    first = key, paths, zero, zero, jnp.ones((), jnp.int32)
    _, paths, _, log_mean, _ = jax.lax.while_loop(lambda carry: carry[2] < 1, stage, first)
    return paths, log_mean


def with_derivatives(
    model: Any, window: Window, paths: Paths, t: Int[Array, ""]
) -> tuple[PyTree, Float[Array, " n"]]:
    """x_t of each path with its derivatives, and log p(x_0, y_1..y_t | noise), for them alone.

    By Fisher's identity the mean of the derivatives of the second is the score of y_1..y_t.
    """

    def advance(now: Paths, s: Int[Array, ""]) -> tuple[Paths, None]:
        new = _advanced(model, window, s, now)
        return jax.tree.map(lambda new, old: jnp.where(s < t, new, old), new, now), None

    first = _unseen(paths.places, paths.noise, _initial(model, paths.places))
    last, _ = jax.lax.scan(advance, first, jnp.arange(window.present.shape[0]))

    def tied(value: Array, source: Array) -> Array:
        return add_gradient(value, source) if jnp.issubdtype(value.dtype, jnp.inexact) else value

    return jax.tree.map(tied, paths.states, last.states), _log_target(model, last, 1.0)


def _log_target(model: Any, paths: Paths, power: Any) -> Float[Array, " n"]:
    if is_made_of_noise(model, "initial"):
        log_prior = -0.5 * jnp.sum(paths.places**2, axis=1)
    else:
        log_prior = model.log_initial(paths.places)
    return log_prior + paths.log_before + power * paths.log_last


def _unseen(places: PyTree, noise: Array, states: PyTree) -> Paths:
    """Paths before any observation."""
    zeros = jnp.zeros(noise.shape[0], default_float())
    return Paths(places, noise, states, states, zeros, zeros)


def _initial(model: Any, places: PyTree) -> PyTree:
    of_noise = is_made_of_noise(model, "initial")
    return with_moments(model, model.initial_from_noise(places) if of_noise else places)


def _is_of_noise(model: Any) -> bool:
    return is_made_of_noise(model) or is_mixed(model)


def _noise_size(model: Any, states: PyTree) -> int:
    return law_of(model).noise_dimension(states) if _is_of_noise(model) else 2


def _noise_of(model: Any, states: PyTree, words: UInt32[Array, "k n"]) -> Array:
    """Noise of these random bits: normal, or the words of keys."""
    return (normal_of(words, noise_dtype(states)) if _is_of_noise(model) else words).T


def _advanced(model: Any, window: Window, s: Int[Array, ""], paths: Paths) -> Paths:
    """The paths one step further, to that of index s."""
    now, noise = window.at(s), jax.lax.dynamic_index_in_dim(paths.noise, s, 1, False)
    model = with_inputs(model, now.inputs)
    if _is_of_noise(model):
        draws = law_of(model).make(noise, paths.states)
    else:

        def draw(words: UInt32[Array, "2"], state: PyTree) -> PyTree:
            alone = jax.tree.map(lambda leaf: leaf[None], state)
            moved = law_of(model).draw(jax.random.wrap_key_data(words), alone)
            return jax.tree.map(lambda leaf: leaf[0], moved)

        draws = jax.vmap(draw)(noise, paths.states)
    states, logs = law_of(model).see(now.observations, law_of(model).complete(draws, paths.states))
    log_last = jnp.where(now.present, sum(logs), 0.0).astype(paths.log_last.dtype)
    log_before = paths.log_before + paths.log_last
    return Paths(paths.places, paths.noise, paths.states, states, log_before, log_last)


def _growth(log_last: Float[Array, " p"], rest: Float[Array, ""]) -> Float[Array, ""]:
    """The growth of the power, up to the `rest`, that leaves enough of the pilot effective.

    Those without any likelihood are lost with the smallest power, and do not count.
    """
    below = log_last - finite_max(log_last)
    number = jnp.sum((log_last > -jnp.inf).astype(log_last.dtype))

    def halve(_: Any, bounds: tuple) -> tuple:
        low, high = bounds
        middle = (low + high) / 2
        weights = exp(middle * below)
        is_enough = jnp.sum(weights) ** 2 >= LEAST_PART * number * jnp.sum(weights**2)
        return jnp.where(is_enough, middle, low), jnp.where(is_enough, high, middle)

    return jnp.minimum(jax.lax.fori_loop(0, 24, halve, (0 * rest, 2 * rest))[0], rest)


def _proposed(
    words: UInt32[Array, "w n"],
    model: Any,
    paths: Paths,
    t: Int[Array, ""],
    pilot: Array,
    is_of_noise: Bool[Array, ""],
) -> Paths:
    """The paths with other noise of step t at x_{t-1}, or with the same at another x_0.

    Steps of x_0 are walks of many sizes, in each coordinate another, and differences of any two of
    the pilot, which lead from mode to mode.
    """
    (p, d), flat = pilot.shape, flatten_states(paths.places)
    to_places = jax.vmap(ravel_pytree(jax.tree.map(lambda leaf: leaf[0], paths.places))[1])
    kind, *pair = uniform_of(words[:3], pilot.dtype)
    sizes, directions = words[3 : 3 + d], words[3 + d : 3 + 2 * d]
    deviations = jnp.std(pilot, axis=0, keepdims=True)
    walk = deviations * LEAST_SIZE ** uniform_of(sizes, pilot.dtype).T
    walk *= normal_of(directions, pilot.dtype).T
    one, other = (take(pilot, (p * place).astype(jnp.int32)) for place in pair)
    places = to_places(flat + select_rows(kind < OF_WALKS, walk, one - other))
    noise = _noise_of(model, paths.states, words[3 + 2 * d :])
    if _is_of_noise(model):
        now = jax.lax.dynamic_index_in_dim(paths.noise, t - 1, 1, False)
        noise = KEPT_NOISE * now + np.sqrt(1 - KEPT_NOISE**2) * noise
    noise = jax.lax.dynamic_update_index_in_dim(paths.noise, noise, t - 1, 1)
    at_start = _unseen(places, paths.noise, _initial(model, places))
    at_step = paths._replace(noise=noise, states=paths.before, log_last=at_start.log_last)
    return jax.tree.map(partial(jnp.where, is_of_noise), at_step, at_start)
