"""x_t given y_1..y_t of few steps: a tempered sampler of x_0 and of the noise of each step.

A particle is a whole path: x_0, or the noise that it is made of, and the noise of each step; where
a model draws x_t by a key, a key of its own for each step, so that x_t is a function of x_0 and of
the keys. y_t enters by powers (Del Moral, Doucet and Jasra 2006). After each, paths are resampled
and moved by Metropolis steps (resample-move, Gilks and Berzuini 2001; Chopin 2002) for the target
p(x_0) Π_{s<t} L(y_s | x_s) L(y_t | x_t)^power. Another x_0 is proposed with the noise kept, so that
the whole path follows, or noise of one step with x_0 kept. A pilot of paths with draws of its own,
moved along with them, decides the powers and lends the steps of x_0, so that Ẑ is unbiased.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int, Key, PyTree, UInt32

from mpfjax.checks import shown
from mpfjax.mixture import flatten_states, single_component
from mpfjax.models.base import is_made_of_noise, takes_inputs, with_inputs
from mpfjax.models.conditionally_linear import is_marginalised, is_mixed, with_moments
from mpfjax.models.noise import noise_dtype, normal_of, uniform_of
from mpfjax.models.steps import completed, drawn, made_of, noise_dimension, seen
from mpfjax.moves.resampling.ancestors import draw_ancestors
from mpfjax.moves.resampling.line import HILBERT, in_line
from mpfjax.moves.resampling.sorting import MOST_DIMENSIONS
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
# After each power of y_t x_0 is moved until so many moves over t have been accepted of each path of
# the pilot, or there were the most: a move costs t steps.
MOVED, MOST_MOVES = 2.0, 16
# Shares of the moves: of noise, of walks, and of differences of any two of the pilot, the others
# being differences of neighbours.
OF_NOISE, OF_WALKS, OF_JUMPS = 0.15, 0.25, 0.45
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
    """x_0 and the noise of each step, and what follows: x_t, log L(y_1..y_{t-1}), log L(y_t)."""

    places: PyTree  # x_0, or the noise that it is made of
    noise: Array  # (n, steps, k), normal; or the words of a key, (n, steps, 2)
    states: PyTree
    log_before: Float[Array, " n"]
    log_last: Float[Array, " n"]


def check_start(model: Any, needed_by: str) -> None:
    """Raise a `ValueError` for a model whose x_0 cannot be moved, or whose inputs are hidden."""
    has_density = callable(getattr(model, "log_initial", None)) and not is_marginalised(model)
    if not is_made_of_noise(model, "initial") and not has_density:
        how = "nor makes x_0 of noise, initial_from_noise"
        raise ValueError(f"model: {shown(model)} defines no log_initial, {how}; {needed_by}")
    if takes_inputs(model) and inputs_of(model) is _HIDDEN:
        raise ValueError(f"model: {shown(model)} has inputs but no field `inputs`; {needed_by}")


_HIDDEN = object()


def inputs_of(model: Any) -> PyTree:
    """u_t of a model that has been given them."""
    while not hasattr(model, "inputs") and hasattr(model, "model"):
        model = model.model
    return getattr(model, "inputs", _HIDDEN if takes_inputs(model) else None)


def first_paths(key: Key[Array, ""], model: Any, num_particles: int, num_steps: int) -> Paths:
    """The paths before any observation, and after them those of the pilot."""
    key_places, key_noise = split(key, 2)
    model, n = without_gradient(model), num_particles + max(2, round(PILOT * num_particles))
    if is_made_of_noise(model, "initial"):
        places = normal(key_places, (n, model.initial_noise_dimension), default_float())
    else:
        places = model.sample_initial(key_places, n)
    states, zeros = _initial(model, places), jnp.zeros(n, default_float())
    k = _noise_size(model, states)
    noise = _noise_of(model, states, bits(key_noise, (num_steps * k, n)))
    return Paths(places, noise.reshape(n, num_steps, k), states, zeros, zeros)


def observe(
    key: Key[Array, ""], model: Any, window: Window, paths: Paths, t: Int[Array, ""], n: int
) -> tuple[Paths, Float[Array, ""]]:
    """The paths given y_t too, t from 1 on, and log p(y_t | y_1..y_{t-1}), of the first n."""
    model, window, paths = without_gradient((model, window, paths))
    paths, number = _advanced(model, window, paths, t - 1), paths.noise.shape[0]
    is_pilot = jnp.arange(number) >= n
    targets = jnp.array([n, number - n], jnp.int32)
    enough = jnp.ceil(MOVED * (number - n) / t.astype(default_float())).astype(jnp.int32)
    num_words = 5 + 2 * flatten_states(paths.places).shape[1] + _noise_size(model, paths.states)
    d = flatten_states(paths.places).shape[1]

    def resampled(key: Key[Array, ""], paths: Paths, log_weights: Float[Array, " n"]) -> Paths:
        most = jnp.where(is_pilot, jnp.max(log_weights[n:]), jnp.max(log_weights[:n]))
        # Without any mass they stay as they are.
        log_weights = jnp.where(most > -jnp.inf, log_weights, 0.0)
        mixture = single_component(paths.places, 2).replace(
            log_weights=log_weights, component_indicators=is_pilot.astype(jnp.int32)
        )
        line = in_line(mixture, sort_by=HILBERT if 1 <= d <= MOST_DIMENSIONS else None)
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

        def move(carry: tuple) -> tuple:
            i, num_moved, paths = carry
            words = bits(jax.random.fold_in(key_moves, i), (num_words, number))
            s = (words[0, 0] % t.astype(jnp.uint32)).astype(jnp.int32)
            places, noise, moves_noise = _proposed(words[1:], model, paths, s, pilot)
            new = _followed(model, window, places, noise, t)
            log_ratio = _log_target(model, new, after) - _log_target(model, paths, after)
            accepted = jnp.log(uniform_of(words[1], log_ratio.dtype)) < log_ratio
            num_moved += jnp.sum((accepted & ~moves_noise)[n:], dtype=jnp.int32)
            return i + 1, num_moved, select_rows(accepted, new, paths)

        def is_more(carry: tuple) -> Bool[Array, ""]:
            i, num_moved, _ = carry
            # Where y_t is no surprise at all, the draws are as good as new ones.
            return (num_moved < enough) & (i < MOST_MOVES) & ((power > 0) | (after < 1))

        zero = jnp.zeros((), jnp.int32)
        _, _, paths = jax.lax.while_loop(is_more, move, (zero, zero, paths))
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
        new = _advanced(model, window, now, s)
        return jax.tree.map(lambda new, old: jnp.where(s < t, new, old), new, now), None

    zeros = jnp.zeros_like(paths.log_last)
    first = Paths(paths.places, paths.noise, _initial(model, paths.places), zeros, zeros)
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


def _initial(model: Any, places: PyTree) -> PyTree:
    of_noise = is_made_of_noise(model, "initial")
    return with_moments(model, model.initial_from_noise(places) if of_noise else places)


def _is_of_noise(model: Any) -> bool:
    return is_made_of_noise(model) or is_mixed(model)


def _noise_size(model: Any, states: PyTree) -> int:
    return noise_dimension(model, states) if _is_of_noise(model) else 2


def _noise_of(model: Any, states: PyTree, words: UInt32[Array, "k n"]) -> Array:
    """Noise of these random bits: normal, or the words of keys."""
    return (normal_of(words, noise_dtype(states)) if _is_of_noise(model) else words).T


def _advanced(model: Any, window: Window, paths: Paths, s: Int[Array, ""]) -> Paths:
    """The paths one step further, to that of index s."""
    now, noise = window.at(s), jax.lax.dynamic_index_in_dim(paths.noise, s, 1, False)
    model = with_inputs(model, now.inputs)
    if _is_of_noise(model):
        draws = made_of(model, noise, paths.states)
    else:

        def draw(words: UInt32[Array, "2"], state: PyTree) -> PyTree:
            alone = jax.tree.map(lambda leaf: leaf[None], state)
            moved = drawn(jax.random.wrap_key_data(words), model, alone)
            return jax.tree.map(lambda leaf: leaf[0], moved)

        draws = jax.vmap(draw)(noise, paths.states)
    states, logs = seen(model, now.observations, completed(model, draws, paths.states))
    log_last = jnp.where(now.present, sum(logs), 0.0).astype(paths.log_last.dtype)
    log_before = paths.log_before + paths.log_last
    return paths._replace(states=states, log_before=log_before, log_last=log_last)


def _followed(model: Any, window: Window, places: PyTree, noise: Array, t: Int[Array, ""]) -> Paths:
    """The paths from these x_0 and of this noise, to step t."""
    zeros = jnp.zeros(noise.shape[0], default_float())
    first = Paths(places, noise, _initial(model, places), zeros, zeros)
    return jax.lax.fori_loop(0, t, lambda s, now: _advanced(model, window, now, s), first)


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
    words: UInt32[Array, "w n"], model: Any, paths: Paths, s: Int[Array, ""], pilot: Array
) -> tuple[PyTree, Array, Bool[Array, " n"]]:
    """Other x_0 with the same noise, or the same with other noise of step s, and which it is.

    Steps of x_0 are walks of many sizes, in each coordinate another, and differences of two of the
    pilot, which are in order along a curve: those of neighbours fit a mode, and those of any two
    lead from mode to mode.
    """
    (p, d), flat = pilot.shape, flatten_states(paths.places)
    to_places = jax.vmap(ravel_pytree(jax.tree.map(lambda leaf: leaf[0], paths.places))[1])
    kind, first, apart = uniform_of(words[1:4], pilot.dtype)
    sizes, directions = words[4 : 4 + d], words[4 + d : 4 + 2 * d]
    deviations = jnp.std(pilot, axis=0, keepdims=True)
    walk = deviations * LEAST_SIZE ** uniform_of(sizes, pilot.dtype).T
    walk *= normal_of(directions, pilot.dtype).T
    one = (first * p).astype(jnp.int32)
    is_jump = kind > 1 - OF_JUMPS
    distance = jnp.where(is_jump, p * apart, jnp.exp(jnp.log(p / 2) * apart)).astype(jnp.int32)
    other = (one + jnp.where(words[3] % 2 == 0, distance, p - distance)) % p
    step = select_rows(kind < OF_NOISE + OF_WALKS, walk, take(pilot, one) - take(pilot, other))
    moves_noise = kind < OF_NOISE
    places = to_places(flat + select_rows(moves_noise, jnp.zeros_like(step), step))
    now = jax.lax.dynamic_index_in_dim(paths.noise, s, 1, False)
    anew = _noise_of(model, paths.states, words[4 + 2 * d :])
    if _is_of_noise(model):
        anew = KEPT_NOISE * now + np.sqrt(1 - KEPT_NOISE**2) * anew
    now = select_rows(moves_noise, anew, now)
    return places, jax.lax.dynamic_update_index_in_dim(paths.noise, now, s, 1), moves_noise
