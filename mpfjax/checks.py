"""Checks of arguments. Each raises a `ValueError` that names the argument, its value and what is
allowed.

An annotation says what an argument may be, and is checked: a function by `@checked`, the fields of
a class by `Checked` among its bases.

    class Split(Checked):
        min_share: Annotated[float, share(0.5)] = 0.1     # or a name from here, as Share, Count
        features: Callable[[PyTree], Array] | None = None
        noise: Literal["independent", "rqmc"] = "independent"

Checked are numbers and arrays with a `Rule`, `Literal`, `bool`, `Callable`, keys, and the library's
own classes; `| None` adds None. Any other annotation is for readers alone.
"""

import contextlib
import dataclasses
import functools
import importlib
import inspect
import math
import types
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal, ParamSpec, TypeGuard, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
from jax.core import Tracer

P = ParamSpec("P")
R = TypeVar("R")
T = TypeVar("T")

_LONGEST = 200
_MOST = 2**31 - 1
# Of the largest entry of a covariance, which rounding may change by this much.
_ROUNDING = 1e-4


def is_series(value: Any) -> TypeGuard[Iterable[Any]]:
    """Whether it is an iterable of several things: no text, no mapping, no array."""
    single = str | bytes | dict | np.ndarray | jax.Array
    return isinstance(value, Iterable) and not isinstance(value, single)


def check_key(key: Any, name: str = "key", *, batch: bool = False) -> None:
    """It is one typed key, or with `batch` a vector of at least one."""
    is_array = isinstance(key, jax.Array | np.ndarray)
    if not is_array or not jnp.issubdtype(key.dtype, jax.dtypes.prng_key):
        use = "jax.random.split(jax.random.key(0), seeds)" if batch else "jax.random.key(0)"
        raise ValueError(
            f"{name}: {shown(key)} is no typed key (one of JAX's old kind is none); use {use}"
        )
    if key.ndim != batch or key.size < 1:
        wanted = "one key a run, (seeds,)" if batch else "one key, (); monte_carlo takes many"
        raise ValueError(f"{name}: shape {key.shape} is not that of {wanted}")


def as_numbers(
    name: str, value: Any, *, floating: bool = False, may_be_complex: bool = False
) -> Any:
    """The argument as an array of JAX or numpy that holds the same numbers for JAX.

    JAX alone would misread bytes of another order, keep the lower half of whole numbers beyond 32
    bits, and drop masks. Raises `ValueError` for masked numbers, anything but numbers, complex ones
    unless allowed, and numbers that JAX's own type cannot hold. With `floating`, whole numbers and
    booleans become floating point numbers.
    """
    if isinstance(value, jax.ShapeDtypeStruct):
        return value
    if np.ma.is_masked(value):
        raise ValueError(f"{name}: {shown(value)} is masked; fill it, as by .filled(np.nan)")
    is_list = isinstance(value, list | tuple)
    of_jax = any(isinstance(leaf, jax.Array) for leaf in (value if is_list else [value]))
    try:
        array = jnp.asarray(value) if of_jax else np.asarray(value)
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"{name}: {shown(value)} is no array of numbers") from error
    if not _has_numbers(array):
        raise ValueError(f"{name}: {shown(value)} is no array of numbers")
    if jnp.iscomplexobj(array) and not may_be_complex:
        # Later the imaginary part would be dropped silently, at the latest in a density.
        raise ValueError(
            f"{name}: {array.dtype} is complex; give the real and the imaginary part as two numbers"
        )
    if floating and not jnp.issubdtype(array.dtype, jnp.inexact):
        array = array.astype(float)
    return array if of_jax else _of_jax(name, array)


def _of_jax(name: str, array: Any) -> np.ndarray:
    """The array in the type that JAX gives it; a `ValueError` where numbers would change.

    Floating point numbers may be rounded.
    """
    shorter = {"g": np.float64, "G": np.complex128}.get(array.dtype.char, array.dtype)
    dtype = jax.dtypes.canonicalize_dtype(np.dtype(shorter).newbyteorder("="))
    with np.errstate(over="ignore"):
        held = array.astype(dtype)
    is_whole = not jnp.issubdtype(dtype, np.inexact)
    lost = held != array if is_whole else np.isfinite(array) & ~np.isfinite(held)
    if lost.any():
        first = array[lost][0]
        raise ValueError(f"{name}: {first:g} is more than {dtype} holds; set jax_enable_x64")
    return held


def to_array(name: str, *, floating: bool = True) -> Callable[[Any], Any]:
    """A converter of the argument of this name to an array, for `eqx.field(converter=...)`.

    With `floating`, whole numbers and booleans become floating point numbers. None stays None.
    """

    def convert(value: Any) -> Any:
        if value is None:  # which the annotation may refuse
            return value
        numbers = as_numbers(name, value, floating=floating)
        return numbers if isinstance(numbers, jax.ShapeDtypeStruct) else jnp.asarray(numbers)

    return convert


def real_arrays(shape: str, /, **arguments: Any) -> Any:
    """The arguments as arrays of JAX in floating point, all of this shape, see `check_shape`.

    One array alone comes as itself.
    """
    check_shape(shape, **arguments)
    arrays = [
        jnp.asarray(as_numbers(name, value, floating=True)) for name, value in arguments.items()
    ]
    return arrays if len(arrays) > 1 else arrays[0]


def check_shape(shape: str, /, **arguments: Any) -> None:
    """Each argument is an array of this shape, as "n 4" or "... bins".

    Numbers stand for themselves and words for any length; the dots are any axes at all. Traced
    arrays are checked as well.
    """
    axes = shape.removeprefix("...").split()
    for name, value in arguments.items():
        lengths = getattr(value, "shape", None)
        if isinstance(value, type) or not isinstance(lengths, tuple) or not _has_numbers(value):
            raise ValueError(f"{name}: {shown(value)} is no array of numbers")
        own = lengths[max(len(lengths) - len(axes), 0) :] if "..." in shape else lengths
        fits = len(own) == len(axes) and all(
            not axis.isdigit() or int(axis) == length
            for axis, length in zip(axes, own, strict=True)
        )
        if not fits:
            raise ValueError(f"{name}: shape {lengths} is not ({', '.join(shape.split())})")


def to_rows(width: int, name: str, value: Any) -> np.ndarray:
    """The argument as rows of `width` numbers; a vector is one row, and an empty list is none."""
    if np.ma.is_masked(value):
        raise ValueError(f"{name}: {shown(value)} are masked in part; fill them, as by .filled(0)")
    try:
        rows = np.asarray(value)
        if rows.dtype.kind not in "cmM":  # numpy would drop an imaginary part, or a unit
            rows = rows.astype(float)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name}: {shown(value)} are no rows of {width} numbers") from error
    if rows.ndim > 0 and rows.size == 0:
        return np.zeros((0, width))
    rows = np.atleast_2d(rows)
    if rows.dtype != float or rows.ndim != 2 or rows.shape[1] != width:
        raise ValueError(f"{name}: {rows.dtype}{rows.shape} are no rows of {width} numbers")
    return rows


def _has_numbers(array: Any) -> bool:
    dtype = getattr(array, "dtype", None)
    is_duration = getattr(dtype, "kind", None) == "m"  # for numpy a whole number
    kinds = (np.number, np.bool_)
    return dtype is not None and not is_duration and any(jnp.issubdtype(dtype, k) for k in kinds)


def kinds(tree: Any) -> str:
    """The types and shapes of a tree's arrays, and its structure, to be compared and shown."""
    leaves, structure = jax.tree.flatten(tree)
    each = [f"{jnp.result_type(leaf)}{list(jnp.shape(leaf))}" for leaf in leaves]
    return f"{', '.join(each)} in {structure}"


def check_one_each(num_particles: int, /, **results: Any) -> None:
    """What the user's function of this name returned has arrays with an entry for each particle."""
    for name, values in results.items():
        leaves = jax.tree.leaves(values)
        if not leaves or any(jnp.shape(leaf)[:1] != (num_particles,) for leaf in leaves):
            raise ValueError(
                f"{name}: it returned {shown(jax.tree.map(jnp.shape, values))}, no arrays whose"
                f" leading axis is that of the {num_particles} particles"
            )


@dataclass(frozen=True)
class Rule:
    """What an argument must be, beside its type: `Annotated[float, Rule(isfinite, "finite")]`.

    `check`: takes the argument's value and its name, and raises a `ValueError`.
    """

    check: Callable[[Any, str], None]
    what: str

    def __repr__(self) -> str:
        return self.what

    def holds(self, value: Any) -> bool:
        """Whether the value is what it must be."""
        with contextlib.suppress(ValueError):
            self.check(value, "")
            return True
        return False


def of(holds: Callable[[Any], Any], what: str) -> Rule:
    """The rule for a value of which this holds; `what` says so in words."""

    def check(value: Any, name: str) -> None:
        if not holds(value):
            raise ValueError(f"{name}: {shown(value)} is not {what}")

    return Rule(check, what)


def number(holds: Callable[[Any], Any], what: str) -> Rule:
    """The rule for a number of which this holds."""
    kinds = int | float | np.integer | np.floating
    return of(
        lambda value: isinstance(value, kinds) and not isinstance(value, bool) and holds(value),
        what,
    )


def whole(least: int) -> Rule:
    """The rule for a whole number (a Python or numpy integer) from `least` on, in 32 bits."""
    return number(
        lambda value: isinstance(value, int | np.integer) and least <= value <= _MOST,
        f"a whole number of at least {least}, and at most {_MOST}",
    )


def share(most: float = 1.0) -> Rule:
    """The rule for a number in [0, most]."""
    return number(lambda value: 0 <= value <= most, f"a number in [0, {most:g}]")


def one_of(choices: Iterable[str]) -> Rule:
    """The rule for one of some strings, where they are not written out as a `Literal`."""
    names = sorted(choices)
    return of(lambda value: isinstance(value, str) and value in names, f"one of {names}")


def by_name(holds: Callable[[Any], Any], what: str) -> Rule:
    """The rule for None, or a mapping from names to values of each of which this holds."""

    def all_hold(value: Any) -> bool:
        return isinstance(value, Mapping) and all(map(holds, value.values()))

    return of(lambda value: value is None or all_hold(value), f"a mapping from names to {what}")


def entries(holds: Callable[[np.ndarray], Any], what: str) -> Rule:
    """The rule for an array with this in all its entries, where its values are known."""

    def check(array: Any, name: str) -> None:
        if isinstance(array, Tracer | jax.ShapeDtypeStruct):
            return
        if np.size(array) == 0:
            raise ValueError(f"{name}: shape {np.shape(array)} holds no number")
        if not _has_numbers(array if hasattr(array, "dtype") else np.asarray(array)):
            raise ValueError(f"{name}: {shown(array)} is no array of numbers")
        if not np.all(holds(np.asarray(array))):
            raise ValueError(f"{name}: {shown(array)} is not {what} throughout")

    return Rule(check, what)


def _check_covariance(array: Any, name: str) -> None:
    FINITE.check(array, name)
    if isinstance(array, Tracer | jax.ShapeDtypeStruct):
        return
    values = 1.0 * np.asarray(array)
    if values.ndim < 2 or values.shape[-1] != values.shape[-2]:
        raise ValueError(f"{name}: shape {values.shape} is not that of square matrices")
    largest = np.abs(values).max()
    mirrored = np.swapaxes(values, -1, -2)
    if np.abs(values - mirrored).max() > _ROUNDING * largest:
        raise ValueError(f"{name}: {shown(array)} is not symmetric")
    if np.linalg.eigvalsh(0.5 * (values + mirrored)).min() < -_ROUNDING * largest:
        raise ValueError(f"{name}: {shown(array)} is no covariance: it has a negative eigenvalue")


Count = Annotated[int, whole(1)]
CountOrZero = Annotated[int, whole(0)]
Finite = Annotated[float, number(math.isfinite, "a finite number")]
Positive = Annotated[float, number(lambda x: 0 < x < math.inf, "a positive, finite number")]
NotNegative = Annotated[float, number(lambda x: 0 <= x < math.inf, "a finite number of at least 0")]
Share = Annotated[float, share()]
InnerShare = Annotated[float, number(lambda x: 0 < x < 1, "a number in (0, 1)")]
Exponent = Annotated[float, number(lambda x: 0 < x <= 1, "a number in (0, 1]")]
# For arrays: `Annotated[Float[Array, " d"], POSITIVE]`.
POSITIVE = entries(lambda array: (array > 0) & np.isfinite(array), "positive and finite")
NOT_NEGATIVE = entries(lambda array: (array >= 0) & np.isfinite(array), "finite and not negative")
FINITE = entries(np.isfinite, "finite")
COVARIANCE = Rule(_check_covariance, "a covariance")
_FUNCTION = of(lambda value: callable(value) and not isinstance(value, type), "a function")
_FLAG = of(lambda value: isinstance(value, bool | np.bool_), "True or False")


def check(hint: Any, what: str = "", /, **arguments: Any) -> None:
    """Check each argument by an annotation; `what` says in words what it should be."""
    for name, value in arguments.items():
        rule = _rule(hint) or _instance(hint)
        if what:
            rule = of(rule.holds, what)
        rule.check(value, name)


class Checked(eqx.Module):
    """A base of classes whose fields are checked by their annotations."""

    def __check_init__(self) -> None:
        rules = _rules(type(self))
        for field in dataclasses.fields(self):
            if field.name in rules:
                rules[field.name].check(getattr(self, field.name), field.name)


class Fitting(Checked):
    """A base of classes whose arrays fit together: each word of their shapes is one length.

    So `Float[Array, "d d"]` beside `Float[Array, " d"]`. The axes of a word with a star, none or
    several, are the same in all fields.
    """

    def __check_init__(self) -> None:
        super().__check_init__()
        known: dict[str, Any] = {}
        said: dict[str, str] = {}
        for name, choices in _shapes(type(self)).items():
            shape = getattr(getattr(self, name), "shape", None)
            if shape is None:
                continue
            found = [_lengths(shape, axes) for axes in choices]
            fitting = [own for own in found if own is not None and _agree(own, known)]
            if not fitting:
                shapes = " or ".join(f"({', '.join(axes)})" for axes in choices)
                known_by = ", ".join(f"{word} is {known[word]} by {said[word]}" for word in known)
                raise ValueError(f"{name}: shape {shape} is not {shapes}, where {known_by}")
            said = dict.fromkeys(fitting[0], name) | said
            known |= fitting[0]


def checked(function: Callable[P, R]) -> Callable[P, R]:
    """The function, with its arguments checked by their annotations before it runs."""
    signature = inspect.signature(function)

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> R:
        values = signature.bind(*args, **kwargs).arguments
        for name, rule in _rules(function).items():
            if name in values:
                rule.check(values[name], name)
        return function(*args, **kwargs)

    return call


def checked_by(check: Callable[[Any, str], None]) -> Callable[[type[T]], type[T]]:
    """For a class: arguments of it are checked by `check`, which takes a value and its name.

    Without it they must be instances.
    """

    def marked(kind: type[T]) -> type[T]:
        _CHECKS[kind] = check
        return kind

    return marked


_CHECKS: dict[type, Callable[[Any, str], None]] = {}


@functools.cache
def _rules(owner: Any) -> dict[str, Rule]:
    """By name, the rules for the arguments of a function or the fields of a class."""
    rules = {name: _rule(hint) for name, hint in _hints(owner).items() if name != "return"}
    return {name: rule for name, rule in rules.items() if rule is not None}


def _hints(owner: Any) -> dict[str, Any]:
    is_class = isinstance(owner, type)
    # A user's subclass says by its annotations what it likes.
    told = [base for base in owner.__mro__[::-1] if _is_ours(base)] if is_class else [owner]
    hints: dict[str, Any] = {}
    for each in told:
        hints |= inspect.get_annotations(each, eval_str=True)
    return hints


@functools.cache
def _shapes(owner: type) -> dict[str, list[list[str]]]:
    """By name, the shapes that an array may have, each as the words of its axes."""
    shapes = {name: _axes(hint) for name, hint in _hints(owner).items()}
    return {name: choices for name, choices in shapes.items() if choices}


def _axes(hint: Any) -> list[list[str]]:
    words = getattr(hint, "dim_str", None)
    if words is not None:
        return [words.split()]
    parts = [] if typing.get_origin(hint) is Callable else typing.get_args(hint)
    return [choice for part in parts for choice in _axes(part)]


def _lengths(shape: tuple[int, ...], axes: list[str]) -> dict[str, Any] | None:
    """What each word stands for; None where the shape is not of these axes."""
    if axes and axes[0].startswith("*"):
        split = max(len(shape) - len(axes) + 1, 0)
        shape = (shape[:split], *shape[split:])  # pyright: ignore[reportAssignmentType]
    found: dict[str, Any] = {}
    fits = len(shape) == len(axes) and all(
        found.setdefault(axis, length) == length for axis, length in zip(axes, shape, strict=True)
    )
    return found if fits else None


def _agree(one: dict[str, Any], other: dict[str, Any]) -> bool:
    return all(one[word] == other[word] for word in one.keys() & other.keys())


def _is_ours(kind: type) -> bool:
    return kind.__module__.startswith("mpfjax.")


def _rule(hint: Any) -> Rule | None:
    """What an annotation asks for; None for one that says nothing to check."""
    origin, choices = typing.get_origin(hint), typing.get_args(hint)
    if origin is Annotated:
        return next((extra for extra in choices[1:] if isinstance(extra, Rule)), None)
    if origin in (typing.Union, types.UnionType):
        return _any_of([_rule(choice) for choice in choices if choice is not types.NoneType])
    if origin is Literal:
        return one_of(choices)
    if origin is Callable:
        return _FUNCTION
    if hint is bool:
        return _FLAG
    if getattr(hint, "dtype", None) is jaxtyping.Key and hint.index_variadic is None:
        is_batch = len(hint.dims) > 0
        return Rule(lambda value, name: check_key(value, name, batch=is_batch), "typed keys")
    if hint in _CHECKS:
        return Rule(_CHECKS[hint], hint.__name__)
    return _instance(hint) if isinstance(hint, type) and _is_ours(hint) else None


def _instance(kind: type) -> Rule:
    what = f"{'an' if kind.__name__[0] in 'AEIO' else 'a'} {kind.__name__}"

    def check(value: Any, name: str) -> None:
        if not isinstance(value, kind):
            hint = f"; write {value.__name__}(...)" if isinstance(value, type) else ""
            raise ValueError(f"{name}: {shown(value)} is not {what}{hint}")

    return Rule(check, what)


def _any_of(rules: list[Rule | None]) -> Rule | None:
    """The rule that lets pass None and what one of these does; None where one checks nothing."""
    known = [rule for rule in rules if rule is not None]
    if len(known) < len(rules):
        return None
    what = " or ".join(rule.what for rule in known)

    def check(value: Any, name: str) -> None:
        if value is None:
            return
        rule = known[0] if len(known) == 1 else of(lambda v: any(r.holds(v) for r in known), what)
        rule.check(value, name)

    return Rule(check, what)


def optional(module: str, package: str) -> types.ModuleType:
    """The module of an extra, or an `ImportError` that says how to install it."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ImportError(f"{module} is missing: pip install {package}") from error


@contextlib.contextmanager
def saying(what: str) -> Iterator[None]:
    """Add to an error from the user's own function the argument that it came from."""
    try:
        yield
    except Exception as error:
        error.add_note(f"mpfjax: {what}")
        raise


def shown(value: Any) -> str:
    """The value as it is printed, cut where it is long."""
    text = str(value) if isinstance(value, jax.Array | np.ndarray) else repr(value)
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]} ..."
