"""Series drawn from a model: states and observations."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Key, PyTree

from mpfjax.checks import Count, checked
from mpfjax.models.base import (
    AbstractStateSpaceModel,
    asking,
    check_moved,
    check_states,
    require,
    with_inputs,
)
from mpfjax.models.series import steps_of_inputs
from mpfjax.operations.compiling import jit_on_wide_vectors, with_floats_traced


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
        with asking(at_step, "sample_transition"):
            moved = at_step.sample_transition(key_state, state)
        check_moved(moved, state, model)
        with asking(at_step, "sample_observation"):
            observation = at_step.sample_observation(key_observation, moved)
        check_states(observation, model, "sample_observation", 1)
        return moved, jax.tree.map(lambda leaf: leaf[0], (moved, observation))

    return jax.lax.scan(advance, state, (jax.random.split(key, num_steps), inputs))[1]
