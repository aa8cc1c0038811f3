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
from mpfjax.models.base import model_name, takes_inputs
from mpfjax.models.conditionally_linear import is_marginalised


class Series(eqx.Module):
    """All that a filter is given at the steps 1, ..., t; every leaf has a leading axis t.

    Whatever takes observations takes either the arrays of y_1, ..., y_t, all of them finite
    numbers, or a `Series`, which also says what is known beside them and which are missing. In
    `run_filter` alone `inputs=` and `missing=` are short for it.
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
        """Observations of which those that hold a NaN or an infinity are missing.

        A model with `handles_missing = True` gets both; for it, only a step of nothing but NaN is
        missing. For others a RuntimeWarning counts the steps of which some numbers were there.
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
    series = gathered(data)
    observations = as_arrays(series.observations)
    length = _length(observations, series.observations, "observations")
    present = present_steps(observations, series, refused_by(model))
    return Series(observations, steps_of_inputs(series.inputs, length, model), present=present)


def gathered(data: PyTree, inputs: PyTree = None, missing: str = "error") -> Series:
    """The data as a `Series`, unchecked; `inputs` and `missing` are those of `run_filter`."""
    check(Literal["error", "skip"], missing=missing)
    if not isinstance(data, Series):
        return Series(data, inputs, skips_missing=missing == "skip")
    if inputs is not None or missing != "error":
        raise ValueError("observations: a Series says itself its inputs and what is missing")
    return data


def check_series(data: PyTree) -> None:
    """A `ValueError` for observations that no model can be run on."""
    observations = gathered(data).observations
    _length(as_arrays(observations), observations, "observations")


def steps_of_inputs(
    inputs: PyTree, length: int, model: Any, of_what: str = "observations"
) -> PyTree:
    """u_1, ..., u_t as arrays; a `ValueError` unless they are finite numbers, one for each step."""
    arrays = one_input(inputs, model, in_time=True)
    if arrays is None:
        return None
    own_length = _length(arrays, inputs, "inputs")
    if own_length != length:
        raise ValueError(f"inputs: their t is {own_length}, and that of the {of_what} is {length}")
    usable = _steps_where(arrays, "all", _USABLE[NOT_FINITE])
    return refused_where(~usable, arrays, f"inputs: {NOT_FINITE}")


def one_input(inputs: PyTree, model: Any, in_time: bool = False) -> PyTree:
    """The arrays of u_t; a `ValueError` for anything but numbers, or a model without inputs."""
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


def one_observation(observation: PyTree) -> PyTree:
    """The arrays of y_t; a `ValueError` for none, anything but numbers, and too large ones."""
    return as_arrays(observation, "observation", in_time=False)


class Fault(eqx.Module):
    """Whether a program met a fault for which `raise_faults` is to raise, and which."""

    found: Bool[Array, "*runs"]
    message: str = eqx.field(static=True)


def faults_of(model: Any, observation: PyTree, inputs: PyTree) -> tuple[Fault, ...]:
    """Whether y_t or u_t holds a number that the model does not take."""
    faults, told = [], "; use predict to skip it"
    for name, tree, refused, hint in (
        ("observation", observation, refused_by(model), told),
        ("inputs", inputs, NOT_FINITE, ""),
    ):
        inexact = [leaf for leaf in jax.tree.leaves(tree) if _is_inexact(leaf)]
        if inexact:
            usable = [jnp.all(_USABLE[refused](jnp, leaf)) for leaf in inexact]
            faults.append(Fault(~jnp.all(jnp.stack(usable)), f"{name}: {refused}{hint}"))
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


def present_steps(observations: PyTree, series: Series, refused: str) -> Any:
    """Which observations are there, (t,), or None where all are; raises for data not to be run.

    A warning says how many steps are skipped of which some numbers are there.
    """
    usable, present = _steps_where(observations, "all", _USABLE[refused]), series.present
    numpy: Any = jnp if any(isinstance(mask, Tracer) for mask in (usable, present)) else np
    if present is not None:
        check_shape(f"{len(usable)}", present=present)
    present = numpy.ones(usable.shape, bool) if present is None else numpy.asarray(present, bool)
    if series.skips_missing:
        seen = usable
        if refused != NOT_FINITE:
            seen = _steps_where(observations, "any", lambda numpy, leaf: ~numpy.isnan(leaf))
        elif numpy is np:
            _warn_of_parts(observations, present & ~usable)
        present = present & seen
    hint = "; Series.skipping(observations) takes them as missing" * (refused == NOT_FINITE)
    present = refused_where(present & ~usable, present, f"observations: {refused}", hint)
    return None if numpy is np and present.all() else jnp.asarray(present)


def _warn_of_parts(observations: PyTree, skipped: Bool[np.ndarray, " t"]) -> None:
    inexact = [leaf for leaf in jax.tree.leaves(observations) if _is_inexact(leaf)]
    if inexact:
        some = _steps_where(inexact, "any", lambda numpy, leaf: numpy.isfinite(leaf))
        if (skipped & some).any():
            number = f"{(skipped & some).sum()} of {len(skipped)} steps"
            said = f"{number} are skipped for a NaN or infinity beside finite numbers"
            warn(f"observations: {said}; a model with handles_missing = True is given them")


# What of an observation or of inputs is refused; "" is nothing.
NOT_FINITE = "NaN or infinite"
_USABLE: dict[str, Callable[[Any, Any], Any]] = {
    NOT_FINITE: lambda numpy, leaf: numpy.isfinite(leaf),
    "infinite": lambda numpy, leaf: ~numpy.isinf(leaf),
    "": lambda numpy, leaf: numpy.ones(leaf.shape, bool),
}


def refused_by(model: Any) -> str:
    """What of an observation the model is not given: a Kalman filter takes NaN, but no infinity."""
    if not getattr(model, "handles_missing", False):
        return NOT_FINITE
    return "infinite" if is_marginalised(model) else ""


def _steps_where(arrays: PyTree, combine: str, holds: Callable[[Any, Any], Any]) -> Any:
    """At which steps it holds for "all" of the numbers, or for "any"; for whole numbers always."""
    leaves = jax.tree.leaves(arrays)
    numpy: Any = jnp if any(isinstance(leaf, Tracer) for leaf in leaves) else np
    rows = [
        getattr(holds(numpy, leaf).reshape(len(leaf), -1), combine)(axis=1)
        if _is_inexact(leaf)
        else numpy.ones(len(leaf), bool)
        for leaf in leaves
    ]
    return getattr(numpy.stack(rows), combine)(axis=0)


def refused_where(broken: Any, tree: PyTree, fault: str, hint: str = "") -> PyTree:
    """The tree; a `ValueError` where it is broken, that names the first of several steps.

    Within a caller's jit no value can be named, and the check runs with the caller's program.
    """
    if isinstance(broken, Tracer):
        return eqx.error_if(tree, broken, fault)
    if broken.any():
        at = f" at index {int(np.argmax(broken))} of the leading axis" if broken.ndim else ""
        raise ValueError(f"{fault}{at}{hint}")
    return tree


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
