"""Models inside moves: a filter's own is stored once, and all of them are given their inputs."""

from typing import Any

import equinox as eqx
import jax
from jaxtyping import PyTree

from mpfjax.models.base import AbstractStateSpaceModel
from mpfjax.models.inputs import with_inputs


class _Tied(eqx.Module):
    """Stands in a move where the filter's own model belongs, so that it is stored only once."""


def tie(moves: tuple[Any, ...], model: Any) -> tuple[Any, ...]:
    """The moves without the filter's own model."""
    is_model = lambda node: node is model  # noqa: E731
    return jax.tree.map(lambda node: _Tied() if node is model else node, moves, is_leaf=is_model)


def untie(moves: tuple[Any, ...], model: Any) -> tuple[Any, ...]:
    """The moves with the filter's own model in its places."""
    is_tied = lambda node: isinstance(node, _Tied)  # noqa: E731
    return jax.tree.map(lambda node: model if is_tied(node) else node, moves, is_leaf=is_tied)


def give_inputs(tree: PyTree, model: Any, inputs: PyTree) -> PyTree:
    """The tree with u_t in `model`, and in every other model; None leaves it as it is."""
    if inputs is None:
        return tree
    is_model = lambda node: node is model or isinstance(node, AbstractStateSpaceModel)  # noqa: E731
    give = lambda node: with_inputs(node, inputs) if is_model(node) else node  # noqa: E731
    return jax.tree.map(give, tree, is_leaf=is_model)
