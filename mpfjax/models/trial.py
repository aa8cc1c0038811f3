"""A model tried out before it is run, where what would go wrong without a word is said by name, and
series drawn from a model.
"""

from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key, PyTree

from mpfjax.checks import Count, checked
from mpfjax.models.base import (
    AbstractStateSpaceModel,
    check_log_density,
    check_moved,
    check_states,
    is_made_of_noise,
    model_name,
    require,
    require_noise,
    with_inputs,
)
from mpfjax.models.conditionally_linear import is_mixed, with_moments
from mpfjax.models.observations import one_input, one_observation, steps_of_inputs
from mpfjax.models.steps import drawn_part, likelihoods, log_transition, moved
from mpfjax.operations.compiling import jit_on_wide_vectors, with_floats_traced

_KEYS, _PLACES, _DRAWS = 64, 4, 32  # of the draws that must differ
_FAMILIES, _SIBLINGS = 8, 128  # of those that log_transition must know
# Of a right model, variances and errors are beyond these once in a million keys.
_MOST_RATIO, _MOST_ERRORS = 4.0, 5.0


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
      Given x_1 and some possible x_0, the one that it came from must be as likely as it says.

    The last two look at a few thousand random draws, of x_0 and of the first two steps: they accept
    a right model, and may accept one that is wrong by a few percent. `inputs` are u_1.
    """
    inputs, observation = one_input(inputs, model), one_observation(observation)
    if is_made_of_noise(model):
        require_noise(model, "check_model")
    for fault in _faults(key, model, observation, inputs):
        raise ValueError(f"model: {model_name(model)}.{fault}")


def _faults(key: Key[Array, ""], model: Any, observation: PyTree, inputs: PyTree) -> Iterator[str]:
    """What is wrong with the model's methods, one after the other, by their names."""
    keys = jax.random.split(key, 5)
    yield from _of_draws("sample_initial", keys[0], lambda key: _initial(key, model, _DRAWS))
    if callable(getattr(model, "log_initial", None)):
        values = model.log_initial(model.sample_initial(key, _DRAWS))
        if not np.isfinite(check_log_density(values, model, "log_initial", _DRAWS)).all():
            yield "log_initial is NaN or infinite at draws of sample_initial"
    starts = jax.jit(lambda: _initial(keys[1], model, _FAMILIES))()
    model = with_inputs(model, inputs)
    copies = jax.tree.map(lambda leaf: jnp.repeat(leaf, _DRAWS, axis=0), starts)
    same = jax.tree.map(lambda leaf: leaf[: _PLACES * _DRAWS], copies)
    yield from _of_draws("sample_transition", keys[2], lambda key: moved(key, model, same))
    yield from _of_likelihood(keys[3], model, observation, copies)
    if is_mixed(model) or callable(getattr(model, "log_transition", None)):
        yield from _of_transition(keys[4], model, starts)


def _initial(key: Key[Array, ""], model: Any, number: int) -> PyTree:
    drawn = model.sample_initial(key, number)
    check_states(drawn, model, "sample_initial", number)
    return with_moments(model, drawn)


def _of_draws(
    method: str, key: Key[Array, ""], draw: Callable[[Key[Array, ""]], PyTree]
) -> Iterator[str]:
    """Faults of draws for many keys, of particles of a few places side by side.

    Their mean must not vary more than that of independent ones.
    """
    for column in _columns(jax.jit(jax.vmap(draw))(jax.random.split(key, _KEYS))):
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


def _of_likelihood(
    key: Key[Array, ""], model: Any, observation: PyTree, starts: PyTree
) -> Iterator[str]:
    """Faults of log L of draws of x_1."""
    states = jax.jit(lambda: moved(key, model, starts))()
    density = jax.jit(lambda states: likelihoods(model, observation, states))
    values, half = np.asarray(density(states), float), _FAMILIES * _DRAWS // 2
    others = np.asarray(density(jax.tree.map(lambda leaf: leaf[half:], states)), float)
    if not (values < np.inf).all():
        yield "log_likelihood is NaN or +inf at a draw of x_1"
    if not np.allclose(values[half:], others, rtol=1e-3, atol=1e-3):
        yield "log_likelihood of a particle depends on the other particles"
    if (values == -np.inf).all():
        yield f"log_likelihood is -inf at all {len(values)} draws of x_1: no particle explains it"


def _of_transition(key: Key[Array, ""], model: Any, states: PyTree) -> Iterator[str]:
    """Faults of log D of a draw given its own x_{t-1}, beside that given its siblings."""
    key_parents, key_children = jax.random.split(key)
    rows, columns = np.divmod(np.arange(_SIBLINGS**2), _SIBLINGS)

    def of_family(keys: Key[Array, "2"], state: PyTree) -> tuple[Float[Array, "s s"], PyTree]:
        one = jax.tree.map(lambda leaf: jnp.repeat(leaf[None], _SIBLINGS, axis=0), state)
        parents = moved(keys[0], model, one)
        children = moved(keys[1], model, parents)
        pair = [jax.tree.map(lambda leaf: leaf[rows], drawn_part(model, children))]
        pair += [jax.tree.map(lambda leaf: leaf[columns], parents)]
        return log_transition(model, *pair).reshape(_SIBLINGS, _SIBLINGS), parents

    keys = [jax.random.split(key, _FAMILIES) for key in (key_parents, key_children)]
    of_each = lambda pair: of_family(*pair)  # noqa: E731
    found = jax.jit(lambda: jax.lax.map(of_each, (jnp.stack(keys, 1), states)))()
    logs, parents = np.asarray(found[0], float), found[1]
    if np.isnan(logs).any() or not np.isfinite(np.diagonal(logs, axis1=1, axis2=2)).all():
        yield "log_transition is NaN, or infinite at a draw of sample_transition"
    shares = np.exp(logs - logs.max(axis=2, keepdims=True))
    shares /= shares.sum(axis=2, keepdims=True)
    values = [("log D", np.where(shares > 0, logs, 0.0))]
    values += [("x_(t-1)", np.tile(x[:, None], (1, _SIBLINGS, 1))) for x in _columns(parents)]
    for what, of_siblings in values:
        # Where the shares are right, the expectation of the own value is theirs.
        own = np.diagonal(of_siblings, axis1=1, axis2=2)
        excess = own - np.sum(shares * of_siblings, axis=2)
        mean, error = excess.mean(), excess.std() / np.sqrt(excess.size)
        if abs(mean) > _MOST_ERRORS * error + 1e-3 * own.std():
            yield (
                "log_transition is not the density of sample_transition: given the x_(t-1) that"
                f" draws come from, {what} is {mean:.2g} ± {error:.2g} above what it says; does a"
                " factor that depends on x_(t-1) lack?"
            )


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
        seen = at_step.sample_observation(key_observation, moved)
        check_states(seen, model, "sample_observation", 1)
        return moved, jax.tree.map(lambda leaf: leaf[0], (moved, seen))

    return jax.lax.scan(advance, state, (jax.random.split(key, num_steps), inputs))[1]
