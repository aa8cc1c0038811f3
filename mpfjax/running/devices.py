"""Runs distributed over the devices of this process, and over threads of a CPU."""

import functools
import os
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import equinox as eqx
import jax.core
import jax.extend.core
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P
from jaxtyping import PyTree

from mpfjax.operations.compiling import is_traced, jit_on_wide_vectors
from mpfjax.operations.islands import DEVICE_AXIS


def available_devices() -> list[Any]:
    """The devices of this process, or JAX's default device if one is set."""
    default = getattr(jax.config, "jax_default_device", None)
    if default is None:
        return jax.local_devices()
    return jax.devices(default) if isinstance(default, str) else [default]


def over_devices(
    run: Callable[..., PyTree],
    run_on_one: Callable[..., PyTree],
    inputs: PyTree,
    arguments: tuple[PyTree, ...],
    devices: list[Any],
) -> PyTree:
    """`run(inputs, *arguments)` with the inputs dealt to the devices in blocks of equal size.

    Every leaf of the result has a leading axis k, like the inputs, and lies on the first device. If
    the number of devices does not divide k, the last input is repeated, and the extra results are
    dropped. Devices exchange only what `run` makes them exchange. `run_on_one` is compiled and does
    all runs on one device; in a program of the caller's, which device that is is left to JAX.
    """
    if len(devices) < 2 or is_traced((inputs, arguments)):
        return run_on_one(inputs, *arguments)
    num_inputs = length_of(inputs)
    padding = -num_inputs % len(devices)
    padded = _at(inputs, np.arange(num_inputs + padding)) if padding else inputs
    mesh = Mesh(np.array(devices), (DEVICE_AXIS,))
    padded = _place(padded, NamedSharding(mesh, P(DEVICE_AXIS)))
    arguments = _place(arguments, NamedSharding(mesh, P()))
    result = jax.device_put(_spread(run, padded, arguments, mesh), devices[0])
    return jax.tree.map(lambda leaf: leaf[:num_inputs], result)


def length_of(inputs: PyTree) -> int:
    return jax.tree.leaves(inputs)[0].shape[0]


def _at(inputs: PyTree, index: Any) -> PyTree:
    """The inputs of these numbers, the last one for those beyond it."""
    index = jnp.minimum(index, length_of(inputs) - 1)
    return jax.tree.map(lambda leaf: leaf[index], inputs)


@jit_on_wide_vectors
def _spread(run, inputs, arguments, mesh):
    arrays, rest = eqx.partition(arguments, eqx.is_array)

    def on_each(inputs: PyTree, arrays: PyTree) -> PyTree:
        return run(inputs, *eqx.combine(arrays, rest))

    specs = {"in_specs": (P(DEVICE_AXIS), P()), "out_specs": P(DEVICE_AXIS)}
    # With this check, every loop in a user's model would have to declare what varies over devices.
    return jax.shard_map(on_each, mesh=mesh, **specs, check_vma=False)(inputs, arrays)


def _place(tree: PyTree, sharding: NamedSharding) -> PyTree:
    """Every array of the tree moved to a sharding."""
    arrays, rest = eqx.partition(tree, lambda leaf: isinstance(leaf, jax.Array | np.ndarray))
    return eqx.combine(jax.device_put(arrays, sharding), rest)


def over_threads(
    run: Callable[..., PyTree], inputs: PyTree, arguments: tuple[PyTree, ...], num_threads: int
) -> PyTree:
    """`run(inputs, *arguments)`, compiled, with the inputs distributed over threads.

    It is for programs of many short operations, which a CPU device runs mostly one after the other.
    The blocks have equal size: the last input is repeated to fill the last block, and the extra
    results are dropped. This thread takes all of them if others would not have its settings of JAX,
    or a transformation of the caller. The operations of a block use one thread if there is a block
    for each processor, and otherwise all.
    """
    num_inputs = length_of(inputs)
    size = -(-num_inputs // num_threads)
    starts = range(0, num_inputs, size)
    program = _run_block_on_one if len(starts) >= num_processors() else _run_block

    def run_block(first: int) -> PyTree:
        return jax.block_until_ready(program(run, np.asarray(first), size, inputs, arguments))

    are_alike = _threads().submit(_thread_state).result() == _thread_state()
    blocks = (_threads().map if are_alike else map)(run_block, starts)
    return _end_to_end(list(blocks), num_inputs)


def _block_of_runs(run, first, size, inputs, arguments):
    return run(_at(inputs, first + np.arange(size)), *arguments)


_run_block = jit_on_wide_vectors(_block_of_runs)
_run_block_on_one = jit_on_wide_vectors(_block_of_runs, one_thread=True)


def num_processors() -> int:
    """How many processors this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@functools.cache
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max(2, num_processors()), thread_name_prefix="mpfjax")


def _thread_state() -> tuple[Any, ...]:
    """JAX's settings and the active transformations; where JAX does not tell, the thread itself."""
    name = "get_opaque_trace_state"  # before JAX 0.7 in jax.core
    trace_state = getattr(jax.extend.core, name, None) or getattr(jax.core, name, None)
    if trace_state is None:
        return (threading.get_ident(),)
    return dict(jax.config.values), trace_state(convention="nnx")


@partial(jax.jit, static_argnums=1)
def _end_to_end(runs: list[PyTree], length: int) -> PyTree:
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves)[:length], *runs)
