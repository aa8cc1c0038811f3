"""The observations that a user gives: arrays of finite numbers, and which steps are missing."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, PyTree

from mpfjax.checks import as_numbers, check_one_of


def as_arrays(observations: PyTree, name: str = "observations") -> PyTree:
    """The observations as arrays of numbers that JAX takes as they are."""
    return jax.tree.map(lambda leaf: as_numbers(name, leaf), observations)


def one_observation(observation: PyTree) -> PyTree:
    """The arrays of y_t; a `ValueError` for none, for what is no number, and for too large ones."""
    if not jax.tree.leaves(observation):
        raise ValueError("observation: there is none; use predict to skip it")
    return as_arrays(observation, "observation")


def checked_observation(observation: PyTree, model: Any) -> PyTree:
    """y_t; an error at run time if it holds a number that the model does not take."""
    takes_nan = getattr(model, "handles_missing", False)
    what = "infinite" if takes_nan else "NaN or infinite"

    def check(leaf: Array) -> Array:
        if not jnp.issubdtype(leaf.dtype, jnp.inexact):
            return leaf
        (usable,) = _usable(jnp, [leaf], takes_nan)
        return eqx.error_if(leaf, ~jnp.all(usable), f"observation: {what}; use predict to skip it")

    return jax.tree.map(check, observation)


def check_series(observations: PyTree, missing: str) -> list[Any]:
    """The arrays of y_1..y_t; a `ValueError` for what no model can be run on."""
    check_one_of(("error", "skip"), missing=missing)
    leaves = jax.tree.leaves(as_arrays(observations))
    if not leaves:
        raise ValueError("observations: there are none")
    lengths = {leaf.shape[0] if leaf.ndim else None for leaf in leaves}
    if len(lengths) > 1 or None in lengths:
        shapes = [leaf.shape for leaf in leaves]
        is_list = isinstance(observations, list | tuple)
        hint = "; a list is so many arrays, jnp.asarray(observations) is one" if is_list else ""
        raise ValueError(f"observations: shapes {shapes} do not share a leading axis t{hint}")
    if lengths == {0}:
        raise ValueError("observations: the leading axis t is empty")
    return leaves


def present_steps(observations: PyTree, missing: str, model: Any) -> Bool[Array, " t"] | None:
    """Which observations are there, or None where all are; raises for what cannot be run.

    For a `model` with `handles_missing`, a NaN is a missing number, and a step is missing only if
    all its numbers are.
    """
    leaves = check_series(observations, missing)
    inexact = [leaf for leaf in leaves if jnp.issubdtype(leaf.dtype, jnp.inexact)]
    if not inexact:
        return None
    takes_nan = getattr(model, "handles_missing", False)
    if any(isinstance(leaf, Tracer) for leaf in inexact):
        return _present_traced(inexact, missing, takes_nan)
    usable = np.logical_and.reduce(_each_step(np, _usable(np, inexact, takes_nan), "all"))
    if not usable.all() and (missing == "error" or takes_nan):
        what = "infinite" if takes_nan else "NaN or infinite"
        hint = "" if takes_nan else "; missing='skip' takes such steps as missing"
        raise ValueError(
            f"observations: {what} at index {int(np.argmin(usable))} of the leading axis{hint}"
        )
    present = usable
    if takes_nan and missing == "skip":
        whole = len(inexact) < len(leaves)  # a leaf of whole numbers is always there
        seen = [~np.isnan(leaf) for leaf in inexact]
        present = np.logical_or.reduce(_each_step(np, seen, "any")) | whole
    return None if present.all() else jnp.asarray(present)


def _usable(numpy: Any, leaves: list[Any], takes_nan: bool) -> list[Any]:
    """Which numbers may be handed to the model."""
    return [~numpy.isinf(leaf) if takes_nan else numpy.isfinite(leaf) for leaf in leaves]


def _each_step(numpy: Any, masks: list[Any], how: str) -> list[Any]:
    """For every leaf, whether all or any of a step's numbers are in the mask."""
    return [getattr(numpy, how)(mask.reshape(mask.shape[0], -1), axis=1) for mask in masks]


def _present_traced(leaves: list[Array], missing: str, takes_nan: bool) -> Bool[Array, " t"] | None:
    """Under the caller's jit no value can be named: the check runs with the program."""
    usable = jnp.stack(_each_step(jnp, _usable(jnp, leaves, takes_nan), "all")).all(axis=0)
    if takes_nan and missing == "skip":
        seen = jnp.stack(_each_step(jnp, [~jnp.isnan(leaf) for leaf in leaves], "any"))
        return eqx.error_if(seen.any(axis=0), ~usable, "observations: infinite")
    if missing == "skip":
        return usable
    return eqx.error_if(usable, ~usable, "observations: NaN or infinite")
