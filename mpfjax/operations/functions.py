"""Functions that are written where they are used: one text with the same values is one function.

JAX compiles a program for each function object, and a `lambda` in a loop, or in the cell of a
notebook that is run again, is another object every time.
"""

import dis
import functools
from types import BuiltinFunctionType, CodeType, FunctionType, ModuleType
from typing import Any
from weakref import WeakValueDictionary

import jax
import numpy as np
from jax.core import Tracer

# What these packages define stays as it is while a program runs.
_PACKAGES = ("builtins", "equinox", "functools", "jax", "math", "mpfjax", "numpy", "operator")
_JITTED: Any = type(jax.jit(abs))
_PLAIN = (type(None), bool, int, str, bytes, type(...))
_first: WeakValueDictionary[Any, FunctionType] = WeakValueDictionary()


class _ChangeableError(Exception):
    """A value that may be another when the function is called again."""


class _One:
    """An object that equals itself alone, and lives as long as this."""

    def __init__(self, value: Any) -> None:
        self.value = value

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _One) and self.value is other.value

    def __hash__(self) -> int:
        return id(self.value)


def interned(function: Any) -> Any:
    """The first function that has the same code and sees the same values, or the one given.

    Values are those of the variables around it, of its defaults, and of the globals that it names.
    Only numbers, strings, tuples, JAX arrays, other functions of which the same holds, and what
    well-known packages define can be compared: with anything else, such as a list, a numpy array
    or a model, which may have changed in between, a function equals itself alone.
    """
    if type(function) is not FunctionType:
        return function
    try:
        key = _key(function, ())
        found: Any = _first.get(key)
        # The variables around the first one may have changed since.
        if found is not None and _key(found, ()) == key:
            return found
    except _ChangeableError:
        return function
    _first[key] = function
    return function


def _key(function: FunctionType, callers: tuple[FunctionType, ...]) -> tuple[Any, ...]:
    if function.__dict__ or function in callers:
        raise _ChangeableError
    held = functools.partial(_held, callers=(*callers, function))
    names = _global_names(function.__code__)
    seen = {name: function.__globals__[name] for name in names if name in function.__globals__}
    try:
        around = [cell.cell_contents for cell in function.__closure__ or ()]
    except ValueError as error:  # a variable that has no value yet
        raise _ChangeableError from error
    defaults = ((function.__defaults__ or ()), tuple((function.__kwdefaults__ or {}).items()))
    return function.__code__, held(tuple(around)), held(defaults), held(tuple(seen.items()))


def _held(value: Any, callers: tuple[FunctionType, ...]) -> Any:
    if type(value) in _PLAIN:
        return type(value), value
    if type(value) in (float, complex):
        return type(value), repr(value)  # in which 0.0 is not -0.0, and NaN is NaN
    if isinstance(value, np.generic) and value.dtype.kind in "biufc":
        return type(value), value.tobytes()
    if type(value) is tuple:
        return tuple(_held(each, callers) for each in value)
    if _is_of_packages(value) or (isinstance(value, jax.Array) and not isinstance(value, Tracer)):
        return _One(value)
    if type(value) is FunctionType:
        return _key(value, callers)
    raise _ChangeableError


def _is_of_packages(value: Any) -> bool:
    if isinstance(value, ModuleType):
        name = value.__name__
    elif isinstance(value, type | FunctionType | BuiltinFunctionType | _JITTED):
        name = value.__module__ or ""
    else:
        return False
    return name.partition(".")[0] in _PACKAGES


@functools.lru_cache(maxsize=4096)
def _global_names(code: CodeType) -> tuple[str, ...]:
    """The names that the code, and the functions within it, look up among the globals."""
    names = {each.argval for each in dis.get_instructions(code) if each.opname in _LOOKS_UP}
    inner = (each for each in code.co_consts if isinstance(each, CodeType))
    return tuple(sorted(names.union(*map(_global_names, inner))))


_LOOKS_UP = ("LOAD_GLOBAL", "LOAD_NAME", "LOAD_FROM_DICT_OR_GLOBALS")
