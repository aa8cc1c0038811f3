"""The file of a climb: all of its state, and a description of what it is a climb of."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from mpfjax.checks import shown
from mpfjax.running.storage import load_arrays, write_arrays
from mpfjax.tuning.identity import unlike
from mpfjax.tuning.problem import Reals


@dataclass(frozen=True)
class State:
    """Where a climb stands: all that a checkpoint holds."""

    step: int
    reals: Reals
    optimizer: PyTree
    values: tuple[float, ...] = ()
    deviations: tuple[float, ...] = ()
    path: tuple[Reals, ...] = ()
    fault: str | None = None
    """what was not finite; no further step can repair it."""


def save(path: Path, identity: dict[str, str], state: State, stopped: str | None) -> None:
    """Write the whole state, and why the climb ended, if it has."""
    arrays = {"fit": np.array(json.dumps(identity)), "step": np.array(state.step)}
    arrays["stopped"] = np.array(stopped or "")
    arrays["broken"] = np.array(state.fault is not None)
    write_arrays(path, arrays | _arrays_of(state))


def _arrays_of(state: State) -> dict[str, np.ndarray]:
    """The numbers of a state, by their names in a file."""
    arrays = {"values": np.array(state.values), "deviations": np.array(state.deviations)}
    for i, leaf in enumerate(jax.tree.leaves(state.optimizer)):
        arrays[f"optimizer {i}"] = _written(leaf)
    for name, value in state.reals.items():
        arrays[f"reals {name}"] = own = _written(value)
        rows = [_written(point[name]) for point in state.path]
        arrays[f"path {name}"] = np.array(rows, own.dtype).reshape(len(rows), *own.shape)
    return arrays


def load(path: Path, identity: dict[str, str], start: State, caller: str) -> State:
    """The state that was saved; raises `ValueError` for that of another fit, or half of one."""
    arrays = load_arrays(path)
    found = _parsed(arrays.get("fit"))
    if found is None:
        raise ValueError(f"checkpoint: {path} is no checkpoint of a climb")
    if found != identity:
        raise ValueError(f"checkpoint: {path} is of another {caller}: {unlike(found, identity)}")
    step = _check_arrays(path, arrays, start)
    leaves, structure = jax.tree.flatten(start.optimizer)
    path_of = {name: arrays[f"path {name}"] for name in start.reals}
    return State(
        step=step,
        reals={name: _read(arrays[f"reals {name}"], like) for name, like in start.reals.items()},
        optimizer=structure.unflatten(
            _read(arrays[f"optimizer {i}"], like) for i, like in enumerate(leaves)
        ),
        values=tuple(map(float, arrays["values"])),
        deviations=tuple(map(float, arrays["deviations"])),
        path=tuple(
            {name: _read(rows[k, ...], start.reals[name]) for name, rows in path_of.items()}
            for k in range(step)
        ),
        fault=str(arrays["stopped"]) if arrays["broken"] else None,
    )


def _check_arrays(path: Path, arrays: dict[str, np.ndarray], start: State) -> int:
    """The step; raises `ValueError` for arrays that are missing or of another kind."""
    step = arrays.get("step", np.array(-1))
    if step.shape != () or step.dtype.kind != "i" or step < 1:
        raise ValueError(f"checkpoint: {path} is damaged: its step is {shown(step)}")
    expected: dict[str, tuple[tuple[int, ...], str]] = {
        "stopped": ((), "U"),
        "broken": ((), "b"),
    }
    for name, array in _arrays_of(start).items():
        by_step = name in ("values", "deviations") or name.startswith("path ")
        shape = (int(step), *array.shape[1:]) if by_step else array.shape
        expected[name] = (shape, array.dtype.name)
    for name, (shape, kind) in expected.items():
        if name not in arrays:
            raise ValueError(f"checkpoint: {path} is damaged: it lacks the array {name!r}")
        array = arrays[name]
        if array.shape != shape or kind not in (array.dtype.name, array.dtype.kind):
            raise ValueError(
                f"checkpoint: {path} is damaged: {name!r} is {array.dtype}{list(array.shape)},"
                f" not {kind}{list(shape)}"
            )
    return int(step)


def _written(leaf: Any) -> np.ndarray:
    """A number of a state as a file can hold it."""
    if isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        leaf = jax.random.key_data(leaf)
    array = np.asarray(leaf)
    # numpy has no name for bfloat16 and the like, and could not read them back.
    return array.view(f"u{array.itemsize}") if array.dtype.kind == "V" else array


def _read(array: np.ndarray, like: Any) -> Array:
    """The number that was written, with the type of `like`."""
    if isinstance(like, jax.Array) and jnp.issubdtype(like.dtype, jax.dtypes.prng_key):
        return jax.random.wrap_key_data(jnp.asarray(array), impl=jax.random.key_impl(like))
    return jnp.asarray(array.view(like.dtype) if hasattr(like, "dtype") else array)


def _parsed(description: np.ndarray | None) -> dict[str, str] | None:
    """What a file says that it is of, or None for one that says nothing."""
    try:
        identity = json.loads(str(description))
    except ValueError:
        return None
    return identity if isinstance(identity, dict) else None
