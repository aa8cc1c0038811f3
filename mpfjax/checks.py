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
import functools
import importlib
import inspect
import math
import sys
import traceback
import types
import typing
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal, ParamSpec, TypeGuard, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import wadler_lindig as wl
from jax.core import Tracer

P = ParamSpec("P")
R = TypeVar("R")

_INNER = ("mpfjax.", "equinox.", "jaxtyping.", "contextlib")  # modules that users need not see
_LONGEST = 200
_MOST = 2**31 - 1


def is_series(value: Any) -> TypeGuard[Iterable[Any]]:
    """Whether it is an iterable of several things: no text, no mapping, no array."""
    single = str | bytes | dict | np.ndarray | jax.Array
    return isinstance(value, Iterable) and not isinstance(value, single)


def as_numbers(
    name: str, value: Any, *, floating: bool = False, may_be_complex: bool = False
) -> Any:
    """The argument as an array of JAX or numpy that holds the same numbers for JAX.

    JAX alone would misread bytes of another order, keep the lower half of whole numbers beyond 32
    bits, and drop masks. Raises `ValueError` for masked numbers, anything but numbers, complex ones
    unless allowed, and numbers that JAX's own type cannot hold; floating point numbers may be
    rounded. With `floating`, whole numbers and booleans become floating point numbers.
    """
    array = array_of_numbers(name, value, may_be_complex)
    if floating and not jnp.issubdtype(array.dtype, jnp.inexact):
        array = array.astype(float)
    if isinstance(array, jax.Array):
        return array
    dtype = jax.dtypes.canonicalize_dtype(array.dtype.newbyteorder("="))
    with np.errstate(over="ignore"):
        result = array.astype(dtype)
    is_whole = not jnp.issubdtype(dtype, np.inexact)
    lost = result != array if is_whole else np.isfinite(array) & ~np.isfinite(result)
    if lost.any():
        first = array[lost][0]
        raise ValueError(f"{name}: {first:g} is more than {dtype} holds; set jax_enable_x64")
    return result


def _array(value: Any) -> Any:
    """An array of NumPy, or of JAX where any part of the value is; None of what is none."""
    of_jax = any(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(value))
    with contextlib.suppress(TypeError, ValueError, OverflowError):
        return jnp.asarray(value) if of_jax else np.asarray(value)


def array_of_numbers(name: str, value: Any, may_be_complex: bool = False) -> Any:
    """The argument as an array of its own type, of JAX where any part of it is."""
    array = value if isinstance(value, jax.Array) else _array(value)
    # A mask or an imaginary part would later be dropped without a word.
    is_real = may_be_complex or not np.iscomplexobj(array)
    if np.ma.is_masked(value) or not _has_numbers(array) or not is_real:
        kind = "numbers" if may_be_complex else "real numbers"
        raise ValueError(f"{name}: {shown(value)} is no array of {kind}, none of them masked")
    return array


def array_of(shape: str) -> Any:
    """The type of arrays of this shape, for `isinstance` in a context of `jaxtyping.jaxtyped`."""
    return jaxtyping.Shaped[Any, shape]


def check_shape(shape: str, /, **arguments: Any) -> None:
    """Each argument is an array of numbers of this shape, as "n 4" or "... bins".

    Numbers stand for themselves and words for any length; the dots are any axes at all. Traced
    arrays are checked as well.
    """
    for name, value in arguments.items():
        with jaxtyping.jaxtyped("context"):
            axes = ", ".join(shape.split())
            if not _has_numbers(value):
                raise ValueError(f"{name}: {shown(value)} is no array of numbers, ({axes})")
            if not isinstance(value, array_of(shape)):
                raise ValueError(f"{name}: shape {value.shape} is not ({axes})")


def _has_numbers(array: Any) -> bool:
    dtype = getattr(array, "dtype", None)
    is_numeric = dtype is not None and any(jnp.issubdtype(dtype, k) for k in (np.number, np.bool_))
    # Durations are whole numbers for numpy. No type of JAX holds long doubles.
    return is_numeric and array.dtype.char not in "mgG"


def kinds(tree: Any) -> str:
    """The types and shapes of a tree's arrays, and its structure, to be compared and shown."""
    leaves, structure = jax.tree.flatten(tree)
    shapes = map(list, map(jnp.shape, leaves))
    each = map("{}{}".format, map(jnp.result_type, leaves), shapes)
    is_array = jax.tree_util.treedef_is_leaf(structure)
    return ", ".join(each) + f" in {structure}" * (not is_array)


def check_one_each(number: int, of_what: str = "particles", /, **trees: Any) -> None:
    """Each tree has arrays, all of them with a leading axis of this length, one for each."""
    for name, tree in trees.items():
        leaves = jax.tree.leaves(tree)
        if not leaves or any(jnp.shape(leaf)[:1] != (number,) for leaf in leaves):
            shapes = shown(jax.tree.map(jnp.shape, tree))
            raise ValueError(f"{name}: shape {shapes} has no leading axis of {number} {of_what}")


@dataclass(frozen=True)
class Rule:
    """What an argument must be, beside its type: `Annotated[float, Rule(isfinite, "finite")]`.

    `holds` says of a value whether it is `what` says in words.
    """

    holds: Callable[[Any], Any]
    what: str

    def __repr__(self) -> str:
        return self.what

    def check(self, value: Any, name: str) -> None:
        """Raise a `ValueError` for another value, by the argument's name."""
        if not self.holds(value):
            hint = f"; write {value.__name__}(...)" if isinstance(value, type) else ""
            raise ValueError(f"{name}: {shown(value)} is not {self.what}{hint}")


def number(holds: Callable[[Any], Any], what: str) -> Rule:
    """The rule for a number of which this holds."""
    kinds = int | float | np.integer | np.floating
    return Rule(
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
    return Rule(lambda value: isinstance(value, str) and value in names, f"one of {names}")


def by_name(holds: Callable[[Any], Any], what: str) -> Rule:
    """The rule for None, or a mapping from names to values of each of which this holds."""

    def all_hold(value: Any) -> bool:
        return isinstance(value, Mapping) and all(map(holds, value.values()))

    return Rule(lambda value: value is None or all_hold(value), f"a mapping from names to {what}")


def entries(holds: Callable[[np.ndarray], Any], what: str) -> Rule:
    """The rule for an array of which this holds, or each of whose entries it holds for.

    It must hold at least one number. One whose values are not known yet, a traced one, passes.
    """

    def all_hold(array: Any) -> bool:
        if isinstance(array, Tracer):
            return True
        is_numeric = _has_numbers(array if hasattr(array, "dtype") else np.asarray(array))
        return is_numeric and np.size(array) > 0 and bool(np.all(holds(np.asarray(array))))

    return Rule(all_hold, what)


Count = Annotated[int, whole(1)]
CountOrZero = Annotated[int, whole(0)]
Finite = Annotated[float, number(math.isfinite, "a finite number")]
Positive = Annotated[float, number(lambda x: 0 < x < math.inf, "a positive, finite number")]
NotNegative = Annotated[float, number(lambda x: 0 <= x < math.inf, "a finite number of at least 0")]
Share = Annotated[float, share()]
InnerShare = Annotated[float, number(lambda x: 0 < x < 1, "a number in (0, 1)")]
Exponent = Annotated[float, number(lambda x: 0 < x <= 1, "a number in (0, 1]")]
# For arrays: `Annotated[Float[Array, " d"], SHARES]`.
SHARES = entries(lambda array: (array >= 0) & (array <= 1), "in [0, 1] throughout")


def check(hint: Any, what: str = "", /, **arguments: Any) -> None:
    """Check each argument by an annotation; `what` says in words what it should be."""
    rule = _rule(hint) or _instance(hint)
    for name, value in arguments.items():
        (Rule(rule.holds, what) if what else rule).check(value, name)


class Checked(eqx.Module):
    """A base of classes whose fields are checked by their annotations."""

    def __check_init__(self) -> None:
        for name, rule in _rules(type(self)).items():
            rule.check(getattr(self, name), name)


def checked(function: Callable[P, R]) -> Callable[P, R]:
    """The function, with its arguments checked by their annotations before it runs."""

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> R:
        kwargs = _with_new_names(function, kwargs)
        try:
            values = _signature(function).bind_partial(*args, **kwargs).arguments
        except TypeError:
            values = {}  # the call itself says which argument is none of its own
        for name, rule in _rules(function).items():
            if name in values:
                rule.check(values[name], name)
        return function(*args, **kwargs)

    return call


def _with_new_names(function: Any, kwargs: dict[str, Any]) -> dict[str, Any]:
    """The arguments, with a DeprecationWarning for one that is given by its former name."""
    former = _FORMER_ARGUMENTS.get(function.__name__, {})
    for old in former.keys() & kwargs.keys():
        warn(f"{old}: this argument is now called {former[old]}", DeprecationWarning)
    return {former.get(name, name): value for name, value in kwargs.items()}


_FORMER_ARGUMENTS = {
    "monte_carlo": {"slots": "num_slots"},
    "offline_rows": {"kept": "tracks_of_frames"},
    "run_study": {"slots": "num_slots"},
    "sample_trajectories": {"model": "filter"},
}
_signature = functools.cache(inspect.signature)

# By class: the rule for an argument of it, where it need not be an instance.
RULES: dict[type, Rule] = {}


@functools.cache
def _rules(owner: Any) -> dict[str, Rule]:
    """By name, the rules for the arguments of a function or the fields of a class."""
    rules = {name: _rule(hint) for name, hint in hints_of(owner).items() if name != "return"}
    return {name: rule for name, rule in rules.items() if rule is not None}


@functools.cache
def hints_of(owner: Any) -> dict[str, Any]:
    is_class = isinstance(owner, type)
    # A user's subclass says by its annotations what it likes.
    owners = [base for base in owner.__mro__[::-1] if _is_ours(base)] if is_class else [owner]
    hints: dict[str, Any] = {}
    for each in owners:
        hints |= inspect.get_annotations(each, eval_str=True)
    return hints


def _is_ours(kind: type) -> bool:
    return kind.__module__.startswith("mpfjax.")


def _rule(hint: Any) -> Rule | None:
    """What an annotation asks for; None for one that says nothing to check."""
    origin, choices = typing.get_origin(hint), typing.get_args(hint)
    if origin is Annotated:
        return next((extra for extra in choices[1:] if isinstance(extra, Rule)), None)
    if origin in (typing.Union, types.UnionType):
        rules = [rule for choice in choices if (rule := _rule(choice)) is not None]
        if len(rules) < len(choices):
            return None
        what = " or ".join(rule.what for rule in rules)
        return Rule(lambda value: any(rule.holds(value) for rule in rules), what)
    if origin is Literal:
        return one_of(choices)
    if origin is Callable:
        return Rule(lambda value: callable(value) and not isinstance(value, type), "a function")
    if hint is bool:
        return Rule(lambda value: isinstance(value, bool | np.bool_), "True or False")
    if hint is types.NoneType:
        return Rule(lambda value: value is None, "None")
    if getattr(hint, "dtype", None) is jaxtyping.Key:
        return _keys(hint)
    if hint in RULES:
        return RULES[hint]
    return _instance(hint) if isinstance(hint, type) and _is_ours(hint) else None


def _keys(kind: Any) -> Rule:
    """The rule for one typed key, or for a row of them, whose runs would be the same if equal."""
    what = "a row of different typed keys, as jax.random.split(jax.random.key(0), runs)"
    what = what if kind.dims else "one typed key, as jax.random.key(0)"

    def holds(value: Any) -> bool:
        if not isinstance(value, kind) or value.size == 0:
            return False
        if value.ndim != 1 or isinstance(value, Tracer):
            return True
        with jax.ensure_compile_time_eval():  # keys that a caller's program holds
            data = np.asarray(jax.random.key_data(value))
        return len(np.unique(data, axis=0)) == len(data)

    return Rule(holds, what)


def is_key(value: Any) -> bool:
    """Whether it is a typed key, or an array of them."""
    return hasattr(value, "dtype") and jnp.issubdtype(value.dtype, jax.dtypes.prng_key)


def _instance(kind: type) -> Rule:
    article = "an" if kind.__name__[0] in "AEIO" else "a"
    return Rule(lambda value: isinstance(value, kind), f"{article} {kind.__name__}")


@contextlib.contextmanager
def saying(who: str, clause: str = "") -> Iterator[None]:
    """Add to an error of the user's own function a note with its name and what it is given."""
    try:
        yield
    except Exception as error:
        error.add_note(f"{who}, {clause}" if clause else who)
        raise


def warn(message: str, category: type[Warning] = RuntimeWarning) -> None:
    """Warn at the line outside of the library from which it was called."""
    stack = traceback.walk_stack(sys._getframe())
    frames = (frame.f_globals.get("__name__", "") for frame, _ in stack)
    # `warnings.warn` does not count the frames of an import either.
    names = [f"{name}." for name in frames if not name.startswith("importlib.")]
    last = max(depth for depth, name in enumerate(names) if name.startswith("mpfjax."))
    caller = next(k for k, name in enumerate(names) if k > last and not name.startswith(_INNER))
    warnings.warn(message, category, stacklevel=caller + 1)


def of_former_name(module: str, names: Mapping[str, str], name: str) -> Any:
    """The attribute that a module now calls `names[name]`, with a DeprecationWarning."""
    warn(f"{module}.{name} is now called {names[name]}", DeprecationWarning)
    return getattr(sys.modules[module], names[name])


class Renamed:
    """An attribute of a class under its former name, with a DeprecationWarning."""

    def __init__(self, old: str, new: str) -> None:
        self.old, self.new = old, new

    def __get__(self, instance: Any, owner: type) -> Any:
        """The attribute of the new name."""
        warn(f"{owner.__name__}.{self.old} is now called {self.new}", DeprecationWarning)
        return getattr(owner if instance is None else instance, self.new)


def optional(module: str, package: str) -> types.ModuleType:
    """The module of an extra, or an `ImportError` that says how to install it."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ImportError(f"{module} is missing: pip install {package}") from error


def shown(value: Any) -> str:
    """The value on one line, cut where it is long; arrays of ten numbers or more as shapes."""
    is_array = isinstance(value, jax.Array | np.ndarray) and not isinstance(value, Tracer)
    is_short = is_array and value.size < 10 and not is_key(value)
    text = " ".join((str(value) if is_short else eqx.tree_pformat(value, width=_MOST)).split())
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]} ..."


def format_fields(value: Any) -> str:
    """The value on several lines, with fields at their defaults; short arrays as numbers."""

    def number(leaf: Any) -> wl.AbstractDoc | None:
        return wl.TextDoc(shown(leaf)) if isinstance(leaf, jax.Array) else None

    return wl.pformat(value, hide_defaults=False, custom=number)
