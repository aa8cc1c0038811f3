"""The data of one step: its observation and known input, as arrays that a model is given."""

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, PyTree

from mpfjax.checks import as_numbers
from mpfjax.models.base import model_name, takes_inputs
from mpfjax.models.law import law_of


def one_input(inputs: PyTree, model: Any) -> PyTree:
    """The arrays of u_t; a `ValueError` for numbers not finite, and a model without inputs."""
    if inputs is None:
        return None
    require_inputs(model)
    arrays = as_arrays(inputs, "inputs")
    return refuse_where(~_is_usable(arrays, NOT_FINITE), arrays, f"inputs: {NOT_FINITE}")


def require_inputs(model: Any) -> None:
    """Raise a `ValueError` for a model that u_t could not reach."""
    if not takes_inputs(model):
        place = "a field `inputs: PyTree = None`, nor with_inputs, where u_t would go"
        raise ValueError(f"inputs: {model_name(model)} has neither {place}")


def as_arrays(tree: PyTree, name: str) -> PyTree:
    """The data of a step as arrays of numbers that JAX takes as they are; `ValueError` for none."""
    if not jax.tree.leaves(tree):
        raise ValueError(f"{name}: there is none")
    return jax.tree.map(partial(as_numbers, name), tree)


def one_observation(observation: PyTree, model: Any = None) -> PyTree:
    """The arrays of y_t; a `ValueError` for none, anything but numbers, and what a model refuses.

    Under the caller's own jit, numbers are all NaN where the model refuses one of them.
    """
    arrays = as_arrays(observation, "observation")
    refused = "" if model is None else refusal_of(model)
    broken = ~_is_usable(arrays, refused)
    return refuse_where(broken, arrays, f"observation: {refused}", "; use predict to skip it")


def _is_usable(arrays: PyTree, refused: str) -> Any:
    """Whether all numbers of one step are."""
    one_step = jax.tree.map(lambda leaf: leaf[None], arrays)
    return steps_where(one_step, "all", USABLE[refused])[0]


# What of an observation or of inputs is refused; "" is nothing.
NOT_FINITE = "NaN or infinite"
USABLE: dict[str, Callable[[Any, Any], Any]] = {
    NOT_FINITE: lambda numpy, leaf: numpy.isfinite(leaf),
    "infinite": lambda numpy, leaf: ~numpy.isinf(leaf),
    "": lambda numpy, leaf: numpy.ones(leaf.shape, bool),
}


def refusal_of(model: Any) -> str:
    """What of an observation the model is not given: a Kalman filter takes NaN, but no infinity."""
    if not getattr(model, "handles_missing", False):
        return NOT_FINITE
    return "infinite" if not law_of(model).is_whole else ""


def numpy_for(*arrays: Any) -> Any:
    """NumPy, whose values can be looked at, or that of JAX where an array is traced."""
    return jnp if any(isinstance(array, Tracer) for array in arrays) else np


def steps_where(arrays: PyTree, combine: str, holds: Callable[[Any, Any], Any]) -> Any:
    """At which steps it holds for "all" of the numbers, or for "any"; for whole numbers always."""
    leaves = jax.tree.leaves(arrays)
    numpy = numpy_for(*leaves)
    rows = [
        getattr(holds(numpy, leaf).reshape(len(leaf), -1), combine)(axis=1)
        if is_inexact(leaf)
        else numpy.ones(len(leaf), bool)
        for leaf in leaves
    ]
    return getattr(numpy.stack(rows), combine)(axis=0)


def refuse_where(broken: Any, tree: PyTree, fault: str, hint: str = "") -> PyTree:
    """The tree; a `ValueError` where it is broken, that names the first of several steps.

    A program cannot raise. So within a caller's jit it goes on with NaN, see `spoil`.
    """
    if isinstance(broken, Tracer):
        return spoil(tree, broken)
    if broken.any():
        at = f" at index {int(np.argmax(broken))} of the leading axis" if broken.ndim else ""
        raise ValueError(f"{fault}{at}{hint}")
    return tree


def spoil(tree: PyTree, broken: Bool[Array, "..."]) -> PyTree:
    """The tree, with NaN for all its floating point numbers if anything is broken.

    NaN goes through to all results that depend on them, so that whoever called the program can see
    it. An error raised by the program itself would call back into Python: such a program runs on
    the platform alone for which it was compiled, and cannot be kept for the next process.
    """
    is_broken = jnp.any(broken)
    return jax.tree.map(
        lambda leaf: jnp.where(is_broken, jnp.nan, leaf) if eqx.is_inexact_array(leaf) else leaf,
        tree,
    )


def is_inexact(leaf: Any) -> bool:
    """Whether its numbers are floating point or complex ones."""
    return jnp.issubdtype(leaf.dtype, jnp.inexact)
