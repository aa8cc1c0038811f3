"""The data of each step: observations, which of them are missing, and known inputs."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, PyTree

from mpfjax.checks import as_numbers, check_one_of
from mpfjax.models.base import model_name
from mpfjax.models.inputs import takes_inputs


class Series(eqx.Module):
    """What a filter is given at the steps 1, ..., t; every leaf has a leading axis t."""

    observations: PyTree
    """y_1, ..., y_t."""
    present: Bool[Array, " t"] | None = None
    """which observations are there; None is all of them."""
    inputs: PyTree = None
    """u_1, ..., u_t; None where the model knows none."""

    @property
    def length(self) -> int:
        """t."""
        return jax.tree.leaves(self.observations)[0].shape[0]


def as_series(observations: PyTree, inputs: PyTree, missing: str, model: Any) -> Series:
    """The observations and inputs as arrays; a `ValueError` for data that cannot be run.

    A step with a missing y_t still has its u_t: inputs are always finite numbers.
    """
    present = present_steps(observations, missing, model)
    series = Series(as_arrays(observations), present)
    return Series(series.observations, present, steps_of_inputs(inputs, series.length, model))


def steps_of_inputs(
    inputs: PyTree, length: int, model: Any, of_what: str = "observations"
) -> PyTree:
    """u_1, ..., u_t as arrays; a `ValueError` unless they are finite numbers, one for each step."""
    if inputs is None:
        return None
    _require_place_for(inputs, model)
    arrays = as_arrays(inputs, "inputs")
    leaves = jax.tree.leaves(arrays)
    own_length = _length(leaves, inputs, "inputs")
    if own_length != length:
        raise ValueError(
            f"inputs: the leading axis t is {own_length}, and that of the {of_what} is {length}"
        )
    known = [leaf for leaf in leaves if not isinstance(leaf, Tracer) and _is_inexact(leaf)]
    for usable in _each_step(np, _usable(np, known, False), "all"):
        if not usable.all():
            raise ValueError(
                f"inputs: NaN or infinite at index {int(np.argmin(usable))} of the leading axis"
            )
    # Under the caller's jit no value can be named: the check runs with the program.
    check = lambda leaf: checked_inputs(leaf) if isinstance(leaf, Tracer) else leaf  # noqa: E731
    return jax.tree.map(check, arrays)


def one_input(inputs: PyTree, model: Any) -> PyTree:
    """The arrays of u_t; a `ValueError` for anything but numbers, or a model without inputs."""
    if inputs is None:
        return None
    _require_place_for(inputs, model)
    if not jax.tree.leaves(inputs):
        raise ValueError("inputs: there are none")
    return as_arrays(inputs, "inputs")


def checked_inputs(inputs: PyTree) -> PyTree:
    """The inputs; an error at run time for a NaN or an infinity."""

    def check(leaf: Any) -> Any:
        if not _is_inexact(leaf):
            return leaf
        return eqx.error_if(leaf, ~jnp.all(jnp.isfinite(leaf)), "inputs: NaN or infinite")

    return jax.tree.map(check, inputs)


def _require_place_for(inputs: PyTree, model: Any) -> None:
    if not takes_inputs(model):
        raise ValueError(
            f"inputs: {model_name(model)} has no place for them; declare a field"
            " `inputs: PyTree = None`, which is then u_t at each step, or define with_inputs"
        )


def as_arrays(observations: PyTree, name: str = "observations") -> PyTree:
    """The observations as arrays of numbers that JAX takes as they are."""
    return jax.tree.map(lambda leaf: as_numbers(name, leaf), observations)


def one_observation(observation: PyTree) -> PyTree:
    """The arrays of y_t; a `ValueError` for none, anything but numbers, and too large ones."""
    if not jax.tree.leaves(observation):
        raise ValueError("observation: there is none; use predict to skip it")
    return as_arrays(observation, "observation")


class Fault(eqx.Module):
    """Whether a program met a fault for which `raise_faults` is to raise, and which."""

    found: Bool[Array, "*runs"]
    message: str = eqx.field(static=True)


def faults_of(model: Any, observation: PyTree, inputs: PyTree) -> tuple[Fault, ...]:
    """Whether y_t or u_t holds a number that the model does not take."""
    takes_nan = getattr(model, "handles_missing", False)
    what = "infinite" if takes_nan else "NaN or infinite"
    faults = []
    for tree, may_be_nan, message in (
        (observation, takes_nan, f"observation: {what}; use predict to skip it"),
        (inputs, False, "inputs: NaN or infinite"),
    ):
        inexact = [leaf for leaf in jax.tree.leaves(tree) if _is_inexact(leaf)]
        if inexact:
            usable = [jnp.all(part) for part in _usable(jnp, inexact, may_be_nan)]
            faults.append(Fault(~jnp.all(jnp.stack(usable)), message))
    return tuple(faults)


def raise_faults(value: PyTree, faults: tuple[Fault, ...]) -> PyTree:
    """`value`, or a RuntimeError for the first of the faults that was found in any run.

    A program that raises errors itself calls back into Python, and such a program cannot be kept
    for the next process. It therefore returns its faults, which are checked after it has ended.
    Under the caller's own jit the error is raised while the program runs.
    """
    for fault in faults:
        if isinstance(fault.found, Tracer):
            value = eqx.error_if(value, fault.found, fault.message)
        elif np.any(fault.found):
            eqx.error_if(fault.found, fault.found, fault.message)
    return value


def check_series(observations: PyTree, missing: str) -> list[Any]:
    """The arrays of y_1..y_t; a `ValueError` for data that no model can be run on."""
    check_one_of(("error", "skip"), missing=missing)
    leaves = jax.tree.leaves(as_arrays(observations))
    _length(leaves, observations, "observations")
    return leaves


def present_steps(observations: PyTree, missing: str, model: Any) -> Bool[Array, " t"] | None:
    """Which observations are there, or None where all are; raises for data that cannot be run.

    For a `model` with `handles_missing`, a NaN is a missing number, and a step is missing only if
    all its numbers are.
    """
    leaves = check_series(observations, missing)
    inexact = [leaf for leaf in leaves if _is_inexact(leaf)]
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


def _length(leaves: list[Any], tree: PyTree, name: str) -> int:
    """t, the length of the leading axis that all leaves share; a `ValueError` without one."""
    if not leaves:
        raise ValueError(f"{name}: there are none")
    lengths = {leaf.shape[0] for leaf in leaves if leaf.ndim}
    if len(lengths) != 1 or not all(leaf.ndim for leaf in leaves):
        shapes = [leaf.shape for leaf in leaves]
        is_list = isinstance(tree, list | tuple)
        hint = f"; a list is so many arrays, jnp.asarray({name}) is one" if is_list else ""
        raise ValueError(f"{name}: shapes {shapes} do not share a leading axis t{hint}")
    if lengths == {0}:
        raise ValueError(f"{name}: the leading axis t is empty")
    return lengths.pop()


def _is_inexact(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jnp.inexact)


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
