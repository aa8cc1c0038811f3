"""Work spread over devices and processes, and what islands of particles tell each other."""

import functools
import hashlib
import math
import os
import sys
import threading
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.extend.core
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P
from jaxtyping import Array, Float, Int, PyTree

from mpfjax.operations import finite_max, log_sum_exp

DEVICE_AXIS = "mpfjax_devices"
ISLAND_AXIS = "mpfjax_islands"
_VECTOR_WIDTH = "xla_cpu_prefer_vector_width"


def join_processes(
    coordinator_address: str | None = None,
    num_processes: int | None = None,
    process_id: int | None = None,
    *,
    timeout_seconds: float = 300.0,
) -> None:
    """Join the other processes of a study, so that each sees the devices of all.

    The same script runs in every process, and calls this before anything else of JAX. Then
    `monte_carlo` and `run_islands` spread over all devices of all processes: each process makes
    the same calls with the same arguments, and gets the whole result. It is
    `jax.distributed.initialize` with a time limit that ends in words.

    - Under SLURM, Open MPI or Kubernetes nothing is given: JAX asks the scheduler.
    - Elsewhere `coordinator_address` is "host:port" of process 0, `num_processes` how many there
      are, and `process_id` which one this is, from 0.

    Raises `ValueError` where no cluster is found or an argument is out of range, and RuntimeError
    where JAX is in use already. Where some process has not joined within `timeout_seconds` there
    is no exception, since nothing interrupts JAX's own wait: this process says so on stderr and
    ends with exit status 1.
    """
    if not timeout_seconds > 0:
        raise ValueError(f"timeout_seconds: {timeout_seconds} is not positive")
    if None not in (process_id, num_processes) and process_id not in range(num_processes or 0):
        raise ValueError(f"process_id: {process_id} is not in [0, {num_processes})")
    if getattr(jax.config, "jax_cpu_collectives_implementation", None) in (None, "none"):
        jax.config.update("jax_cpu_collectives_implementation", "gloo")
    joined = threading.Event()
    who = "this process" if process_id is None else f"process {process_id} of {num_processes}"
    where = "the cluster's coordinator" if coordinator_address is None else coordinator_address

    def end_when_late() -> None:
        if not joined.wait(timeout_seconds):
            print(
                f"join_processes: {who} has waited {timeout_seconds:g} s for all processes to"
                f" join at {where}. Some process never started, cannot reach that address, or was"
                " told another number of processes. This process ends now.",
                file=sys.stderr,
                flush=True,
            )
            os._exit(1)

    threading.Thread(target=end_when_late, daemon=True).start()
    try:
        # JAX's own limit aborts the process with a stack trace: ours must come first.
        jax.distributed.initialize(
            coordinator_address,
            num_processes,
            process_id,
            initialization_timeout=math.ceil(timeout_seconds) + 60,
        )
    except ValueError as error:
        raise ValueError(
            f"coordinator_address, num_processes, process_id: {error} No scheduler was found that"
            " knows them: give all three."
        ) from error
    finally:
        joined.set()


def choose_devices(devices: int | Sequence[Any] | None) -> list[Any]:
    """The devices that are meant: all, the first few, or those given.

    None is every device of every process; JAX's default device alone where one is set. Raises
    `ValueError` for more devices than there are, none at all, a device twice, and, under several
    processes, for devices that leave a process out.
    """
    available = jax.devices()
    if devices is None:
        chosen = _default_devices(available)
    elif isinstance(devices, int | np.integer) and not isinstance(devices, bool):
        if not 1 <= devices <= len(available):
            raise ValueError(f"devices: {devices} asked for, and there are {len(available)}")
        chosen = available[: int(devices)]
    else:
        chosen = list(devices) if isinstance(devices, Iterable) and not _is_array(devices) else []
        if not chosen or not all(isinstance(device, jax.Device) for device in chosen):
            raise ValueError(f"devices: {devices} is not a number or some of jax.devices()")
        if len(set(chosen)) < len(chosen):
            raise ValueError(f"devices: {devices} names one twice")
    idle = jax.process_count() - len({device.process_index for device in chosen})
    if jax.process_count() > 1 and idle:
        raise ValueError(f"devices: {chosen} leaves {idle} of the processes without any")
    return chosen


def wide_vectors() -> dict[str, int]:
    """The compiler's options for vectors of 512 bits on a CPU, where XLA keeps to 256 by default.

    A machine without such vectors takes its widest. Nothing on other platforms, and where
    XLA_FLAGS sets the width.
    """
    is_set = _VECTOR_WIDTH in os.environ.get("XLA_FLAGS", "")
    return {} if is_set or jax.default_backend() != "cpu" else {_VECTOR_WIDTH: 512}


def jit_on_wide_vectors(function: Callable[..., PyTree]) -> Callable[..., PyTree]:
    """`equinox.filter_jit` with `wide_vectors`, on which the generator takes half the time.

    Such options are a whole program's: within a transformation of the caller's they are left to
    its own `jax.jit(..., compiler_options=...)`, or XLA_FLAGS.
    """
    plain = eqx.filter_jit(function)

    @functools.cache
    def wide() -> Callable[..., PyTree]:
        # To ask for the platform before the first call would keep processes from joining.
        with_options: Any = eqx.filter_jit
        return with_options(function, compiler_options=wide_vectors())

    @functools.wraps(function)
    def run(*arguments: Any, **named: Any) -> PyTree:
        if not is_traced((arguments, named)):
            try:
                return wide()(*arguments, **named)
            except ValueError as error:
                # Where all arguments are constants of the caller's program, or a function among
                # them closes over a tracer.
                if "compiler_options" not in str(error):
                    raise
        return plain(*arguments, **named)

    return run


def is_traced(tree: PyTree) -> bool:
    """Whether any leaf is a tracer: the caller's own transformation then decides on devices."""
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(tree))


def over_devices(
    run: Callable[..., PyTree],
    run_on_one: Callable[..., PyTree],
    inputs: PyTree,
    arguments: tuple[PyTree, ...],
    devices: list[Any] | None,
) -> PyTree:
    """`run(inputs, *arguments)` with the inputs dealt to the devices in blocks of equal size.

    Every leaf of the result has a leading axis k, like the inputs, and lies on the first device,
    or on the first one of each process. The last input is repeated where the number of devices
    does not divide k, and its results are dropped. Devices tell each other only what `run` has
    them tell. `run_on_one`, compiled already, does all on one device; None leaves which to JAX.
    """
    traced = is_traced((inputs, arguments))
    if devices is None or len(devices) == 1:
        if not traced and devices not in (None, jax.devices()[:1]):
            inputs, arguments = _placed((inputs, arguments), devices[0])
        return run_on_one(inputs, *arguments)
    num_inputs = _length(inputs)
    padding = -num_inputs % len(devices)
    padded = _filled_up(inputs, num_inputs + padding)
    mesh = Mesh(np.array(devices), (DEVICE_AXIS,))
    if not traced:
        padded = _placed(padded, NamedSharding(mesh, P(DEVICE_AXIS)))
        arguments = _placed(arguments, NamedSharding(mesh, P()))
    result = _spread(run, padded, arguments, mesh)
    if not traced:
        result = _gathered(result, mesh)
    if padding:
        result = jax.tree.map(lambda leaf: leaf[:num_inputs], result)
    return result


def over_threads(
    run: Callable[..., PyTree],
    inputs: PyTree,
    arguments: tuple[PyTree, ...],
    num_threads: int,
) -> PyTree:
    """`run(inputs, *arguments)`, compiled, with the inputs dealt to threads of this process.

    For programs of many short operations, which a CPU device does mostly one after the other. The
    blocks are of equal size; the last input fills up the last of them, and what comes of that is
    dropped. This thread takes the first block, and all that are left by threads which would not
    see what it sees: a setting of JAX that holds for it alone, or a transformation of the caller's.
    """
    num_inputs = _length(inputs)
    size = -(-num_inputs // num_threads)
    seen = _seen_by_thread()

    def run_block(first: int) -> PyTree:
        if _seen_by_thread() == seen:
            block = _run_block(run, np.asarray(first), size, inputs, arguments)
            return jax.block_until_ready(block)

    first, *others = range(0, num_inputs, size)
    started = [_threads().submit(run_block, other) for other in others]
    blocks = [run_block(first)]
    for other, thread in zip(others, started, strict=True):
        block = thread.result()
        blocks.append(run_block(other) if block is None else block)
    return _end_to_end(blocks, num_inputs)


@jit_on_wide_vectors
def _run_block(run, first, size, inputs, arguments):
    index = jnp.minimum(first + np.arange(size), _length(inputs) - 1)
    return run(jax.tree.map(lambda leaf: leaf[index], inputs), *arguments)


def _length(inputs: PyTree) -> int:
    return jax.tree.leaves(inputs)[0].shape[0]


def _filled_up(inputs: PyTree, length: int) -> PyTree:
    """As many inputs, of which the last is repeated."""
    last = _length(inputs) - 1
    if length == last + 1:
        return inputs
    return jax.tree.map(lambda leaf: leaf[np.minimum(np.arange(length), last)], inputs)


def num_processors() -> int:
    """How many processors this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@functools.cache
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max(2, num_processors()), thread_name_prefix="mpfjax")


def _seen_by_thread() -> tuple[Any, ...]:
    """JAX's settings, and which transformations go on. Of an old JAX it cannot be told."""
    trace_state = getattr(jax.extend.core, "get_opaque_trace_state", None)
    if trace_state is None:
        return (threading.get_ident(),)
    return dict(jax.config.values), trace_state(convention="nnx")


@partial(jax.jit, static_argnums=1)
def _end_to_end(runs: list[PyTree], length: int) -> PyTree:
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves)[:length], *runs)


@jit_on_wide_vectors
def _spread(run, inputs, arguments, mesh):
    arrays, rest = eqx.partition(arguments, eqx.is_array)

    def on_each(inputs: PyTree, arrays: PyTree) -> PyTree:
        return run(inputs, *eqx.combine(arrays, rest))

    # The check of what varies over devices would ask every loop in a user's model to declare it.
    mapped = jax.shard_map(
        on_each,
        mesh=mesh,
        in_specs=(P(DEVICE_AXIS), P()),
        out_specs=P(DEVICE_AXIS),
        check_vma=False,
    )
    return mapped(inputs, arrays)


def num_islands() -> int:
    """Into how many islands the particles are dealt; 1 outside `run_islands`."""
    try:
        # Constants, known as the program is traced.
        return jax.lax.psum(1, ISLAND_AXIS) * jax.lax.psum(1, DEVICE_AXIS)
    except NameError:
        return 1


def island_index() -> Int[Array, ""]:
    """Which island this is, from 0. Only inside `run_islands`."""
    first = jax.lax.axis_index(DEVICE_AXIS) * jax.lax.psum(1, ISLAND_AXIS)
    return first + jax.lax.axis_index(ISLAND_AXIS)


def over_islands(value: Array) -> Array:
    """The values of all islands, in their order, on a new leading axis; the same for each.

    The order does not depend on how many devices there are, so that neither does a sum.
    """
    on_device = jax.lax.all_gather(value, ISLAND_AXIS)
    everywhere = jax.lax.all_gather(on_device, DEVICE_AXIS)
    return everywhere.reshape(-1, *value.shape)


def deal_to_islands(values: Array) -> Array:
    """Row i of every island to island i mod G; the leading axis must be a multiple of G.

    Dealing twice brings the rows of an island back to it, in another order.
    """
    num_devices, on_device = jax.lax.psum(1, DEVICE_AXIS), jax.lax.psum(1, ISLAND_AXIS)
    # Under vmap JAX 0.10 gets the shape wrong of a value that is known to be the same everywhere.
    values = jnp.where(island_index() >= 0, values, values)
    dealt = values.reshape(-1, num_devices, on_device, *values.shape[1:])
    dealt = jax.lax.all_to_all(dealt, ISLAND_AXIS, split_axis=2, concat_axis=2)
    dealt = jax.lax.all_to_all(dealt, DEVICE_AXIS, split_axis=1, concat_axis=1)
    return dealt.reshape(values.shape)


def excess_over_islands(
    log_scale: Float[Array, ""], log_largest: Float[Array, ""], log_sum: Float[Array, ""]
) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]:
    """How far an island's own scale is above that of all, and log of all mass in two parts.

    The mass of an island is given in three parts, scale + largest + sum, and that of all islands
    comes out as total + scale, so that none rounds another away. O(1) numbers from each island;
    outside `run_islands` there is one, and nothing above it.
    """
    if num_islands() == 1:
        return jnp.zeros_like(log_sum), log_sum, log_scale + log_largest
    scales, largest, sums = over_islands(jnp.stack([log_scale, log_largest, log_sum])).T
    counts = sums > -jnp.inf
    # Part by part, exactly: an island without mass has no say.
    common = finite_max(jnp.where(counts, scales, -jnp.inf))
    shift = finite_max(jnp.where(counts, (scales - common) + largest, -jnp.inf))
    log_total = log_sum_exp(sums + (((scales - common) + largest) - shift))
    return ((log_scale - common) + log_largest) - shift, log_total, common + shift


def _is_array(value: Any) -> bool:
    return isinstance(value, jax.Array | np.ndarray)


def _default_devices(available: list[Any]) -> list[Any]:
    default = getattr(jax.config, "jax_default_device", None)
    if default is None:
        return available
    return jax.devices(default) if isinstance(default, str) else [default]


def _placed(tree: PyTree, where: Any) -> PyTree:
    """Every array of the tree on a device or as a sharding says, wherever it was."""
    is_array = lambda leaf: isinstance(leaf, jax.Array | np.ndarray)  # noqa: E731
    arrays, rest = eqx.partition(tree, is_array)
    if jax.process_count() == 1:
        return eqx.combine(jax.device_put(arrays, where), rest)
    _require_same_everywhere(arrays)
    return eqx.combine(jax.tree.map(lambda leaf: _global(leaf, where), arrays), rest)


def _require_same_everywhere(arrays: PyTree) -> None:
    """Raise where the processes do not hold the same numbers; a digest is all that they send."""
    digest = hashlib.sha256()
    for leaf in jax.tree.leaves(arrays):
        if not _is_global(leaf):
            values = np.asarray(jax.random.key_data(leaf) if _is_key(leaf) else leaf)
            digest.update(f"{values.dtype} {values.shape}".encode() + values.tobytes())
    own = np.frombuffer(digest.digest(), np.uint8)
    if (multihost_utils.process_allgather(own) != own[None]).any():
        raise ValueError("keys, filter, observations: not the same in every process")


def _global(leaf: Any, sharding: NamedSharding) -> Array:
    """An array over all processes, of which each holds a copy of the whole."""
    if _is_global(leaf):
        return leaf
    if _is_key(leaf):
        data = _global(jax.random.key_data(leaf), sharding)
        return jax.random.wrap_key_data(data, impl=jax.random.key_impl(leaf))
    values = np.asarray(jnp.asarray(leaf))
    return jax.make_array_from_callback(values.shape, sharding, lambda index: values[index])


def _is_global(leaf: Any) -> bool:
    return isinstance(leaf, jax.Array) and not leaf.is_fully_addressable


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _gathered(tree: PyTree, mesh: Mesh) -> PyTree:
    if jax.process_count() == 1:
        return jax.device_put(tree, mesh.devices.flat[0])
    everywhere = jax.jit(lambda tree: tree, out_shardings=NamedSharding(mesh, P()))(tree)
    return jax.tree.map(lambda leaf: leaf.addressable_data(0), everywhere)
