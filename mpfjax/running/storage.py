"""Checkpoints, their files, and descriptions by which two states are compared.

A file is written completely or not at all, and loads without running code.
"""

import dataclasses
import hashlib
import json
import os
import re
import secrets
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from mpfjax.checks import is_key

FilePath = str | os.PathLike[str]

_MOST_SHOWN = 4
_DESCRIPTION = "description"


def save_checkpoint(path: FilePath, state: PyTree) -> None:
    """Write a mixture, or any pytree, from which an online filter can continue, bit for bit.

    - `state`: arrays, typed keys and numbers in any pytree, such as `{"mixture": mixture, "t": t}`
      or a `Filter`. Of other objects, such as a network's activation, only the name is written.
    - `path`: a .npz file without pickles. If writing is interrupted, the old file remains.

    Raises `ValueError` for numbers without a type in numpy, such as bfloat16, and `OSError` if the
    file cannot be written, for example on a full disk; the old file then remains. Call it every
    thousand steps, for example, of a filter that runs for a long time:

        state = {"mixture": filter.init(key), "t": 0}
        if path.exists():
            state = mpfjax.load_checkpoint(path, like=state)
        for t in range(state["t"], num_steps):
            mixture, info = filter.step(jax.random.fold_in(key, t), state["mixture"], receive(t))
            state = {"mixture": mixture, "t": t + 1}
            if state["t"] % 1000 == 0:
                mpfjax.save_checkpoint(path, state)
    """
    write_described(path, arrays_of(state), describe(state))


def load_checkpoint(path: FilePath, like: PyTree) -> PyTree:
    """The state that `save_checkpoint` wrote, equal to it to the bit.

    - `like`: a state of the same structure, shapes, dtypes and static fields, with any values:
      `filter.init(key)`, or `jax.eval_shape(filter.init, key)`. Everything that is not an array, a
      key or a number is copied from it.

    Arrays are loaded to the default device. Raises `FileNotFoundError`. Raises `ValueError` for a
    file that is truncated, damaged, not a checkpoint, or inconsistent, and for the checkpoint of
    another state, naming the difference.
    """
    (arrays, saved), expected = read_described(path), describe(like)
    if saved != expected:
        raise ValueError(f"like: {path} contains another state: {differences(saved, expected)}")
    return tree_of_arrays(path, arrays, like)


def arrays_of(state: PyTree) -> dict[str, np.ndarray]:
    """Every array, key and number of a pytree by its place, as a file can hold it."""
    leaves = jax.tree_util.tree_leaves_with_path(state)
    return {jax.tree_util.keystr(place): as_numpy(leaf) for place, leaf in leaves if is_data(leaf)}


def tree_of_arrays(path: FilePath, arrays: Mapping[str, np.ndarray], like: PyTree) -> PyTree:
    """A pytree like this one with the `arrays_of` another, of these dtypes but of any shapes.

    Raises `ValueError` where they do not fit.
    """
    places, structure = jax.tree_util.tree_flatten_with_path(like)
    leaves = []
    for place, leaf in places:
        name = jax.tree_util.keystr(place)
        try:
            leaves.append(_as_leaf(arrays[name], leaf) if is_data(leaf) else leaf)
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"{path}: damaged, {name} is not {kind(leaf)}") from error
    return structure.unflatten(leaves)


def _as_leaf(array: np.ndarray, like: Any) -> Any:
    """The array in the form of the original leaf."""
    if is_number(like):
        return type(like)(array.item())
    if is_key(like):
        implementation = jax.random.key_impl(jnp.empty((), like.dtype))
        return jax.random.wrap_key_data(jnp.asarray(array), impl=implementation)
    if array.dtype != like.dtype:
        raise TypeError(array.dtype)
    if isinstance(like, np.generic):
        return array[()]
    return array if isinstance(like, np.ndarray) else jnp.asarray(array)


def describe(tree: PyTree, *, values: bool = False) -> dict[str, str]:
    """Every leaf's shape and dtype, every static field, and what else there is, by its place.

    With `values`, numbers are described by their values and arrays by a fingerprint as well.
    """
    of_leaf = _value if values else kind
    return _static_fields(tree, ()) | {
        jax.tree_util.keystr(place): of_leaf(leaf) if is_data(leaf) else stable_name(leaf)
        for place, leaf in jax.tree_util.tree_leaves_with_path(tree)
    }


def describe_parts(**parts: PyTree) -> dict[str, str]:
    """All leaves of some pytrees with their values, by part and place."""
    texts = {part: describe(tree, values=True) for part, tree in parts.items()}
    return {f"{part}{place}": text for part in texts for place, text in texts[part].items()}


def fingerprint(tree: PyTree) -> str:
    """SHA-256 of all that a pytree holds: its description and its arrays' bytes."""
    digest = hashlib.sha256(json.dumps(describe(tree)).encode())
    for leaf in filter(is_data, jax.tree.leaves(tree)):
        digest.update(as_numpy(leaf).tobytes())
    return digest.hexdigest()


def differences(there: Mapping[str, Any], here: Mapping[str, Any]) -> str:
    """The first few differences between two descriptions, in words."""
    parts = [
        f"{name} is {there.get(name, 'not')} there and {here.get(name, 'not')} here"
        for name in sorted(there.keys() | here.keys())
        if there.get(name) != here.get(name)
    ]
    more = len(parts) - _MOST_SHOWN
    return "; ".join(parts[:_MOST_SHOWN]) + (f"; and {more} more" if more > 0 else "")


def stable_name(value: Any) -> str:
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
    texts = {}
    if isinstance(tree, eqx.Module):
        start = jax.tree_util.keystr(place)
        texts[f"{start}.__class__"] = type(tree).__name__
        for field in dataclasses.fields(tree):
            if field.metadata.get("static", False):
                texts[f"{start}.{field.name}"] = stable_name(getattr(tree, field.name, None))

    def is_inner(node: Any) -> bool:
        return node is not tree and isinstance(node, eqx.Module)

    for inner, node in jax.tree_util.tree_leaves_with_path(tree, is_leaf=is_inner):
        if is_inner(node):
            texts |= _static_fields(node, place + inner)
    return texts


def write_whole(path: FilePath, write: Callable[[BinaryIO], object]) -> None:
    """Write a file so that an interruption or an error leaves the old one or the new one.

    Several threads and processes may write one path. The file is that of the last one to end, and
    it is whole whenever it is read. Raises `OSError` that names the file where there is no room for
    it, or no permission.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    # Writers that shared a name would write into each other's file, and take it from each other.
    partial = path.with_name(f"{path.name}.{secrets.token_hex(8)}.partial")
    try:
        with open(partial, "xb") as file:
            write(file)
            file.flush()
            # Without it, the file could be empty under its new name after a power cut.
            os.fsync(file.fileno())
        os.replace(partial, path)
    except BaseException as error:
        partial.unlink(missing_ok=True)
        if isinstance(error, OSError):
            fault = f"{error.strerror or error}; nothing that was written before is lost"
            raise OSError(error.errno, fault, str(path)) from error
        raise


def write_json(path: Path, content: Any) -> None:
    """Write `content` so that an interruption leaves the old file or the new one, never half."""
    text = json.dumps(content, indent=1, allow_nan=False) + "\n"
    write_whole(path, lambda file: file.write(text.encode()))


def write_described(
    path: FilePath, arrays: Mapping[str, np.ndarray], description: Mapping[str, Any]
) -> None:
    """Write arrays by name as .npz, and a description that JSON can hold; whole or not at all.

    `np.load` reads it without pickles. Raises `ValueError` for an array that could not be read so,
    and `OSError` as `write_whole`.
    """
    for name, array in arrays.items():
        if array.dtype.hasobject or array.dtype.kind == "V":
            raise ValueError(f"{name}: an array of {array.dtype} does not load without pickles")
    content: dict[str, Any] = {**arrays, _DESCRIPTION: np.array(json.dumps(description))}
    write_whole(path, lambda file: np.savez(file, **content))


def read_described(path: FilePath) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """The arrays and the description that `write_described` wrote; `ValueError` for other files."""
    with open(path, "rb") as file:
        try:
            archive = np.load(file, allow_pickle=False)
            # What is no array comes as bytes, which have no view.
            arrays = {name: archive[name].view() for name in archive.files}
            return arrays, dict(json.loads(str(arrays.pop(_DESCRIPTION))))
        except Exception as error:  # a flipped bit may lead to any
            fault = f"{path}: cut off, damaged or without description ({error})"
            raise ValueError(fault) from error
