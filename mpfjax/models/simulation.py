"""Series drawn from a model: states and observations."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Key, PyTree

from mpfjax.checks import as_numbers, check_key, check_whole, shown
from mpfjax.models.base import check_moved, check_states, model_name, require
from mpfjax.models.inputs import saying_that_none_were_given, takes_inputs, with_inputs
from mpfjax.operations.compiling import jit_on_wide_vectors, with_floats_traced


def simulate(
    key: Key[Array, ""], model: Any, num_steps: int, inputs: PyTree = None
) -> tuple[PyTree, PyTree]:
    """`AbstractStateSpaceModel.simulate`."""
    check_key(key)
    check_whole(num_steps=num_steps)
    require(model, "sample_observation", "simulate")
    if inputs is not None and not takes_inputs(model):
        raise ValueError(f"inputs: {model_name(model)} has no place for them, a field inputs")
    inputs = jax.tree.map(lambda leaf: as_numbers("inputs", leaf), inputs)
    for leaf in jax.tree.leaves(inputs):
        if leaf.shape[:1] != (num_steps,):
            raise ValueError(
                f"inputs: the leading axis of a leaf of shape {leaf.shape} is not num_steps,"
                f" {num_steps}"
            )
    with saying_that_none_were_given(model):
        return with_floats_traced(lambda model: _simulate(key, model, num_steps, inputs), model)


@jit_on_wide_vectors
def _simulate(key, model, num_steps, inputs):
    key_initial, key_steps = jax.random.split(key)
    initial = model.sample_initial(key_initial, 1)
    check_states(initial, model, "sample_initial", 1)

    def advance(state: PyTree, step: tuple[Array, PyTree]) -> tuple[PyTree, tuple[PyTree, PyTree]]:
        step_key, now = step
        key_state, key_observation = jax.random.split(step_key)
        at_step = with_inputs(model, now)
        moved = at_step.sample_transition(key_state, state)
        check_moved(moved, state, model)
        seen = at_step.sample_observation(key_observation, moved)
        _check_observations(seen, model)
        return moved, (moved, seen)

    steps = (jax.random.split(key_steps, num_steps), inputs)
    _, (states, observations) = jax.lax.scan(advance, initial, steps)
    first = lambda leaf: leaf[:, 0]  # noqa: E731
    states = jax.tree.map(
        lambda start, later: first(jnp.concatenate([start[None], later])), initial, states
    )
    return states, jax.tree.map(first, observations)


def _check_observations(observations: Any, model: Any) -> None:
    """Raise a `ValueError` for anything but one observation of the one state."""
    leaves = jax.tree.leaves(observations)
    who = f"model: {model_name(model)}.sample_observation returned"
    if not leaves:
        raise ValueError(f"{who} {shown(observations)}, which holds no array")
    for leaf in leaves:
        if jnp.shape(leaf)[:1] != (1,):
            raise ValueError(
                f"{who} an array of shape {jnp.shape(leaf)}; its leading axis is not the number of"
                " states, 1"
            )
