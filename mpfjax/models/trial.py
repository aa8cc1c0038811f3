"""A model tried out before it is run, where what would go wrong without a word is said by name, and
series drawn from a model.
"""

from collections.abc import Iterator
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Key, PyTree

from mpfjax.checks import Count, checked, warn
from mpfjax.models.base import (
    AbstractStateSpaceModel,
    check_moved,
    check_states,
    is_made_of_noise,
    model_name,
    real_each,
    require,
    require_noise,
    with_inputs,
)
from mpfjax.models.conditionally_linear import is_mixed, with_moments
from mpfjax.models.law import law_of
from mpfjax.models.observations import one_input, one_observation, steps_of_inputs
from mpfjax.operations.compiling import jit_on_wide_vectors, with_floats_traced

_KEYS, _PLACES, _DRAWS = 64, 4, 32  # of the draws that must differ
_FAMILIES, _SIBLINGS = 8, 128  # of those that log_transition must know
# Of a right model, variances are beyond this, and sums as improbable, once in a million keys.
_MOST_RATIO, _LEAST_CHANCE = 4.0, 1e-6


@checked
def check_model(
    key: Key[Array, ""],
    model: AbstractStateSpaceModel,
    observation: PyTree,
    *,
    inputs: PyTree = None,
) -> None:
    """Try a model out on one observation, y_1; a `ValueError` names the first fault found.

    Call it once for a model that you have written. It finds what a filter would not notice:

    - methods that are missing, and draws or densities of other shapes or types than they must have;
    - noise that particles share. One key serves all particles: `jax.random.normal(key)`, without
      their number in its shape, moves all of them alike;
    - draws that are the same for every key;
    - a draw, or a density at a draw of the model, that is NaN; a likelihood that is zero for all
      particles; a density of a particle that depends on the other particles;
    - a `log_transition` that is not the density of `sample_transition`, but for a constant factor.
      A draw of x_1 comes from one of some possible x_0. By the density each of these has a
      probability to be its origin, and the true origin must be as probable as that, in the mean.

    The last two look at a few thousand random draws, of x_0 and of the first two steps: they accept
    a right model, and may accept one that is wrong by a few percent, or in what seldom happens.
    `inputs` are u_1. A `UserWarning` says where a density has a derivative of NaN by the model's
    numbers, so that they cannot be tuned by gradient; with `handles_missing`, also where the first
    number of y_1 is missing.
    """
    inputs, observation = one_input(inputs, model), one_observation(observation)
    if is_made_of_noise(model):
        require_noise(model, "check_model")
    for fault in _faults(key, model, observation, inputs):
        raise ValueError(f"model: {model_name(model)}.{fault}")


def _faults(key: Key[Array, ""], model: Any, observation: PyTree, inputs: PyTree) -> Iterator[str]:
    """What is wrong with the model's methods, one after the other, by their names."""
    keys = jax.random.split(key, 5)
    many = jax.vmap(partial(jax.random.split, num=_KEYS))(keys)
    yield from _of_draws("sample_initial", _many_initial(many[0], model, _DRAWS))
    if callable(getattr(model, "log_initial", None)):
        values = model.log_initial(model.sample_initial(key, _DRAWS))
        if not np.isfinite(real_each(values, _DRAWS, model, "log_initial")).all():
            yield "log_initial is NaN or infinite at draws of sample_initial"
    starts = _places(keys[1], model, _FAMILIES)
    model = with_inputs(model, inputs)
    copies = jax.tree.map(lambda leaf: jnp.repeat(leaf, _DRAWS, axis=0), starts)
    same = jax.tree.map(lambda leaf: leaf[: _PLACES * _DRAWS], copies)
    yield from _of_draws("sample_transition", _many_moved(many[2], model, same))
    states = _moved(keys[3], model, copies)
    yield from _of_likelihood(model, observation, states)
    if is_mixed(model) or callable(getattr(model, "log_transition", None)):
        logs, parents = _of_families(keys[4], model, starts)
        yield from _of_transition(np.asarray(logs, float), _columns(parents))


def _initial(key: Key[Array, ""], model: Any, number: int) -> PyTree:
    drawn = model.sample_initial(key, number)
    check_states(drawn, model, "sample_initial", number)
    return with_moments(model, drawn)


_for_each_key = partial(eqx.filter_vmap, in_axes=(0, None, None))
_places, _many_initial = eqx.filter_jit(_initial), eqx.filter_jit(_for_each_key(_initial))


def _move(key: Key[Array, ""], model: Any, states: PyTree) -> PyTree:
    return law_of(model).move(key, states)


_moved, _many_moved = eqx.filter_jit(_move), eqx.filter_jit(_for_each_key(_move))


@eqx.filter_jit
def _likelihoods(model: Any, observation: PyTree, states: PyTree) -> Float[Array, " n"]:
    return law_of(model).log_likelihood(observation, states)


def _of_draws(method: str, draws: PyTree) -> Iterator[str]:
    """Faults of draws for many keys, of particles of a few places side by side.

    Their mean must not vary more than that of independent ones.
    """
    for column in _columns(draws):
        by_place = column.reshape(_KEYS, -1, _DRAWS)
        if np.isnan(column).any():
            yield f"{method} draws NaN"
        is_same = (column == column[:1]).all() and (by_place != by_place[:, :, :1]).any()
        if is_same and method == "sample_transition":
            yield f"{method} gives the same draws for every key; draw with the key that it is given"
        of_means = by_place.mean(axis=2).var(axis=0, ddof=1).mean()
        expected = by_place.var(axis=2, ddof=1).mean() / _DRAWS
        rounding = (1e-5 * np.abs(column).max()) ** 2
        if of_means > _MOST_RATIO * expected + rounding:
            yield (
                f"{method} draws noise that particles share; one key serves all of them, so that"
                " the shape of what is drawn must begin with their number, as"
                " jax.random.normal(key, states.shape) does"
            )


def _columns(draws: PyTree) -> list[np.ndarray]:
    """Each number of the state, (keys, particles)."""
    leaves = [np.asarray(leaf, float) for leaf in jax.tree.leaves(draws)]
    rows = [leaf.reshape(*leaf.shape[:2], -1) for leaf in leaves]
    return [row[:, :, k] for row in rows for k in range(row.shape[2])]


def _of_likelihood(model: Any, observation: PyTree, states: PyTree) -> Iterator[str]:
    """Faults of log L of draws of x_1."""
    values, half = _likelihoods(model, observation, states), _FAMILIES * _DRAWS // 2
    others = _likelihoods(model, observation, jax.tree.map(lambda leaf: leaf[half:], states))
    values, others = np.asarray(values, float), np.asarray(others, float)
    if not (values < np.inf).all():
        yield "log_likelihood is NaN or +inf at a draw of x_1"
    if not np.allclose(values[half:], others, rtol=1e-3, atol=1e-3):
        yield "log_likelihood of a particle depends on the other particles"
    if (values == -np.inf).all():
        yield f"log_likelihood is -inf at all {len(values)} draws of x_1: no particle explains it"
    _warn_of_derivative(model, observation, states)
    if getattr(model, "handles_missing", False):
        partly = _with_first_missing(observation)
        if partly is not None:
            if np.isnan(_likelihoods(model, partly, states)).any():
                yield "log_likelihood is NaN where a number is missing, despite handles_missing"
            hint = "; blank it before it is used: y = jnp.where(jnp.isnan(y), 0.0, y)"
            _warn_of_derivative(model, partly, states, f" where a number is missing{hint}")


def _with_first_missing(observation: PyTree) -> PyTree:
    """y without its first floating point number; None if it has no other."""
    floats, others = eqx.partition(observation, eqx.is_inexact_array)
    numbers, unravel = ravel_pytree(floats)
    if len(numbers) < 2:
        return None
    return eqx.combine(unravel(numbers.at[0].set(jnp.nan)), others)


def _warn_of_derivative(model: Any, observation: PyTree, states: PyTree, where: str = "") -> None:
    """A warning if log L has a derivative of NaN by the numbers of the model."""
    try:
        slopes = with_floats_traced(lambda traced: _derivative(traced, observation, states), model)
    except (TypeError, ValueError, NotImplementedError):
        # JAX has no derivative of it, as of a while loop in reverse (ValueError), of whole numbers
        # (TypeError) or of a call to the host (NotImplementedError). A filter needs none.
        return
    if any(np.isnan(slope).any() for slope in jax.tree.leaves(slopes)):
        message = f"{model_name(model)}.log_likelihood has a derivative of NaN{where}"
        warn(f"model: {message}", UserWarning)


@eqx.filter_jit
def _derivative(model, observation, states):
    def total(model: Any) -> Array:
        values = law_of(model).log_likelihood(observation, states)
        return jnp.sum(jnp.where(jnp.isfinite(values), values, 0.0))

    return eqx.filter_grad(total)(model)


@eqx.filter_jit
def _of_families(key, model, states):
    """log D of each draw given each of the siblings of its own x_{t-1}, (families, s, s)."""
    key_parents, key_children = jax.random.split(key)
    rows, columns = np.divmod(np.arange(_SIBLINGS**2), _SIBLINGS)

    def of_family(family: tuple[Key[Array, "2"], PyTree]) -> tuple[Float[Array, "s s"], PyTree]:
        keys, state = family
        one = jax.tree.map(lambda leaf: jnp.repeat(leaf[None], _SIBLINGS, axis=0), state)
        parents = law_of(model).move(keys[0], one)
        children = law_of(model).move(keys[1], parents)
        pair = [jax.tree.map(lambda leaf: leaf[rows], law_of(model).part(children))]
        pair += [jax.tree.map(lambda leaf: leaf[columns], parents)]
        return law_of(model).log_transition(*pair).reshape(_SIBLINGS, _SIBLINGS), parents

    keys = [jax.random.split(key, _FAMILIES) for key in (key_parents, key_children)]
    return jax.lax.map(of_family, (jnp.stack(keys, 1), states))


def _of_transition(
    logs: Float[np.ndarray, "f s s"], parents: list[Float[np.ndarray, "f s"]]
) -> Iterator[str]:
    """Faults of log D of a draw given its own x_{t-1}, beside that given its siblings."""
    if np.isnan(logs).any() or not np.isfinite(np.diagonal(logs, axis1=1, axis2=2)).all():
        yield "log_transition is NaN, or infinite at a draw of sample_transition"
    shares = np.exp(logs - logs.max(axis=2, keepdims=True))
    shares /= shares.sum(axis=2, keepdims=True)
    values = [("log D", np.where(shares > 0, logs, 0.0))]
    values += [("x_(t-1)", np.tile(x[:, None], (1, _SIBLINGS, 1))) for x in parents]
    for what, of_siblings in values:
        # Where the shares are right, the expectation of the own value is theirs.
        of_parent = np.diagonal(of_siblings, axis1=1, axis2=2)
        beside = of_siblings - np.sum(shares * of_siblings, axis=2, keepdims=True)
        excess = np.diagonal(beside, axis1=1, axis2=2).sum()
        deviation = np.sqrt(np.sum(shares * beside**2))
        beyond = abs(excess) - 1e-3 * of_parent.size * of_parent.std()
        if _log_chance(np.sign(excess) * beside, shares, beyond, deviation) < np.log(_LEAST_CHANCE):
            mean, error = excess / of_parent.size, deviation / of_parent.size
            yield (
                "log_transition is not the density of sample_transition: given the x_(t-1) that"
                f" draws come from, {what} is {mean:.2g} ± {error:.2g} above what it says; does a"
                " factor that depends on x_(t-1) lack?"
            )


def _log_chance(beside: np.ndarray, shares: np.ndarray, excess: float, deviation: float) -> float:
    """log of the most that a sum of values drawn by the shares is at least as large, by Chernoff.

    The bound holds for what seldom happens too, where a sum is far from normal.
    """
    if excess <= 4 * deviation:
        return 0.0
    if deviation == 0:
        return -np.inf
    slopes = np.geomspace(1e-4, 1e2, 41) / deviation
    with np.errstate(over="ignore"):
        bounds = [np.log(np.sum(shares * np.exp(k * beside), axis=2)).sum() for k in slopes]
    return float(np.min(np.asarray(bounds) - slopes * excess))


@checked
def simulate(
    key: Key[Array, ""], model: AbstractStateSpaceModel, num_steps: Count, *, inputs: PyTree = None
) -> tuple[PyTree, PyTree]:
    """Draw x_0, ..., x_t, leaves (t + 1, ...), and y_1, ..., y_t, leaves (t, ...), from a model.

    The model defines `sample_observation(key, states)`, y given each of n states; it raises
    `ValueError` otherwise, and for objects with an interaction, which weighs states and draws none.
    `inputs` are as for `run_filter`. Use it to test a filter on data whose states are known.
    """
    require(model, "sample_observation", "simulate")
    if getattr(model, "interaction", None) is not None:
        raise ValueError("interaction: a model with one gives weights, and cannot be simulated")
    inputs = steps_of_inputs(inputs, num_steps, model, "steps")
    return with_floats_traced(lambda model: _simulate(key, model, num_steps, inputs), model)


@jit_on_wide_vectors
def _simulate(key, model, num_steps, inputs):
    key_initial, key_steps = jax.random.split(key)
    initial = model.sample_initial(key_initial, 1)
    check_states(initial, model, "sample_initial", 1)
    states, observations = steps_ahead(key_steps, model, initial, num_steps, inputs)
    return jax.tree.map(lambda *parts: jnp.concatenate(parts), initial, states), observations


def steps_ahead(
    key: Key[Array, ""], model: Any, state: PyTree, num_steps: int, inputs: PyTree
) -> tuple[PyTree, PyTree]:
    """Draw the next states and observations from a state, leaves (1, ...): (k, ...) of each."""

    def advance(state: PyTree, step: tuple[Array, PyTree]) -> tuple[PyTree, tuple[PyTree, PyTree]]:
        step_key, now = step
        key_state, key_observation = jax.random.split(step_key)
        at_step = with_inputs(model, now)
        moved = at_step.sample_transition(key_state, state)
        check_moved(moved, state, model)
        observation = at_step.sample_observation(key_observation, moved)
        check_states(observation, model, "sample_observation", 1)
        return moved, jax.tree.map(lambda leaf: leaf[0], (moved, observation))

    return jax.lax.scan(advance, state, (jax.random.split(key, num_steps), inputs))[1]
