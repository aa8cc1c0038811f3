"""Descriptions of a pytree, a function or a setting, as text by which two runs are compared."""

import dataclasses
import functools
import hashlib
import json
import re
import types
from collections.abc import Mapping
from typing import Any, cast

import equinox as eqx
import jax
import numpy as np
from jaxtyping import PyTree

_MOST_SHOWN = 4


def describe(tree: PyTree) -> dict[str, str]:
    """Every leaf's shape and dtype, every static field, and what else there is, by its place."""
    return _static_fields(tree, ()) | {
        jax.tree_util.keystr(place): kind(leaf) if is_data(leaf) else named(leaf)
        for place, leaf in jax.tree_util.tree_leaves_with_path(tree)
    }


def fingerprint(tree: PyTree) -> str:
    """SHA-256 of all that a pytree holds: its description and its arrays' bytes."""
    digest = hashlib.sha256(json.dumps(describe(tree)).encode())
    for leaf in filter(is_data, jax.tree.leaves(tree)):
        digest.update(as_numpy(leaf).tobytes())
    return digest.hexdigest()


def differences(there: Mapping[str, Any], here: Mapping[str, Any]) -> str:
    """The first few differences between two descriptions, in words."""
    found = []
    for name in sorted(there.keys() | here.keys()):
        if name not in there:
            found.append(f"{name} is only here")
        elif name not in here:
            found.append(f"{name} is only there")
        elif there[name] != here[name]:
            found.append(f"{name} is {there[name]} there and {here[name]} here")
    more = len(found) - _MOST_SHOWN
    return "; ".join(found[:_MOST_SHOWN]) + (f"; and {more} more" if more > 0 else "")


def named(value: Any) -> str:
    """A name for a function, or for another thing without a value; the same in every process."""
    return re.sub(r" at 0x[0-9a-f]+", "", repr(value))


def is_data(leaf: Any) -> bool:
    """Whether it is an array, a key or a number, the shape of one included."""
    arrays = (jax.Array, np.ndarray, np.generic, jax.ShapeDtypeStruct)
    return isinstance(leaf, (*arrays, bool, int, float, complex))


def is_number(leaf: Any) -> bool:
    return isinstance(leaf, bool | int | float | complex) and not isinstance(leaf, np.generic)


def kind(leaf: Any) -> str:
    if is_number(leaf):
        return f"a Python {type(leaf).__name__}"
    return f"{leaf.dtype}{list(leaf.shape)}"


def is_key(leaf: Any) -> bool:
    return not is_number(leaf) and jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def as_numpy(leaf: Any) -> np.ndarray:
    return np.asarray(jax.random.key_data(leaf) if is_key(leaf) else leaf)


def _static_fields(tree: PyTree, place: tuple[Any, ...]) -> dict[str, str]:
    """The class and static fields of every module in a pytree, by their places."""
    found = {}
    if isinstance(tree, eqx.Module):
        start = jax.tree_util.keystr(place)
        found[f"{start}.__class__"] = type(tree).__name__
        for field in dataclasses.fields(tree):
            if field.metadata.get("static", False):
                found[f"{start}.{field.name}"] = named(getattr(tree, field.name, None))
    is_inner = lambda node: node is not tree and isinstance(node, eqx.Module)  # noqa: E731
    for inner, node in jax.tree_util.tree_leaves_with_path(tree, is_leaf=is_inner):
        if is_inner(node):
            found |= _static_fields(node, place + inner)
    return found


def contents_of(name: str, value: Any) -> dict[str, str]:
    """All that a filter, an objective or an optimiser is made from, by `name` and its place.

    Numbers are described by their values, arrays by their `fingerprint`, classes by their names.
    Functions are described by their names and by what they hold: closures, bound arguments, and
    the object of a method. What their code does cannot be compared.
    """
    found: dict[str, str] = {}
    _collect(name, value, found, {})
    return found


def _collect(name: str, value: Any, found: dict[str, str], seen: dict[int, Any]) -> None:
    """Write down a value, and what it holds."""
    if value is None or isinstance(value, str | bytes | np.dtype):
        found[name] = repr(value)
    elif is_data(value):
        found[name] = _value(value)
    elif isinstance(value, type | types.BuiltinFunctionType | types.ModuleType):
        found[name] = named(value)
    elif isinstance(value, set | frozenset):
        found[name] = repr(sorted(map(named, value)))
    elif id(value) in seen:
        found[name] = "as above"
    else:
        # Kept alive, since another object could get the id of one that is gone.
        seen[id(value)] = value
        found[name] = _title(value)
        for part, held in _parts(value).items():
            _collect(f"{name}{part}", held, found, seen)


def _title(value: Any) -> str:
    """What kind of thing it is."""
    if isinstance(value, types.FunctionType):
        return f"{value.__module__}.{value.__qualname__}"
    return type(value).__name__


def _parts(value: Any) -> dict[str, Any]:
    """What a thing holds, by what to write after its own name."""
    if isinstance(value, types.FunctionType):
        return _parts_of_function(value)
    if isinstance(value, types.MethodType):
        return {".__func__": value.__func__, ".__self__": value.__self__}
    if isinstance(value, functools.partial):
        return {".func": value.func, ".args": value.args, ".keywords": value.keywords}
    if isinstance(value, Mapping):
        return {f"[{key!r}]": value[key] for key in value}
    if isinstance(value, tuple) and hasattr(value, "_asdict"):
        return {f".{field}": held for field, held in cast(Any, value)._asdict().items()}
    if isinstance(value, list | tuple):
        return {f"[{i}]": held for i, held in enumerate(value)}
    if hasattr(value, "__wrapped__"):
        return {".__wrapped__": value.__wrapped__}
    return {f".{field}": held for field, held in getattr(value, "__dict__", {}).items()}


def _parts_of_function(function: types.FunctionType) -> dict[str, Any]:
    parts: dict[str, Any] = {}
    cells = function.__closure__ or ()
    for variable, cell in zip(function.__code__.co_freevars, cells, strict=True):
        try:
            held = cell.cell_contents
        except ValueError:
            # Not assigned yet.
            continue
        # optax's cosine schedule writes its whole numbers as floats into its closure when it is
        # first called.
        parts[f".{variable}"] = float(held) if _is_count(held) else held
    parts |= {f".default {i}": value for i, value in enumerate(function.__defaults__ or ())}
    parts |= {f".{name}": value for name, value in (function.__kwdefaults__ or {}).items()}
    return parts


def _is_count(value: Any) -> bool:
    """A whole number that is the same as a float."""
    return type(value) is int and abs(value) < 2**53


def _value(value: Any) -> str:
    """A number as it is printed, which is exact; an array by its fingerprint."""
    if not isinstance(value, jax.Array | np.ndarray | np.generic):
        return str(value)
    kind = f"{value.dtype}{list(value.shape)}"
    if is_key(value) or value.size != 1:
        return f"{kind} of fingerprint {fingerprint(value)[:12]}"
    return f"{kind} of {np.asarray(value).reshape(())[()]!s}"
