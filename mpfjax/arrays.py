"""Checks of arrays that models, maps and moves are made of; `checks` says how they are used."""

import typing
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
from jax.core import Tracer

from mpfjax.checks import Checked, array_of_numbers, as_numbers, check_shape, entries, hints_of

# Of the largest entry of a covariance, which rounding may change by this much.
_ROUNDING = 1e-4


def check_spacing(name: str, places: Any, scale: Any, of_what: str) -> None:
    """Raise a `ValueError` for places that float32 cannot tell apart on their own scale.

    `scale` is a length for all or each of them, such as the side of a cell, a radius or a standard
    deviation, in words `of_what`: twenty numbers of float32 must lie within it.
    """
    parts = (places, scale)
    default = jax.dtypes.canonicalize_dtype(np.float64)
    if default == np.float64 or any(isinstance(part, Tracer) for part in parts):
        return
    far, near = np.broadcast_arrays(*(np.asarray(part, float) for part in parts))
    with np.errstate(over="ignore", invalid="ignore"):
        spacing = np.spacing(np.abs(far).astype(np.float32))
    is_coarse = (near > 0) & (spacing > 0.05 * near)
    if is_coarse.any():
        at = int(np.argmax(is_coarse))
        place, gap, side = (float(part.ravel()[at]) for part in (far, spacing, near))
        what = f"near {place:.10g} numbers of float32 are {gap:.2g} apart, and {of_what} {side:.3g}"
        raise ValueError(f"{name}: {what}; subtract an origin first, or set jax_enable_x64")


def to_array(name: str, *, floating: bool = True) -> Callable[[Any], Any]:
    """A converter of the argument of this name to an array, for `eqx.field(converter=...)`.

    With `floating`, whole numbers and booleans become floating point numbers. None stays None,
    which the annotation may refuse.
    """

    def convert(value: Any) -> Any:
        return value if value is None else jnp.asarray(as_numbers(name, value, floating=floating))

    return convert


def to_numbers(name: str) -> Callable[[Any], tuple[float, ...]]:
    """A converter of the argument of this name, one number or several, to a tuple of them."""
    return lambda value: tuple(np.ravel(array_of_numbers(name, value)).astype(float).tolist())


def real_array(shape: str, name: str, value: Any) -> Any:
    """The argument as an array of JAX in floating point, of this shape, see `check_shape`."""
    array = jnp.asarray(as_numbers(name, value, floating=True))
    check_shape(shape, **{name: array})
    return array


def to_rows(width: int | None, name: str, value: Any) -> np.ndarray:
    """The argument as rows of `width` numbers; a vector is one row, and an empty list is none."""
    rows = np.atleast_2d(np.asarray(array_of_numbers(name, value), float))
    columns = int(rows.shape[-1]) if width is None else width
    if rows.size == 0:
        return np.zeros((0, columns))
    if rows.ndim != 2 or rows.shape[1] != columns:
        raise ValueError(f"{name}: shape {rows.shape} is not that of rows of {columns} numbers")
    return rows


def _is_covariance(array: np.ndarray) -> bool:
    if array.ndim < 2 or array.shape[-1] != array.shape[-2] or not np.isfinite(array).all():
        return False
    mirrored, slack = np.swapaxes(array, -1, -2), _ROUNDING * np.abs(array).max()
    lowest = np.linalg.eigvalsh(0.5 * (array + mirrored).astype(float)).min()
    return bool(np.abs(array - mirrored).max() <= slack and lowest >= -slack)


# For example `Annotated[Float[Array, " d"], POSITIVE]`.
POSITIVE = entries(lambda array: (array > 0) & np.isfinite(array), "positive and finite throughout")
NOT_NEGATIVE = entries(lambda array: (array >= 0) & np.isfinite(array), "finite and not negative")
FINITE = entries(np.isfinite, "finite throughout")
COVARIANCE = entries(_is_covariance, "a covariance, symmetric without a negative eigenvalue")


class Fitting(Checked):
    """A base of classes whose arrays fit together: each word of their shapes is one length.

    So `Float[Array, "d d"]` beside `Float[Array, " d"]`. The axes of a word with a star, none or
    several, are the same in all fields.
    """

    def __check_init__(self) -> None:
        super().__check_init__()
        fitting: dict[str, tuple[int, ...]] = {}
        with jaxtyping.jaxtyped("context"):
            for name, hint in hints_of(type(self)).items():
                value, kinds = getattr(self, name), _array_kinds(hint)
                if not kinds or not hasattr(value, "shape"):
                    continue
                if not isinstance(value, kinds):
                    axes = " or ".join(f"({', '.join(kind.dim_str.split())})" for kind in kinds)
                    raise ValueError(f"{name}: shape {value.shape} is not {axes}, with {fitting}")
                fitting[name] = value.shape


def _array_kinds(hint: Any) -> tuple[Any, ...]:
    if isinstance(hint, type) and hasattr(hint, "dim_str"):
        return (hint,)
    parts = () if typing.get_origin(hint) is Callable else typing.get_args(hint)
    return tuple(kind for part in parts for kind in _array_kinds(part))
