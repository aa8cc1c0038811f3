"""Compilation: on wide vectors, once for all values of a model's floats, and kept on disk."""

import contextlib
import functools
import logging
import os
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, cast

import equinox as eqx
import jax
import jax.extend.core
import jax.numpy as jnp
from jax.core import Tracer
from jax.experimental.compilation_cache import compilation_cache
from jaxtyping import PyTree

Options = dict[str, int | str]
# Since this version XLA sums on vectors, and long rows by a library, in any order.
_SUMS_ON_VECTORS = (0, 10)
_FUSION_EMITTERS = "xla_cpu_use_fusion_emitters"
_CACHE_FOLDER = "jax_compilation_cache_dir"


def cpu_options(
    soon: bool = False, one_thread: bool = False, *, older_emitters: bool = False
) -> Options:
    """The compiler's options on a CPU: vectors of 512 bits, and sums in one piece.

    XLA's default is vectors of 256 bits; a machine without wider ones uses its widest. By default
    XLA also cuts each sum and maximum into pieces of 32, in up to two kernels more, which take
    longer than the whole. Where JAX is set to optimise little, they stay, since sums are then not
    on vectors. Where a program is to be compiled `soon`, LLVM optimises less. Where each processor
    runs a program of its own, none is to be divided among threads (`one_thread`): its parts would
    only wait for each other. `older_emitters` are those of `in_little_memory`, in place of the
    vectors' width. An option that XLA_FLAGS sets is left out, and there are none on other
    platforms.
    """
    if jax.default_backend() != "cpu":
        return {}
    optimised = not jax.config.read("jax_disable_most_optimizations")
    options = _older_emitters() if older_emitters else {"xla_cpu_prefer_vector_width": 512}
    in_one_piece = optimised and jax.__version_info__[:2] >= _SUMS_ON_VECTORS
    passes = ["tree_reduction_rewriter"] * in_one_piece
    passes += ["cpu-parallel-task-assigner"] * one_thread
    if passes:
        options = options | {"xla_disable_hlo_passes": ",".join(passes)}
    if soon and optimised:
        options = options | {"xla_backend_optimization_level": 1}
    flags = os.environ.get("XLA_FLAGS", "")
    return {name: value for name, value in options.items() if name not in flags}


def jit_with(options: Options, function: Callable[..., PyTree]) -> Callable[..., PyTree]:
    """`equinox.filter_jit` with options of the compiler."""
    # Its type does not have them.
    return cast(Any, eqx.filter_jit)(function, compiler_options=options)


def jit_on_wide_vectors(
    function: Callable[..., PyTree], one_thread: bool = False, soon: bool = False
) -> Callable[..., PyTree]:
    """`equinox.filter_jit` with `cpu_options`, with which random draws take half the time.

    Such options are for a whole program. Within a transformation of the caller, they must be given
    to its own `jax.jit(..., compiler_options=...)`, or in XLA_FLAGS.
    """
    plain = eqx.filter_jit(function)
    one_at_a_time = threading.Lock()

    @functools.cache
    def wide() -> Callable[..., PyTree]:
        # Asking JAX for the platform before the first call would keep processes from joining.
        return jit_with(cpu_options(soon, one_thread), function)

    @functools.wraps(function)
    def run(*arguments: Any, **named: Any) -> PyTree:
        if not is_traced((arguments, named)):
            with one_at_a_time:  # or several threads would each compile the program
                compiled = wide()
            try:
                with _sign_of_life(function):
                    return compiled(*arguments, **named)
            except ValueError as error:
                # All arguments are constants of the caller's program, or a function among them
                # closes over a tracer.
                if "compiler_options" not in str(error):
                    raise
        return plain(*arguments, **named)

    return run


def in_little_memory(soon: bool = False) -> Options:
    """The compiler's options by which a large program is compiled in little memory on a CPU.

    XLA's newer emitters of fused operations take some 250 MB more for a program of a few thousand
    operations, which then runs about a fifth faster. Sums are in one piece, as by `cpu_options`:
    use it for short arrays, since these emitters add up long ones one number after the other. Where
    it is to be compiled `soon`, LLVM optimises less. Use that for arrays of a few dozen numbers,
    whose operations are over as soon as they have started. There are no options on other platforms,
    nor any that XLA_FLAGS sets or this XLA does not have.
    """
    return cpu_options(soon, older_emitters=True)


@functools.cache
def _older_emitters() -> Options:
    options: Options = {_FUSION_EMITTERS: False}
    try:
        jax.jit(jnp.negative, compiler_options=options)(1.0)
    except jax.errors.JaxRuntimeError:
        return {}
    return options


def enable_compilation_cache() -> Path:
    """Keep compiled programs in a folder: a later process that needs the same ones starts sooner.

    This switches on JAX's persistent compilation cache, for every program of the process, whatever
    its size and its time to compile. A program is traced and then found by its operations, its
    options, JAX and the processor; numbers in a model may differ. Nothing is ever deleted, but you
    may delete the folder at any time. Its content is executed: do not let others write to it.

    Returns the folder: `jax_compilation_cache_dir` if that is set, and otherwise `mpfjax` in the
    user's folder of caches ($XDG_CACHE_HOME, or ~/.cache). Raises `OSError` where it cannot be
    made. Use it once, at the beginning of a script or notebook; the commands of mpfjax and its
    benchmarks do.
    """
    caches = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    setting: str | None = getattr(jax.config, _CACHE_FOLDER)
    path = Path(setting or caches / "mpfjax")
    path.mkdir(parents=True, exist_ok=True)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    if str(path) != setting:
        jax.config.update(_CACHE_FOLDER, str(path))
        # An earlier compilation may have decided that there is no cache.
        compilation_cache.reset_cache()
    return path


@contextlib.contextmanager
def _sign_of_life(function: Callable[..., PyTree]) -> Iterator[None]:
    """Within it, a line is logged if the function is still being compiled after some seconds.

    One thread watches all calls, since a thread for each would take longer than a short step.
    """
    caller = threading.get_ident()
    if not _watchers:
        _watchers.append(threading.Thread(target=_watch, daemon=True))
        _watchers[0].start()
    outermost = caller not in _calls
    if outermost:
        _calls[caller] = (time.monotonic(), function)
        _has_calls.set()
    try:
        yield
    finally:
        if outermost:
            _calls.pop(caller, None)


def _watch() -> None:
    """Log a line, once, for each function whose thread is in JAX's compiler after some seconds."""
    reported: set[str] = set()
    while _has_calls.wait():
        time.sleep(PATIENCE / 4)
        if not _calls:
            _has_calls.clear()
            if _calls:  # one that came in between
                _has_calls.set()
        for caller, (start, function) in list(_calls.items()):
            frame = sys._current_frames().get(caller)
            name = f"{function.__module__}.{function.__qualname__}"
            if name in reported or time.monotonic() - start < PATIENCE or frame is None:
                continue
            modules = {at.f_globals.get("__name__") for at, _ in traceback.walk_stack(frame)}
            if modules & _COMPILERS:
                reported.add(name)
                _logger.warning(_WAITING, name)


PATIENCE = 3.0
"""Seconds of compiling after which a line says so."""
_WAITING = (
    "compiling %s for more than three seconds; later calls with the same shapes do not wait, and"
    " mpfjax.enable_compilation_cache() keeps programs for later processes. Silence this by"
    " logging.getLogger('mpfjax').setLevel('ERROR')"
)
_COMPILERS = {f"jax._src.{name}" for name in ("compiler", "interpreters.partial_eval",
                                              "interpreters.mlir")}  # fmt: skip
_logger = logging.getLogger("mpfjax")
_calls: dict[int, tuple[float, Callable[..., PyTree]]] = {}
_watchers: list[threading.Thread] = []
_has_calls = threading.Event()


def is_traced(tree: PyTree) -> bool:
    """Whether any leaf is a tracer: the caller's own transformation then decides on devices."""
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(tree))


def jit_with_floats_traced(function: Callable[..., PyTree]) -> Callable[..., PyTree]:
    """`jit_on_wide_vectors` of a function of filters or models, by `with_floats_traced`."""
    compiled = jit_on_wide_vectors(function)
    return lambda *arguments: with_floats_traced(lambda traced: compiled(*traced), arguments)


# The errors of JAX where Python asks for the value of a traced number.
_NEEDS_VALUE = (
    jax.errors.ConcretizationTypeError,
    jax.errors.TracerArrayConversionError,
    jax.errors.TracerIntegerConversionError,
)


def with_floats_traced(run: Callable[[PyTree], PyTree], filter: PyTree) -> PyTree:
    """`run(filter)`, compiled once for all values of the Python floats in it.

    Otherwise such a number would be a constant of the program, and every value would compile again.
    It stays a constant if the model uses its value in Python, as in `if self.phi > 0`. Its type is
    weak, as that of any Python number: states that it is multiplied with keep theirs.
    """
    if not any(type(leaf) is float for leaf in jax.tree.leaves(filter)):
        return run(filter)
    arrays = jax.tree.map(lambda leaf: jnp.asarray(leaf) if type(leaf) is float else leaf, filter)
    try:
        return run(arrays)
    except _NEEDS_VALUE:
        return run(filter)
