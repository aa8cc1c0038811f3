"""The observations that a user gives: arrays of finite numbers, and which steps are missing."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, PyTree

from mpfjax.checks import check_one_of, shown


def as_arrays(observations: PyTree) -> PyTree:
    """Python's numbers as arrays of JAX's own types, everything else as it is."""

    def convert(leaf: Any) -> Any:
        if isinstance(leaf, jax.Array | np.ndarray | np.generic):
            return leaf
        return jnp.asarray(np.asarray(leaf))

    return jax.tree.map(convert, observations)


def one_observation(observation: PyTree) -> PyTree:
    """The arrays of y_t; a `ValueError` for none, for what is no number, and for too large ones."""
    leaves = jax.tree.leaves(observation)
    if not leaves:
        raise ValueError("observation: there is none; use predict to skip it")
    _require_numbers(leaves, "observation")
    for leaf in leaves:
        if _is_plain(leaf):
            _require_fitting(np.asarray(leaf), "observation")
    return as_arrays(observation)


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


def check_series(observations: PyTree, missing: str) -> None:
    """Raise a `ValueError` for what no model can be run on: no numbers, or no common axis t."""
    check_one_of(("error", "skip"), missing=missing)
    leaves = jax.tree.leaves(observations)
    if not leaves:
        raise ValueError("observations: there are none")
    lengths = {jnp.shape(leaf)[0] if jnp.ndim(leaf) else None for leaf in leaves}
    if len(lengths) > 1 or None in lengths:
        shapes = [jnp.shape(leaf) for leaf in leaves]
        is_list = isinstance(observations, list | tuple)
        hint = "; a list is so many arrays, jnp.asarray(observations) is one" if is_list else ""
        raise ValueError(f"observations: shapes {shapes} do not share a leading axis t{hint}")
    if lengths == {0}:
        raise ValueError("observations: the leading axis t is empty")
    _require_numbers(leaves, "observations")


def present_steps(observations: PyTree, missing: str, model: Any) -> Bool[Array, " t"] | None:
    """Which observations are there, or None where all are; raises for what cannot be run.

    For a `model` with `handles_missing`, a NaN is a missing number, and a step is missing only if
    all its numbers are.
    """
    check_series(observations, missing)
    leaves = jax.tree.leaves(observations)
    inexact = [leaf for leaf in leaves if jnp.issubdtype(jnp.result_type(leaf), jnp.inexact)]
    if not inexact:
        return None
    takes_nan = getattr(model, "handles_missing", False)
    if any(isinstance(leaf, Tracer) for leaf in inexact):
        return _present_traced(inexact, missing, takes_nan)
    for leaf in inexact:
        _require_fitting(np.asarray(leaf), "observations")
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


def _require_numbers(leaves: list[Any], name: str) -> None:
    """Raise a `ValueError` for what is no number, and for complex ones.

    Without this check, the imaginary part would be dropped, at the latest in the density.
    """
    for leaf in leaves:
        dtype = leaf.dtype if hasattr(leaf, "dtype") else np.asarray(leaf).dtype
        if jnp.issubdtype(dtype, jnp.complexfloating):
            raise ValueError(
                f"{name}: {dtype} is complex; give the real and the imaginary part as two numbers"
            )
        if not (jnp.issubdtype(dtype, jnp.number) or jnp.issubdtype(dtype, jnp.bool_)):
            raise ValueError(f"{name}: {shown(leaf)} is no array of numbers")


def _is_plain(leaf: Any) -> bool:
    return not isinstance(leaf, jax.Array | jax.ShapeDtypeStruct)


def _require_fitting(leaf: np.ndarray, name: str) -> None:
    """Raise a `ValueError` for finite numbers that JAX's own type would make infinite."""
    dtype = jax.dtypes.canonicalize_dtype(leaf.dtype)
    if dtype == leaf.dtype:
        return
    with np.errstate(over="ignore"):
        lost = np.isfinite(leaf) & ~np.isfinite(leaf.astype(dtype))
    if lost.any():
        first = tuple(map(int, np.argwhere(lost)[0]))
        raise ValueError(
            f"{name}: {leaf[first]:g} at index {first if len(first) != 1 else first[0]} is more"
            f" than {dtype} holds; set jax_enable_x64, or choose other units"
        )


def _present_traced(leaves: list[Array], missing: str, takes_nan: bool) -> Bool[Array, " t"] | None:
    """Under the caller's jit no value can be named: the check runs with the program."""
    usable = jnp.stack(_each_step(jnp, _usable(jnp, leaves, takes_nan), "all")).all(axis=0)
    if takes_nan and missing == "skip":
        seen = jnp.stack(_each_step(jnp, [~jnp.isnan(leaf) for leaf in leaves], "any"))
        return eqx.error_if(seen.any(axis=0), ~usable, "observations: infinite")
    if missing == "skip":
        return usable
    return eqx.error_if(usable, ~usable, "observations: NaN or infinite")
