"""Files that are written whole or not at all, and that load without running code."""

import dataclasses
import hashlib
import json
import os
import re
import zipfile
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

_DESCRIPTION = "description"


def save_checkpoint(path: str | os.PathLike[str], state: PyTree) -> None:
    """Write a mixture, or any pytree, from which an online filter goes on bit for bit.

    - `state`: arrays, typed keys and numbers in any pytree, such as `{"mixture": mixture, "t": t}`
      or a `Filter`. What else it holds, a network's activation say, is only written down by name.
    - `path`: a .npz file without pickles. An interruption leaves the old one or the new one.

    Raises `OSError` where it cannot be written, a full disk say: what was there is still there.
    Use it every so many steps of a filter that runs for long:

        state = {"mixture": filter.init(key), "t": 0}
        if path.exists():
            state = mpfjax.load_checkpoint(path, like=state)
        for t in range(state["t"], num_steps):
            mixture, info = filter.step(jax.random.fold_in(key, t), state["mixture"], receive(t))
            state = {"mixture": mixture, "t": t + 1}
            if state["t"] % 1000 == 0:
                mpfjax.save_checkpoint(path, state)
    """
    arrays = {}
    for place, leaf in jax.tree_util.tree_leaves_with_path(state):
        if _is_data(leaf):
            array = _as_numpy(leaf)
            # numpy has no name of its own for bfloat16 and the like, which would not come back.
            arrays[jax.tree_util.keystr(place)] = (
                array.view(f"u{array.itemsize}") if array.dtype.kind == "V" else array
            )
    write_arrays(path, arrays | {_DESCRIPTION: np.array(json.dumps(describe(state)))})


def load_checkpoint(path: str | os.PathLike[str], like: PyTree) -> PyTree:
    """The state that `save_checkpoint` wrote, equal to it to the bit.

    - `like`: a state of the same structure, shapes, dtypes and static fields, whatever its
      values: `filter.init(key)`, or `jax.eval_shape(filter.init, key)`. What is no array, key or
      number is taken from it.

    Arrays come back on the default device. Raises `FileNotFoundError`, and `ValueError` for a file
    that is cut off, damaged or no checkpoint, or for one of another state, naming what differs.
    """
    arrays = load_arrays(path)
    if _DESCRIPTION not in arrays:
        raise ValueError(f"{path}: no checkpoint, for it does not describe what it holds")
    saved, own = json.loads(str(arrays[_DESCRIPTION])), describe(like)
    if saved != own:
        raise ValueError(f"like: {path} holds another state: {differences(saved, own)}")
    places, structure = jax.tree_util.tree_flatten_with_path(like)
    return structure.unflatten(
        _as_leaf(arrays[jax.tree_util.keystr(place)], leaf) if _is_data(leaf) else leaf
        for place, leaf in places
    )


def describe(tree: PyTree) -> dict[str, str]:
    """Every leaf's shape and dtype, every static field, and what else there is, by its place."""
    return _static_fields(tree, ()) | {
        jax.tree_util.keystr(place): _kind(leaf) if _is_data(leaf) else named(leaf)
        for place, leaf in jax.tree_util.tree_leaves_with_path(tree)
    }


def fingerprint(tree: PyTree) -> str:
    """SHA-256 of all that a pytree holds: its description and its arrays' bytes."""
    digest = hashlib.sha256(json.dumps(describe(tree)).encode())
    for leaf in filter(_is_data, jax.tree.leaves(tree)):
        digest.update(_as_numpy(leaf).tobytes())
    return digest.hexdigest()


def differences(there: Mapping[str, Any], here: Mapping[str, Any]) -> str:
    """In words, where two descriptions differ."""
    found = []
    for name in sorted(there.keys() | here.keys()):
        if name not in there:
            found.append(f"{name} is only here")
        elif name not in here:
            found.append(f"{name} is only there")
        elif there[name] != here[name]:
            found.append(f"{name} is {there[name]} there and {here[name]} here")
    return "; ".join(found)


def named(value: Any) -> str:
    """A function, or another thing without a value, in words that are the same in every process."""
    return re.sub(r" at 0x[0-9a-f]+", "", repr(value))


def write_whole(path: str | os.PathLike[str], write: Callable[[BinaryIO], object]) -> None:
    """Write a file so that an interruption or an error leaves the old one or the new one.

    Raises `OSError` that names the file where there is no room for it, or no permission.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(path.name + ".partial")
    try:
        with open(partial, "wb") as file:
            write(file)
            file.flush()
            # Without it a power cut could leave the new name on a file that is not there yet.
            os.fsync(file.fileno())
        os.replace(partial, path)
    except BaseException as error:
        partial.unlink(missing_ok=True)
        if isinstance(error, OSError):
            fault = f"{error.strerror or error}; nothing that was written before is lost"
            raise OSError(error.errno, fault, str(path)) from error
        raise


def write_arrays(path: str | os.PathLike[str], arrays: Mapping[str, np.ndarray]) -> None:
    """Write arrays by name as .npz, whole or not at all; `np.load` reads it without pickles.

    Raises `ValueError` for an array that could not be read so, and `OSError` as `write_whole`.
    """
    for name, array in arrays.items():
        if array.dtype.hasobject or array.dtype.kind == "V":
            raise ValueError(f"{name}: an array of {array.dtype} does not load without pickles")

    def write(file: BinaryIO) -> None:
        # Not by np.savez, to which an array named "file" would be its own first argument.
        with zipfile.ZipFile(file, "w") as archive:
            for name, array in arrays.items():
                with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                    np.lib.format.write_array(member, array, allow_pickle=False)

    write_whole(path, write)


# What a flipped bit may lead to; where it names an unknown compression or an encryption, the last.
_DAMAGE = (zipfile.BadZipFile, zlib.error, EOFError, OSError, ValueError, RuntimeError)


def load_arrays(path: str | os.PathLike[str]) -> dict[str, np.ndarray]:
    """The arrays of a .npz file; `ValueError` for one that is cut off, damaged or no such file."""
    arrays = {}
    with open(path, "rb") as file:
        try:
            with zipfile.ZipFile(file) as archive:
                for name in archive.namelist():
                    with archive.open(name) as member:
                        array = np.lib.format.read_array(member, allow_pickle=False)
                    arrays[name.removesuffix(".npy")] = array
        except _DAMAGE as error:
            raise ValueError(f"{path}: cut off, damaged or no .npz file ({error})") from error
    return arrays


def _is_data(leaf: Any) -> bool:
    arrays = (jax.Array, np.ndarray, np.generic, jax.ShapeDtypeStruct)
    return isinstance(leaf, (*arrays, bool, int, float, complex))


def _is_number(leaf: Any) -> bool:
    return isinstance(leaf, bool | int | float | complex) and not isinstance(leaf, np.generic)


def _kind(leaf: Any) -> str:
    if _is_number(leaf):
        return f"a Python {type(leaf).__name__}"
    return f"{leaf.dtype}{list(leaf.shape)}"


def _is_key(leaf: Any) -> bool:
    return not _is_number(leaf) and jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _as_numpy(leaf: Any) -> np.ndarray:
    return np.asarray(jax.random.key_data(leaf) if _is_key(leaf) else leaf)


def _as_leaf(array: np.ndarray, like: Any) -> Any:
    """The array in the form of the leaf that it was."""
    if _is_number(like):
        return type(like)(array.item())
    if _is_key(like):
        implementation = jax.random.key_impl(jnp.empty((), like.dtype))
        return jax.random.wrap_key_data(jnp.asarray(array), impl=implementation)
    array = array.view(like.dtype)
    if isinstance(like, np.generic):
        return array[()]
    return array if isinstance(like, np.ndarray) else jnp.asarray(array)


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
