"""Runs distributed over threads of this process, for a CPU that is one device of many cores."""

import functools
import os
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import jax.core
import jax.extend.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from mpfjax.operations.compiling import jit_on_wide_vectors
from mpfjax.running.devices import length_of


def over_threads(
    run: Callable[..., PyTree],
    inputs: PyTree,
    arguments: tuple[PyTree, ...],
    num_threads: int,
) -> PyTree:
    """`run(inputs, *arguments)`, compiled, with the inputs distributed over threads.

    It is for programs of many short operations, which a CPU device runs mostly one after the other.
    The blocks have equal size: the last input is repeated to fill the last block, and the extra
    results are dropped. This thread takes the first block. It takes all of them if other threads
    would not have its settings of JAX, or a transformation of the caller. The operations of a block
    use one thread if there is a block for each processor, and otherwise all.
    """
    num_inputs = length_of(inputs)
    size = -(-num_inputs // num_threads)
    starts = range(0, num_inputs, size)
    program = _run_block_on_one if len(starts) >= num_processors() else _run_block
    seen = _seen_by_thread()

    def run_block(first: int) -> PyTree:
        if _seen_by_thread() == seen:
            block = program(run, np.asarray(first), size, inputs, arguments)
            return jax.block_until_ready(block)

    first, *others = starts
    started = [_threads().submit(run_block, other) for other in others]
    blocks = [run_block(first)]
    for other, thread in zip(others, started, strict=True):
        block = thread.result()
        blocks.append(run_block(other) if block is None else block)
    return _end_to_end(blocks, num_inputs)


def _block_of_runs(run, first, size, inputs, arguments):
    index = jnp.minimum(first + np.arange(size), length_of(inputs) - 1)
    return run(jax.tree.map(lambda leaf: leaf[index], inputs), *arguments)


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


def _seen_by_thread() -> tuple[Any, ...]:
    """JAX's settings and the active transformations; where JAX does not tell, the thread itself."""
    name = "get_opaque_trace_state"  # before JAX 0.7 in jax.core
    trace_state = getattr(jax.extend.core, name, None) or getattr(jax.core, name, None)
    if trace_state is None:
        return (threading.get_ident(),)
    return dict(jax.config.values), trace_state(convention="nnx")


@partial(jax.jit, static_argnums=1)
def _end_to_end(runs: list[PyTree], length: int) -> PyTree:
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves)[:length], *runs)
