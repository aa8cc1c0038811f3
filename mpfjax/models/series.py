"""The data of all steps: observations, which of them are missing, known inputs; and drawn ones."""

import warnings
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Key, PyTree

from mpfjax.checks import Count, array_of_numbers, check, check_shape, checked, warn
from mpfjax.models.base import AbstractStateSpaceModel, innermost, require, with_inputs
from mpfjax.models.law import Law
from mpfjax.models.observations import (
    NOT_FINITE,
    USABLE,
    as_arrays,
    is_inexact,
    numpy_for,
    refusal_of,
    refuse_where,
    require_inputs,
    steps_where,
)
from mpfjax.operations.compiling import is_traced, jit_on_wide_vectors, with_floats_traced

_EXACT, _FAR = 2**24, 2**17  # float32 holds whole numbers up to the first, and 1/64 at the second


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
    observations = rows_of(series.observations)
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
    _length(rows_of(observations), observations, "observations")


def steps_of_inputs(
    inputs: PyTree, length: int, model: Any, of_what: str = "observations"
) -> PyTree:
    """u_1, ..., u_t as arrays; a `ValueError` unless they are finite numbers, one for each step."""
    if inputs is None:
        return None
    require_inputs(model)
    arrays = rows_of(inputs, "inputs")
    own_length = _length(arrays, inputs, "inputs")
    if own_length != length:
        raise ValueError(f"inputs: their t is {own_length}, and that of the {of_what} is {length}")
    usable = steps_where(arrays, "all", USABLE[NOT_FINITE])
    inspect = getattr(innermost(model), "check_inputs", None)
    if inspect is not None and not is_traced(arrays):
        inspect(arrays)
    return refuse_where(~usable, arrays, f"inputs: {NOT_FINITE}")


def rows_of(data: PyTree, name: str = "observations") -> PyTree:
    """The data of all steps as arrays, of which float32 loses no differences in time."""
    for leaf in jax.tree.leaves(data):
        check_differences(name, leaf)
    return as_arrays(data, name)


def check_differences(name: str, rows: Any) -> None:
    """Raise a `ValueError` for numbers that differ from one step to the next by what float32 loses.

    They are large, or a long series that goes somewhere: whatever else differs by so little is a
    rounding error itself, as in times between observations. Of what is in float32 already, the gaps
    between such numbers stand for what was lost.
    """
    array = array_of_numbers(name, rows)
    default = jax.dtypes.canonicalize_dtype(np.float64)
    is_wide = array.dtype.itemsize > 2 and array.dtype.kind in "iuf"
    is_traced, is_rounded = isinstance(array, Tracer), array.dtype == np.float32
    if is_traced or not is_wide or default == np.float64 or np.shape(array)[:1] in ((), (0,), (1,)):
        return
    if is_rounded and np.nanmax(np.abs(array), initial=0) < _EXACT:
        return
    rows = np.asarray(array, float).reshape(len(array), -1)
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of columns that are empty, or overflow
        rows = np.where(np.isfinite(rows.astype(np.float32)), rows, np.nan)
        sizes = np.nanmax(np.abs(rows), axis=0)
        extent = np.nanmax(rows, axis=0) - np.nanmin(rows, axis=0)
        apart = np.nanmean(np.abs(np.diff(rows, axis=0)), axis=0)
        lost = np.nanmean(np.abs(rows.astype(np.float32) - rows), axis=0)
        if is_rounded:
            lost = np.where(sizes >= _EXACT, 0.25 * np.spacing(sizes.astype(np.float32)), 0.0)
    # A walk goes farther than its steps, which rounding errors about a constant do not.
    walks = (len(rows) >= 8) & (extent >= 6.99 * apart)
    is_lost = (apart > 0) & (lost > 0.01 * apart) & ((sizes > _FAR) | walks)
    if is_lost.any():
        at = int(np.argmax(is_lost))
        near = f"numbers near {sizes[at]:.10g} that differ by {apart[at]:.2g}"
        way_out = "np.diff(x) of times, x - x[0] of places"
        where = f"float32 cannot tell {near}; subtract in numpy before, as {way_out}"
        raise ValueError(f"{name}: {where}, or set jax_enable_x64")


def present_steps(observations: PyTree, series: Series, fault: str) -> Any:
    """Which observations are there, (t,), or None where all are; raises for data not to be run.

    A warning says how many steps are skipped of which some numbers are there.
    """
    usable, present = steps_where(observations, "all", USABLE[fault]), series.present
    numpy = numpy_for(usable, present)
    if present is not None:
        check_shape(f"{len(usable)}", present=present)
    present = numpy.ones(usable.shape, bool) if present is None else numpy.asarray(present, bool)
    if series.skips_missing:
        is_observed = usable
        if fault != NOT_FINITE:
            is_observed = steps_where(observations, "any", lambda numpy, leaf: ~numpy.isnan(leaf))
        elif numpy is np:
            _warn_of_parts(observations, present & ~usable)
        present = present & is_observed
    missing = "; if it is missing, run_filter(..., missing='skip') or Series.skipping(observations)"
    hint = missing * (fault == NOT_FINITE)
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
        leaf = leaf if is_inexact(leaf) else leaf.astype(jnp.result_type(float))
        there = numpy.asarray(present).reshape(-1, *(1,) * (leaf.ndim - 1))
        return numpy.where(there, leaf, numpy.asarray(numpy.nan, leaf.dtype))

    return jax.tree.map(gap, observations)


def _warn_of_parts(observations: PyTree, skipped: Bool[np.ndarray, " t"]) -> None:
    inexact = [leaf for leaf in jax.tree.leaves(observations) if is_inexact(leaf)]
    if inexact:
        some = steps_where(inexact, "any", lambda numpy, leaf: numpy.isfinite(leaf))
        if (skipped & some).any():
            number = f"{(skipped & some).sum()} of {len(skipped)} steps"
            message = f"{number} are skipped for a NaN or infinity beside finite numbers"
            warn(f"observations: {message}; a model with handles_missing = True receives them")


def _length(arrays: PyTree, tree: PyTree, name: str) -> int:
    """t, the length of the leading axis that all leaves share; a `ValueError` without one."""
    shapes = [leaf.shape for leaf in jax.tree.leaves(arrays)]
    lengths = {shape[:1] for shape in shapes}
    if len(lengths) != 1 or lengths & {(), (0,)}:
        hint = f"; a list is so many arrays, jnp.asarray({name}) is one"
        hint = hint if isinstance(tree, list | tuple) else ""
        raise ValueError(f"{name}: shapes {shapes} do not share a leading axis t > 0{hint}")
    return shapes[0][0]


@checked
def simulate(
    key: Key[Array, ""], model: AbstractStateSpaceModel, num_steps: Count, *, inputs: PyTree = None
) -> tuple[PyTree, PyTree]:
    """Draw x_0, ..., x_t, leaves (t + 1, ...), and y_1, ..., y_t, leaves (t, ...), from a model.

    The model defines `sample_observation(key, states)`, y given each of n states; it raises
    `ValueError` otherwise. `inputs` are as for `run_filter`. Use it to test a filter on data whose
    states are known.
    """
    require(model, "sample_observation", "simulate")
    inputs = steps_of_inputs(inputs, num_steps, model, "steps")
    return with_floats_traced(lambda model: _simulate(key, model, num_steps, inputs), model)


@jit_on_wide_vectors
def _simulate(key, model, num_steps, inputs):
    key_initial, key_steps = jax.random.split(key)
    initial = Law(model).sample_initial(key_initial, 1)
    states, observations = steps_ahead(key_steps, model, initial, num_steps, inputs)
    return jax.tree.map(lambda *parts: jnp.concatenate(parts), initial, states), observations


def steps_ahead(
    key: Key[Array, ""], model: Any, state: PyTree, num_steps: int, inputs: PyTree
) -> tuple[PyTree, PyTree]:
    """Draw the next states and observations from a state, leaves (1, ...): (k, ...) of each."""

    def advance(state: PyTree, step: tuple[Array, PyTree]) -> tuple[PyTree, tuple[PyTree, PyTree]]:
        step_key, now = step
        key_state, key_observation = jax.random.split(step_key)
        law = Law(with_inputs(model, now))
        moved = law.draw(key_state, state)
        drawn = moved, law.observe(key_observation, moved)
        return moved, jax.tree.map(lambda leaf: leaf[0], drawn)

    return jax.lax.scan(advance, state, (jax.random.split(key, num_steps), inputs))[1]
