"""Descriptions of a pytree or a function, as text by which two runs are compared."""

import dataclasses
import hashlib
import json
import re
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import PyTree

_MOST_SHOWN = 4


def describe(tree: PyTree, *, values: bool = False) -> dict[str, str]:
    """Every leaf's shape and dtype, every static field, and what else there is, by its place.

    With `values`, numbers are described by their values and arrays by a fingerprint as well.
    """
    of_leaf = _value if values else kind
    return _static_fields(tree, ()) | {
        jax.tree_util.keystr(place): of_leaf(leaf) if is_data(leaf) else named(leaf)
        for place, leaf in jax.tree_util.tree_leaves_with_path(tree)
    }


def fingerprint(tree: PyTree) -> str:
    """SHA-256 of all that a pytree holds: its description and its arrays' bytes."""
    digest = hashlib.sha256(json.dumps(describe(tree)).encode())
    for leaf in filter(is_data, jax.tree.leaves(tree)):
        digest.update(as_numpy(leaf).tobytes())
    return digest.hexdigest()


def program_of(function: Callable[..., Any], *arguments: Any) -> str:
    """A fingerprint of what JAX traces of a function: that of all that do the same.

    It tells apart functions of other code, and those that hold other numbers.
    """
    program, *_ = eqx.filter_make_jaxpr(function)(*arguments)
    return fingerprint((named(program.jaxpr), list(_constants(program))))[:12]


def _constants(program: Any) -> Iterator[Any]:
    """All arrays that a program of JAX holds, those of programs within it as well."""
    yield from getattr(program, "consts", ())
    inner = getattr(program, "jaxpr", program)
    for equation in inner.eqns:
        for value in jax.tree.leaves(list(equation.params.values())):
            if hasattr(value, "eqns") or hasattr(value, "jaxpr"):
                yield from _constants(value)


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
    return value if isinstance(value, str) else re.sub(r" at 0x[0-9a-f]+", "", repr(value))


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


def _value(leaf: Any) -> str:
    """A number as it is printed, which is exact; an array by its fingerprint."""
    if is_number(leaf):
        return str(leaf)
    if is_key(leaf) or leaf.size != 1:
        return f"{kind(leaf)} of fingerprint {fingerprint(leaf)[:12]}"
    return f"{kind(leaf)} of {np.asarray(leaf).reshape(())[()]!s}"


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
