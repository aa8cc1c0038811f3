"""A tempered sampler of x_L given y_1..y_L of a short window, over x_0 and the keys of all draws.

A particle is a whole path: x_0, or its noise, and a key for the draw of each x_t, which is thus a
function of x_0 and of the keys. y_t enters by powers (Del Moral, Doucet and Jasra 2006). Before
each power, paths are moved by Metropolis steps (resample-move, Gilks and Berzuini 2001; Chopin
2002) for the target p(x_0) Π_{s<t} L(y_s | x_s) L(y_t | x_t)^power, and after it resampled. A step
proposes either another draw of x_t, which requires one transition, or another x_0 with the same
keys, which requires t, because the whole path follows. A pilot set of independent paths is moved
along: it determines the powers and the steps of x_0, so that the evidence remains unbiased.
"""

from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int, Key, PyTree, UInt32

from mpfjax.mixture import flatten_states
from mpfjax.models.base import is_made_of_noise, model_name, require, with_inputs
from mpfjax.models.law import law_of, refuse_marginalised
from mpfjax.models.noise import normal_of, uniform_of
from mpfjax.models.series import Series
from mpfjax.operations.logarithms import default_float, exp, finite_max, log_sum_exp
from mpfjax.operations.random import bits, normal, split, uniform
from mpfjax.operations.stored import select_rows, take

# Paths of the pilot for each of the sample.
PILOT = 1 / 5
# The part of the pilot that stays effective from one power to the next, and the least growth of a
# power as an exponent of 2: priors up to 10 million times as wide as the likelihood.
LEAST_PART, LEAST_GROWTH = 0.8, -48.0
# Draws of x_t that are proposed before each power of y_t, and the transitions that proposals of x_0
# may take there: one takes t.
STEP_MOVES, PATH_STEPS = 6, 12
# The part of the moves of x_0 that are walks; the others add a difference of two of the pilot. The
# least part of a standard deviation of x_0 in a walk.
PART_OF_WALKS, LEAST_SIZE = 0.4, 2.0**-8


class _Paths(NamedTuple):
    initial: PyTree  # x_0, or the noise that it is made of
    keys: UInt32[Array, "n steps 2"]  # the words of each draw's key
    previous: PyTree  # x_{t-1}
    states: PyTree  # x_t
    log_past: Float[Array, " n"]  # log p(x_0) L(y_1..y_{t-1})
    log_likelihood: Float[Array, " n"]  # log L(y_t)

    def before_next(self) -> "_Paths":
        """The paths before x_{t+1} is drawn and weighed."""
        log_past = self.log_past + self.log_likelihood
        zeros = jnp.zeros_like(log_past)
        return self._replace(previous=self.states, log_past=log_past, log_likelihood=zeros)


def check_initial_density(model: Any, needed_by: str) -> None:
    """Raise a `ValueError` for a model whose x_0 cannot be moved."""
    refuse_marginalised(model, needed_by, "start from a mixture of your own")
    if is_made_of_noise(model, "initial"):
        return
    require(model, "log_initial", needed_by)
    states = jax.eval_shape(lambda key: model.sample_initial(key, 2), jax.random.key(0))
    for leaf in jax.tree.leaves(states):
        if not jnp.issubdtype(leaf.dtype, jnp.floating):
            which = f"has {leaf.dtype} in x_0, which {needed_by} cannot move"
            raise ValueError(f"model: {model_name(model)} {which}; define initial_from_noise")


def sample_window(
    key: Key[Array, ""], model: Any, window: Series, num_particles: int
) -> tuple[PyTree, Float[Array, " steps"]]:
    """N draws of p(x_L | y_1..y_L), and log p(y_s | y_1..y_{s-1}) of each step.

    The draws are equally weighted, and the product of the exponentials is unbiased.

    - `model`: without inputs; each step's model gets the window's.
    - `window`: the data of L steps, of which it is known which are `present`.

    Raises `ValueError` where derivatives are asked for.
    """
    floats, others = eqx.partition((model, window), eqx.is_inexact_array)
    model, window = eqx.combine(_constant(floats), others)
    sampler = _Sampler(model, window, num_particles)
    key_paths, key_steps = split(key, 2)
    steps = jnp.arange(window.length, dtype=jnp.int32), split(key_steps, window.length)
    paths, log_increments = jax.lax.scan(sampler.observe, sampler.first_paths(key_paths), steps)
    return jax.tree.map(lambda leaf: leaf[:num_particles], paths.states), log_increments


@jax.custom_jvp
def _constant(values: PyTree) -> PyTree:
    """Values whose derivatives would be wrong without notice: accepted moves have none."""
    return values


@_constant.defjvp
def _refuse(primals: Any, tangents: Any) -> Any:
    who = "with_initialisation and with_restarts"
    raise ValueError(f"filter: {who} have no derivatives in the model")


class _Sampler(NamedTuple):
    model: Any
    window: Series
    n: int  # of the sample; all further paths are of the pilot

    def first_paths(self, key: Key[Array, ""]) -> _Paths:
        """The paths before any observation."""
        key_initial, key_draws = split(key, 2)
        number = self.n + max(2, round(PILOT * self.n))
        if is_made_of_noise(self.model, "initial"):
            initial = normal(key_initial, (number, self.model.initial_noise_dimension))
        else:
            initial = law_of(self.model).sample_initial(key_initial, number)
        words = bits(key_draws, (2 * number * self.window.length,))
        return self.paths_from(initial, words.reshape(number, self.window.length, 2))

    def paths_from(self, initial: PyTree, keys: UInt32[Array, "n steps 2"]) -> _Paths:
        """Paths from these x_0, before any observation."""
        law = law_of(self.model)
        if is_made_of_noise(self.model, "initial"):
            states, log_prior = law.make_initial(initial), -0.5 * jnp.sum(initial**2, axis=1)
        else:
            states, log_prior = initial, law.log_initial(initial)
        log_prior = log_prior.astype(default_float())
        return _Paths(initial, keys, states, states, log_prior, jnp.zeros_like(log_prior))

    def advance(self, s: Int[Array, ""], paths: _Paths) -> _Paths:
        """The paths one step further, to the window's step s."""
        now = jax.tree.map(lambda leaf: leaf[s], self.window)
        law = law_of(with_inputs(self.model, now.inputs))

        def draw(words: UInt32[Array, "2"], state: PyTree) -> PyTree:
            alone = jax.tree.map(lambda leaf: leaf[None], state)
            drawn = law.draw(jax.random.wrap_key_data(words, impl="threefry2x32"), alone)
            return jax.tree.map(lambda leaf: leaf[0], drawn)

        states = jax.vmap(draw)(paths.keys[:, s], paths.states)
        values = jnp.where(now.present, law.log_likelihood(now.observations, states), 0.0)
        values = values.astype(paths.log_past.dtype)
        return paths.before_next()._replace(states=states, log_likelihood=values)

    def observe(
        self, paths: _Paths, step: tuple[Int[Array, ""], Key[Array, ""]]
    ) -> tuple[_Paths, Float[Array, ""]]:
        """The paths given the window's step s too, and its evidence."""
        (s, key), n, zero = step, self.n, jnp.zeros((), default_float())
        # The first move, at a power of zero, advances all of them.
        paths = paths.before_next()

        def temper(carry: tuple) -> tuple:
            key, paths, power, log_evidence = carry
            key, key_moves, key_sample, key_pilot = split(key, 4)
            paths = self.move(key_moves, paths, s, power)
            growth = _growth(paths.log_likelihood[n:], 1 - power)
            log_weights = growth * paths.log_likelihood
            log_evidence += log_sum_exp(log_weights[:n]) - np.log(n)
            sample = systematic_sample(key_sample, log_weights[:n], n)
            pilot = systematic_sample(key_pilot, log_weights[n:], log_weights.shape[0] - n)
            ancestors = jnp.concatenate([sample, n + pilot])
            paths = jax.tree.map(lambda leaf: take(leaf, ancestors), paths)
            return key, paths, power + growth, log_evidence

        first = key, paths, zero, zero
        _, paths, _, log_evidence = jax.lax.while_loop(lambda carry: carry[2] < 1, temper, first)
        return paths, log_evidence

    def move(
        self, key: Key[Array, ""], paths: _Paths, s: Int[Array, ""], power: Float[Array, ""]
    ) -> _Paths:
        """The paths after Metropolis steps: by other draws of x_s, and by another x_0.

        Steps of x_0 are walks of many sizes, another in each coordinate, and differences of any two
        of the pilot, which lead from mode to mode.
        """
        rows = flatten_states(paths.initial)
        (number, d), pilot = rows.shape, rows[self.n :]
        spreads = jnp.std(pilot, axis=0, keepdims=True)
        unravel = jax.vmap(ravel_pytree(jax.tree.map(lambda leaf: leaf[0], paths.initial))[1])

        def propose(words: UInt32[Array, "w n"], paths: _Paths, is_of_step: Array) -> _Paths:
            kind, *pair = uniform_of(words[2:5], pilot.dtype)
            one, other = (take(pilot, (len(pilot) * place).astype(jnp.int32)) for place in pair)
            sizes = spreads * LEAST_SIZE ** uniform_of(words[5 : 5 + d], pilot.dtype).T
            walk = sizes * normal_of(words[5 + d :], pilot.dtype).T
            steps = select_rows(kind < PART_OF_WALKS, walk, one - other)
            new = self.paths_from(unravel(flatten_states(paths.initial) + steps), paths.keys)
            redrawn = paths._replace(
                keys=paths.keys.at[:, s].set(words[:2].T),
                states=paths.previous,
                log_likelihood=new.log_likelihood,
            )
            return jax.tree.map(partial(jnp.where, is_of_step), redrawn, new)

        def log_target(paths: _Paths) -> Float[Array, " n"]:
            # A power of zero admits any likelihood, also none.
            return paths.log_past + jnp.where(power > 0, power * paths.log_likelihood, 0.0)

        def step(i: Int[Array, ""], paths: _Paths) -> _Paths:
            words = bits(split(key, STEP_MOVES + PATH_STEPS)[i], (6 + 2 * d, number))
            is_of_step = i < STEP_MOVES
            first, new = jnp.where(is_of_step, s, 0), propose(words[1:], paths, is_of_step)
            new = jax.lax.fori_loop(first, s + 1, self.advance, new)
            log_ratio = log_target(new) - log_target(paths)
            is_accepted = jnp.log(uniform_of(words[0], log_ratio.dtype)) < log_ratio
            return select_rows(is_accepted, new, paths)

        num_steps = STEP_MOVES + jnp.maximum(PATH_STEPS // (s + 1), 1)
        return jax.lax.fori_loop(0, num_steps, step, paths)


def systematic_sample(
    key: Key[Array, ""], log_weights: Float[Array, " n"], number: int
) -> Int[Array, " number"]:
    """So many indices, a systematic sample by these weights.

    By a search, which compiles in a fraction of the time that `Resample` takes, and is run seldom.
    """
    n = log_weights.shape[0]
    # Without any weight all are alike.
    log_weights = jnp.where(jnp.max(log_weights) > -jnp.inf, log_weights, 0.0)
    weights = exp(log_weights - finite_max(log_weights))
    cumulative = jnp.cumsum(weights)
    ranks = jnp.arange(number, dtype=weights.dtype) + uniform(key, (), weights.dtype)
    indices = jnp.searchsorted(cumulative, ranks / number * cumulative[-1], side="right")
    # Rounding must not lead past the last particle of positive weight.
    last = jnp.max(jnp.where(weights > 0, jnp.arange(n, dtype=jnp.int32), 0))
    return jnp.minimum(indices.astype(jnp.int32), last)


def _growth(log_likelihood: Float[Array, " p"], rest: Float[Array, ""]) -> Float[Array, ""]:
    """The growth of the power, up to the `rest`, that leaves enough of the pilot effective.

    It is selected on a logarithmic scale, so that it is above zero however narrow the likelihood
    is. Paths without any likelihood are lost with the smallest power, and do not count.
    """
    below = log_likelihood - finite_max(log_likelihood)
    number = jnp.sum((log_likelihood > -jnp.inf).astype(log_likelihood.dtype))
    growths = rest * jnp.exp2(jnp.arange(LEAST_GROWTH, 1 / 8, 1 / 8))
    weights = exp(growths[:, None] * below[None])
    is_poor = jnp.sum(weights, axis=1) ** 2 < LEAST_PART * number * jnp.sum(weights**2, axis=1)
    return jnp.max(jnp.where(is_poor, growths[0], growths))
