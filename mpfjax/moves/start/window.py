"""x_t given the first observations: one tempered sampler of x_0 and of the noise of each step."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int, Key, PyTree, UInt32

from mpfjax.mixture import flatten_states, single_component
from mpfjax.models.base import is_made_of_noise, with_inputs
from mpfjax.models.conditionally_linear import is_mixed, with_moments
from mpfjax.models.noise import noise_dtype, normal_of, uniform_of
from mpfjax.models.steps import completed, drawn, made_of, noise_dimension, seen
from mpfjax.moves.resampling.ancestors import draw_ancestors
from mpfjax.moves.resampling.line import HILBERT, in_line
from mpfjax.operations.logarithms import default_float, exp, finite_max, log_sum_exp
from mpfjax.operations.random import normal, split
from mpfjax.operations.stored import take

# The part of the pilot that stays effective from one power to the next.
LEAST_PART = 0.8
# Moves of each particle after a power of y_t, over t: those of the first ones are cheap.
MOVES = (12, 8, 6, 3, 2, 1)
NOISE, WALK, NEIGHBOURS = 0.15, 0.4, 0.57
TURN = 0.7
LEAST_SIZE = 2.0**-8
MOST_POWERS = 60


class Window(NamedTuple):
    """The first L steps: what is seen, what is known beside it, and which observations are there."""

    observations: PyTree
    inputs: PyTree
    present: Bool[Array, " steps"]


class Paths(NamedTuple):
    """x_0 and the noise of each step, or what they are made of, and what follows from them."""

    places: PyTree  # x_0, or the noise that it is made of
    noise: Array  # (n, L, k), normal; or the words of keys, (n, L, 2)
    states: PyTree  # x_t
    log_before: Float[Array, " n"]  # log of the likelihood of y_1..y_(t-1)
    log_last: Float[Array, " n"]  # and of y_t


def first_paths(key: Key[Array, ""], model: Any, number: int, length: int) -> Paths:
    key_places, key_noise = split(key, 2)
    if is_made_of_noise(model, "initial"):
        places = normal(key_places, (number, model.initial_noise_dimension), default_float())
    else:
        places = model.sample_initial(key_places, number)
    states, zeros = states_of(model, places), jnp.zeros(number, default_float())
    k = noise_size(model, states)
    noise = anew(model, states, jax.random.bits(key_noise, (length * k, number), jnp.uint32))
    return Paths(places, noise.reshape(number, length, k), states, zeros, zeros)


def states_of(model: Any, places: PyTree) -> PyTree:
    of_noise = is_made_of_noise(model, "initial")
    return with_moments(model, model.initial_from_noise(places) if of_noise else places)


def log_prior(model: Any, places: PyTree) -> Float[Array, " n"]:
    if is_made_of_noise(model, "initial"):
        return -0.5 * jnp.sum(places**2, axis=1)
    return model.log_initial(places)


def has_noise(model: Any) -> bool:
    return is_made_of_noise(model) or is_mixed(model)


def noise_size(model: Any, states: PyTree) -> int:
    return noise_dimension(model, states) if has_noise(model) else 2


def anew(model: Any, states: PyTree, words: UInt32[Array, "k n"]) -> Array:
    """Noise of these random bits: normal, or the words of keys."""
    return (normal_of(words, noise_dtype(states)) if has_noise(model) else words).T


def turned(noise: Array, anew: Array) -> Array:
    return TURN * noise + (1 - TURN**2) ** 0.5 * anew if anew.dtype != jnp.uint32 else anew


def advanced(model, window, noise, s, states):
    at = lambda leaf: jax.lax.dynamic_index_in_dim(leaf, s, keepdims=False)  # noqa: E731
    model = with_inputs(model, jax.tree.map(at, window.inputs))
    now = jax.lax.dynamic_index_in_dim(noise, s, 1, keepdims=False)
    if has_noise(model):
        draws = made_of(model, now, states)
    else:
        alone = lambda tree: jax.tree.map(lambda leaf: leaf[None], tree)  # noqa: E731

        def draw(words, state):
            one = drawn(jax.random.wrap_key_data(words), model, alone(state))
            return jax.tree.map(lambda leaf: leaf[0], one)

        draws = jax.vmap(draw)(now, states)
    moved, logs = seen(model, jax.tree.map(at, window.observations), completed(model, draws, states))
    return moved, jnp.where(window.present[s], sum(logs), 0.0)


def followed(model, window, places, noise, t) -> Paths:
    def advance(s, path):
        states, log_last = advanced(model, window, noise, s, path.states)
        return path._replace(
            states=states, log_before=path.log_before + path.log_last, log_last=log_last
        )

    zeros = jnp.zeros(noise.shape[0], default_float())
    start = Paths(places, noise, states_of(model, places), zeros, zeros)
    return jax.lax.fori_loop(0, t, advance, start)


def growth(log_last: Float[Array, " p"], power) -> Float[Array, ""]:
    """By how much the power may grow, so that enough of the pilot stays effective."""
    below = log_last - finite_max(log_last)
    alive = jnp.sum(log_last > -jnp.inf)

    def halve(_, bounds):
        low, high = bounds
        middle = (low + high) / 2
        weights = exp(middle * below)
        enough = jnp.sum(weights) ** 2 >= LEAST_PART * alive * jnp.sum(weights**2)
        return jnp.where(enough, middle, low), jnp.where(enough, high, middle)

    rest = 1 - power
    low, high = jax.lax.fori_loop(0, 24, halve, (0.0 * rest, 2 * rest))
    return jnp.minimum(low, rest)


def proposed(words, model, paths, s, pilot):
    """The paths from other x_0, or with other noise of step s."""
    p, d = pilot.shape
    flat, dtype = flatten_states(paths.places), pilot.dtype
    to_places = jax.vmap(ravel_pytree(jax.tree.map(lambda leaf: leaf[0], paths.places))[1])
    choice, first, second, size = uniform_of(words[:4], dtype)
    sizes, directions = uniform_of(words[4 : 4 + d], dtype).T, normal_of(words[4 + d : 4 + 2 * d], dtype).T
    is_near = choice < NEIGHBOURS
    a = (first * p).astype(jnp.int32)
    b = jnp.where(is_near, a + 1 + (8 * second).astype(jnp.int32), (second * p).astype(jnp.int32)) % p
    factor = jnp.where(is_near, jnp.where(size < .5, 1., -1.) * .2 * (1.5/.2) ** (2 * size % 1), 1.0)
    apart = factor[:, None] * (take(pilot, a) - take(pilot, b))
    walk = jnp.std(pilot, axis=0, keepdims=True) * LEAST_SIZE ** sizes * directions
    step = jnp.where((choice < WALK)[:, None], walk, apart)
    of_noise = (choice < NOISE)[:, None]
    places = to_places(flat + jnp.where(of_noise, 0.0, step))
    now = jax.lax.dynamic_index_in_dim(paths.noise, s, 1, keepdims=False)
    now = jnp.where(of_noise, turned(now, anew(model, paths.states, words[4 + 2 * d :])), now)
    noise = jax.lax.dynamic_update_index_in_dim(paths.noise, now, s, 1)
    # The turn leaves the law of the noise as it is.
    return places, noise


def observe(key, model, window, paths, t, n):
    """y_t, t from 1 on."""
    states, log_last = advanced(model, window, paths.noise, t - 1, paths.states)
    paths = paths._replace(
        states=states, log_before=paths.log_before + paths.log_last, log_last=log_last
    )
    number = paths.noise.shape[0]
    labels = (jnp.arange(number) >= n).astype(jnp.int32)
    targets = jnp.array([n, number - n], jnp.int32)
    d = flatten_states(paths.places).shape[1]
    num_words = 5 + 2 * d + noise_size(model, paths.states)
    moves = take(jnp.array(MOVES), jnp.minimum(t, len(MOVES)) - 1)

    def stage(carry):
        key, paths, power, log_z, count, cost = carry
        key, key_drawn, key_moves = split(key, 3)
        grown = growth(paths.log_last[n:], power)
        after = jnp.where((count >= MOST_POWERS) | (grown + power > 1 - 1e-6), 1.0, power + grown)
        log_weights = jnp.where(power < after, (after - power) * paths.log_last, 0.0)
        log_z += log_sum_exp(log_weights[:n]) - jnp.log(n)
        dead = jnp.array([jnp.max(log_weights[:n]), jnp.max(log_weights[n:])]) == -jnp.inf
        mixture = single_component(paths.places, 2).replace(
            log_weights=jnp.where(dead[labels], 0.0, log_weights), component_indicators=labels
        )
        line = in_line(mixture, sort_by=HILBERT)
        parents = draw_ancestors(
            key_drawn, line, targets, "systematic", num_slots=number
        ).particles
        paths = jax.tree.map(lambda leaf: take(leaf, parents), paths)
        pilot = flatten_states(paths.places)[n:]

        def move(i, paths):
            words = jax.random.bits(jax.random.fold_in(key_moves, i), (num_words, number), jnp.uint32)
            s = (words[0, 0] % t.astype(jnp.uint32)).astype(jnp.int32)
            new = followed(model, window, *proposed(words[1:], model, paths, s, pilot), t)
            log = lambda paths: (  # noqa: E731
                log_prior(model, paths.places) + paths.log_before + after * paths.log_last
            )
            taken = jnp.log(uniform_of(words[0], default_float())) < log(new) - log(paths)
            pick = lambda new, old: jnp.where(taken.reshape(-1, *[1] * (old.ndim - 1)), new, old)  # noqa: E731
            return jax.tree.map(pick, new, paths)

        at_once = (power == 0) & (after == 1)
        m = jnp.where(at_once, 0, moves)
        paths = jax.lax.fori_loop(0, m, move, paths)
        return key, paths, after, log_z, count + 1, cost + m * t

    zero = jnp.zeros((), default_float())
    start = key, paths, zero, zero, jnp.zeros((), jnp.int32), jnp.ones((), jnp.int32)
    _, paths, _, log_z, count, cost = jax.lax.while_loop(lambda carry: carry[2] < 1, stage, start)
    return paths, log_z, (count, cost)


def window_start(key, model, window, num_particles, pilot=None):
    length = window.present.shape[0]
    number = num_particles + (pilot or max(num_particles // 5, 2))
    key_first, key_steps = split(key, 2)
    paths = first_paths(key_first, model, number, length)

    def advance(paths, step):
        key, t = step
        paths, *found = observe(key, model, window, paths, t, num_particles)
        return paths, found

    steps = jax.random.split(key_steps, length), jnp.arange(1, length + 1)
    paths, (log_z, costs) = jax.lax.scan(advance, paths, steps)
    return jax.tree.map(lambda leaf: leaf[:num_particles], paths), log_z, costs
