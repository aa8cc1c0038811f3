"""Checkpoints of a mixture, or of any pytree: equal to the bit when they are loaded."""

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from mpfjax.running.storage.descriptions import (
    as_numpy,
    describe,
    differences,
    is_data,
    is_key,
    is_number,
    kind,
)
from mpfjax.running.storage.files import as_path, load_arrays, read_description, write_arrays


def save_checkpoint(path: str | os.PathLike[str], state: PyTree) -> None:
    """Write a mixture, or any pytree. An online filter can go on from it, bit for bit the same.

    - `state`: arrays, typed keys and numbers in any pytree, such as `{"mixture": mixture, "t": t}`
      or a `Filter`. Of other things, such as a network's activation, only the name is written.
    - `path`: a .npz file without pickles. After an interruption it is the old file or the new one.

    Raises `ValueError` for something that is no path. Raises `OSError` if the file cannot be
    written, for example on a full disk; the old file is then still there. Call it every thousand
    steps, for example, of a filter that runs for a long time:

        state = {"mixture": filter.init(key), "t": 0}
        if path.exists():
            state = mpfjax.load_checkpoint(path, like=state)
        for t in range(state["t"], num_steps):
            mixture, info = filter.step(jax.random.fold_in(key, t), state["mixture"], receive(t))
            state = {"mixture": mixture, "t": t + 1}
            if state["t"] % 1000 == 0:
                mpfjax.save_checkpoint(path, state)
    """
    description = {"description": np.array(json.dumps(describe(state)))}
    write_arrays(as_path(path), arrays_of(state) | description)


def load_checkpoint(path: str | os.PathLike[str], like: PyTree) -> PyTree:
    """The state that `save_checkpoint` wrote, equal to it to the bit.

    - `like`: a state of the same structure, shapes, dtypes and static fields, whatever its
      values: `filter.init(key)`, or `jax.eval_shape(filter.init, key)`. Everything that is not an
      array, a key or a number is taken from it.

    Arrays come back on the default device. Raises `FileNotFoundError`. Raises `ValueError` for a
    file that is cut off, damaged, no checkpoint, or does not hold what it says, and for the
    checkpoint of another state, naming what differs.
    """
    path = as_path(path)
    arrays = load_arrays(path)
    saved, own = read_description(path, arrays), describe(like)
    if saved != own:
        raise ValueError(f"like: {path} holds another state: {differences(saved, own)}")
    return filled(path, arrays, like)


def arrays_of(state: PyTree) -> dict[str, np.ndarray]:
    """Every array, key and number of a pytree by its place, as a file can hold it."""
    arrays = {}
    for place, leaf in jax.tree_util.tree_leaves_with_path(state):
        if is_data(leaf):
            array = as_numpy(leaf)
            arrays[jax.tree_util.keystr(place)] = array.view(_stored_dtype(array.dtype))
    return arrays


def filled(path: Path, arrays: Mapping[str, np.ndarray], like: PyTree) -> PyTree:
    """A pytree like this one with the `arrays_of` another, of these dtypes but of any shapes.

    Raises `ValueError` where they do not fit.
    """
    places, structure = jax.tree_util.tree_flatten_with_path(like)
    leaves = []
    for place, leaf in places:
        name = jax.tree_util.keystr(place)
        if is_data(leaf):
            if name not in arrays:
                raise ValueError(f"{path}: damaged, it does not hold {name}")
            try:
                leaf = _as_leaf(arrays[name], leaf)
            except (TypeError, ValueError) as error:
                raise ValueError(f"{path}: damaged, {name} is not {kind(leaf)}") from error
        leaves.append(leaf)
    return structure.unflatten(leaves)


def _stored_dtype(dtype: np.dtype) -> np.dtype:
    """The dtype itself, but for bfloat16 and the like, which have no name that numpy can read."""
    return np.dtype(f"u{dtype.itemsize}") if dtype.kind == "V" else dtype


def _as_leaf(array: np.ndarray, like: Any) -> Any:
    """The array in the form of the original leaf."""
    if is_number(like):
        return type(like)(array.item())
    if is_key(like):
        implementation = jax.random.key_impl(jnp.empty((), like.dtype))
        return jax.random.wrap_key_data(jnp.asarray(array), impl=implementation)
    if array.dtype != _stored_dtype(np.dtype(like.dtype)):
        raise ValueError(f"it is {array.dtype}")
    array = array.view(like.dtype)
    if isinstance(like, np.generic):
        return array[()]
    return array if isinstance(like, np.ndarray) else jnp.asarray(array)
