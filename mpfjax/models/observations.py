"""The data of each step: observations, which of them are missing, and known inputs."""

from collections.abc import Callable
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, PyTree

from mpfjax.checks import as_numbers, check, check_shape, warn
from mpfjax.models.base import innermost, model_name, takes_inputs
from mpfjax.models.law import law_of


class Series(eqx.Module):
    """The data of a filter at the steps 1, ..., t; every leaf has a leading axis t.

    Every function of observations accepts either the arrays of y_1, ..., y_t, all of them finite
    numbers, or a `Series`, which also contains the known inputs and marks missing observations. In
    `run_filter`, `monte_carlo` and `run_islands`, `inputs=` and `missing=` are short for it.
    """

    observations: PyTree
    """y_1, ..., y_t."""
    inputs: PyTree = None
    """u_1, ..., u_t, finite numbers, which the model finds in its field `inputs` at each step, also
    at one without an observation; None where the model knows none."""
    present: Bool[Array | np.ndarray, " t"] | None = eqx.field(default=None, kw_only=True)
    """which observations are there; at the others the filter only predicts. None is all of them."""
    skips_missing: bool = eqx.field(static=True, default=False, kw_only=True)
    """whether steps with a NaN or an infinity are missing, as `skipping` has it."""

    @classmethod
    def skipping(cls, observations: PyTree, inputs: PyTree = None) -> "Series":
        """Observations in which those with a NaN or an infinity are missing.

        A model with `handles_missing = True` receives both; for it, only a step with nothing but
        NaN is missing. For other models a RuntimeWarning counts the steps of which some numbers
        were present.
        """
        return cls(observations, inputs, skips_missing=True)

    @property
    def length(self) -> int:
        """t."""
        return jax.tree.leaves(self.observations)[0].shape[0]


def as_series(data: PyTree, model: Any) -> Series:
    """Observations, or a `Series`, as arrays; a `ValueError` for data that cannot be run.

    In the result `present` is known, and None if no observation is missing.
    """
    series = series_of(data)
    observations = as_arrays(series.observations)
    length = _length(observations, series.observations, "observations")
    present = present_steps(observations, series, refusal_of(model))
    return Series(observations, steps_of_inputs(series.inputs, length, model), present=present)


def series_of(data: PyTree, inputs: PyTree = None, missing: str = "error") -> Series:
    """The data as a `Series`, unchecked; `inputs` and `missing` are those of `run_filter`."""
    check(Literal["error", "skip"], missing=missing)
    if not isinstance(data, Series):
        return Series(data, inputs, skips_missing=missing == "skip")
    if inputs is not None or missing != "error":
        raise ValueError("observations: a Series itself contains inputs and marks what is missing")
    return data


def check_series(data: PyTree) -> None:
    """A `ValueError` for observations that no model can be run on."""
    observations = series_of(data).observations
    _length(as_arrays(observations), observations, "observations")


def steps_of_inputs(
    inputs: PyTree, length: int, model: Any, of_what: str = "observations"
) -> PyTree:
    """u_1, ..., u_t as arrays; a `ValueError` unless they are finite numbers, one for each step."""
    arrays = _inputs(inputs, model, in_time=True)
    if arrays is None:
        return None
    own_length = _length(arrays, inputs, "inputs")
    if own_length != length:
        raise ValueError(f"inputs: their t is {own_length}, and that of the {of_what} is {length}")
    usable = _steps_where(arrays, "all", _USABLE[NOT_FINITE])
    inspect = getattr(innermost(model), "check_inputs", None)
    if inspect is not None and not any(
        isinstance(leaf, Tracer) for leaf in jax.tree.leaves(arrays)
    ):
        inspect(arrays)
    return refuse_where(~usable, arrays, f"inputs: {NOT_FINITE}")


def one_input(inputs: PyTree, model: Any) -> PyTree:
    """The arrays of u_t; a `ValueError` for numbers not finite, and a model without inputs."""
    arrays = _inputs(inputs, model, in_time=False)
    if arrays is None:
        return None
    return refuse_where(~_is_usable(arrays, NOT_FINITE), arrays, f"inputs: {NOT_FINITE}")


def _inputs(inputs: PyTree, model: Any, in_time: bool) -> PyTree:
    if inputs is None:
        return None
    if not takes_inputs(model):
        place = "a field `inputs: PyTree = None`, nor with_inputs, where u_t would go"
        raise ValueError(f"inputs: {model_name(model)} has neither {place}")
    return as_arrays(inputs, "inputs", in_time)


def as_arrays(observations: PyTree, name: str = "observations", in_time: bool = True) -> PyTree:
    """The observations as arrays of numbers that JAX takes as they are; a `ValueError` for none."""
    if not jax.tree.leaves(observations):
        raise ValueError(f"{name}: there is none")
    return jax.tree.map(lambda leaf: as_numbers(name, leaf, in_time=in_time), observations)


def one_observation(observation: PyTree, model: Any = None) -> PyTree:
    """The arrays of y_t; a `ValueError` for none, anything but numbers, and what a model refuses.

    Under the caller's own jit, numbers are all NaN where the model refuses one of them.
    """
    arrays = as_arrays(observation, "observation", in_time=False)
    refused = "" if model is None else refusal_of(model)
    broken = ~_is_usable(arrays, refused)
    return refuse_where(broken, arrays, f"observation: {refused}", "; use predict to skip it")


def _is_usable(arrays: PyTree, refused: str) -> Any:
    """Whether all numbers of one step are."""
    one_step = jax.tree.map(lambda leaf: leaf[None], arrays)
    return _steps_where(one_step, "all", _USABLE[refused])[0]


def present_steps(observations: PyTree, series: Series, fault: str) -> Any:
    """Which observations are there, (t,), or None where all are; raises for data not to be run.

    A warning says how many steps are skipped of which some numbers are there.
    """
    usable, present = _steps_where(observations, "all", _USABLE[fault]), series.present
    numpy = numpy_for(usable, present)
    if present is not None:
        check_shape(f"{len(usable)}", present=present)
    present = numpy.ones(usable.shape, bool) if present is None else numpy.asarray(present, bool)
    if series.skips_missing:
        is_observed = usable
        if fault != NOT_FINITE:
            is_observed = _steps_where(observations, "any", lambda numpy, leaf: ~numpy.isnan(leaf))
        elif numpy is np:
            _warn_of_parts(observations, present & ~usable)
        present = present & is_observed
    hint = "; Series.skipping(observations) takes them as missing" * (fault == NOT_FINITE)
    present = refuse_where(present & ~usable, present, f"observations: {fault}", hint)
    return None if numpy is np and present.all() else jnp.asarray(present)


def with_gaps(observations: PyTree, present: Any) -> PyTree:
    """The observations with NaN for each number of a step that is not present.

    So data leave a `Series`: what stands there instead is never looked at. Whole numbers become
    floating point numbers.
    """
    if present is None:
        return observations
    numpy = numpy_for(*jax.tree.leaves(observations), present)

    def gap(leaf: Any) -> Any:
        leaf = leaf if _is_inexact(leaf) else leaf.astype(jnp.result_type(float))
        there = numpy.asarray(present).reshape(-1, *(1,) * (leaf.ndim - 1))
        return numpy.where(there, leaf, numpy.asarray(numpy.nan, leaf.dtype))

    return jax.tree.map(gap, observations)


def _warn_of_parts(observations: PyTree, skipped: Bool[np.ndarray, " t"]) -> None:
    inexact = [leaf for leaf in jax.tree.leaves(observations) if _is_inexact(leaf)]
    if inexact:
        some = _steps_where(inexact, "any", lambda numpy, leaf: numpy.isfinite(leaf))
        if (skipped & some).any():
            number = f"{(skipped & some).sum()} of {len(skipped)} steps"
            message = f"{number} are skipped for a NaN or infinity beside finite numbers"
            warn(f"observations: {message}; a model with handles_missing = True receives them")


# What of an observation or of inputs is refused; "" is nothing.
NOT_FINITE = "NaN or infinite"
_USABLE: dict[str, Callable[[Any, Any], Any]] = {
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


def _steps_where(arrays: PyTree, combine: str, holds: Callable[[Any, Any], Any]) -> Any:
    """At which steps it holds for "all" of the numbers, or for "any"; for whole numbers always."""
    leaves = jax.tree.leaves(arrays)
    numpy = numpy_for(*leaves)
    rows = [
        getattr(holds(numpy, leaf).reshape(len(leaf), -1), combine)(axis=1)
        if _is_inexact(leaf)
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


def _length(arrays: PyTree, tree: PyTree, name: str) -> int:
    """t, the length of the leading axis that all leaves share; a `ValueError` without one."""
    shapes = [leaf.shape for leaf in jax.tree.leaves(arrays)]
    lengths = {shape[:1] for shape in shapes}
    if len(lengths) != 1 or lengths & {(), (0,)}:
        hint = f"; a list is so many arrays, jnp.asarray({name}) is one"
        hint = hint if isinstance(tree, list | tuple) else ""
        raise ValueError(f"{name}: shapes {shapes} do not share a leading axis t > 0{hint}")
    return shapes[0][0]


def _is_inexact(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jnp.inexact)
