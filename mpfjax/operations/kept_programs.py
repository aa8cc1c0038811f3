"""Programs of the library that a later process starts without tracing them again.

JAX's own cache finds a program by its operations, which have to be traced and lowered first: for a
large program most of the remaining time. Here a program is found by what it is made from: the
library's source, the structure and types of its arguments, the settings, the versions and the
processor.
"""

import contextlib
import dataclasses
import functools
import hashlib
import importlib.metadata
import io
import os
import pickle
import platform
import re
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
from jax.experimental import serialize_executable
from jaxtyping import Array, PyTree

from mpfjax.operations.compiling import is_traced, kept_folder

# Code whose changes are detected: the library's by its source, others' by their versions.
_LIBRARY = __name__.partition(".")[0]
_DEPENDENCIES = ("jax", "jaxlib", "equinox", "jaxtyping", "numpy", "optax")
_KNOWN = {_LIBRARY, *_DEPENDENCIES, "builtins", "functools", "jax.numpy", "ml_dtypes"}
# Where files are kept and what is printed changes no program.
_NO_PART_OF_IT = ("cache", "log", "traceback", "dump", "coordination", "profiler")


@dataclasses.dataclass(frozen=True)
class _Array:
    """An array in a description: its place among the arrays and its type, without its values."""

    place: int
    kind: str


def kept_program(
    function: Callable[..., PyTree],
    fixed: tuple[PyTree, ...],
    moving: tuple[PyTree, ...],
    options: dict[str, Any] | None = None,
) -> Callable[..., PyTree]:
    """`function(*fixed, *moving)`, compiled, as a function of such `moving` arguments alone.

    Where `keep_programs` has been called, the program is read from its folder, or compiled and
    stored there. A program that cannot be kept runs by `equinox.filter_jit`, as does every call
    with arguments of another structure: where `fixed` holds a class or a function that is not the
    library's, whose changes would not be detected, and where `moving` has leaves that are no
    arrays. `options` are the compiler's.
    """
    options = options or {}
    with_options: Any = eqx.filter_jit
    plain = functools.partial(with_options(function, compiler_options=options), *fixed)
    folder = kept_folder()
    if folder is None or is_traced((fixed, moving)):
        return plain
    try:
        program = _Program(function, fixed, moving)
        path = folder / f"{_LIBRARY}-{function.__module__}-{program.key(options)}"
        call = program.read(path) or program.compile(path, options)
        # An error of the program itself is raised where its result is awaited.
        jax.block_until_ready(jax.tree.leaves(call(*moving)))
    except _NOT_KEPT:
        return plain

    def run(*moving: PyTree) -> PyTree:
        return call(*moving) if program.takes(moving) else plain(*moving)

    return run


# The exceptions of pickle, JAX and the file system.
_NOT_KEPT = (
    pickle.PickleError,
    jax.errors.JaxRuntimeError,
    OSError,
    EOFError,
    AttributeError,
    ImportError,
    TypeError,
    ValueError,
    NotImplementedError,
)


class _Program:
    """A function with the structure of its arguments."""

    def __init__(
        self, function: Callable[..., PyTree], fixed: tuple[PyTree, ...], moving: tuple[PyTree, ...]
    ) -> None:
        self.function = function
        arrays, self.static = eqx.partition(fixed, eqx.is_array)
        self.fixed, self.fixed_structure = jax.tree.flatten(arrays)
        leaves, self.structure = jax.tree.flatten(moving)
        self.kinds = [_type_of(leaf) for leaf in leaves]
        self.moving = leaves

    def takes(self, moving: tuple[PyTree, ...]) -> bool:
        leaves, structure = jax.tree.flatten(moving)
        return structure == self.structure and [_type_of(leaf) for leaf in leaves] == self.kinds

    def key(self, options: dict[str, Any]) -> str:
        """A key that identifies this program; a `PicklingError` for code that is not known."""
        fixed = _described(jax.tree.unflatten(self.fixed_structure, self.fixed), self.static)
        moving = _described(jax.tree.unflatten(self.structure, self.moving))
        file = io.BytesIO()
        content = (self.function, fixed, moving, sorted(options.items()), _settings())
        _OfKnownCode(file, protocol=5).dump(content)
        return hashlib.sha256(file.getvalue() + _versions()).hexdigest()[:32]

    def traced(self, *leaves: Array) -> tuple[list[Array], PyTree]:
        """The function on bare arrays, keys among them as their numbers."""
        keyed = [
            _as_key(leaf, like) for leaf, like in zip(leaves, self.fixed + self.moving, strict=True)
        ]
        split = len(self.fixed)
        fixed = jax.tree.unflatten(self.fixed_structure, keyed[:split])
        moving = jax.tree.unflatten(self.structure, keyed[split:])
        result = self.function(*eqx.combine(fixed, self.static), *moving)
        arrays = jax.tree.leaves(eqx.filter(result, eqx.is_array))
        return arrays, _described(result)

    def compile(self, path: Path, options: dict[str, Any]) -> Callable[..., PyTree]:
        """The program, compiled now and left in the file."""
        results: list[PyTree] = []

        def on_arrays(*leaves: Array) -> list[Array]:
            arrays, described = self.traced(*leaves)
            results[:] = [described]
            return arrays

        with_options: Any = jax.jit
        # JAX's own cache would find the operations of a program of other source, too.
        on_arrays.__name__ = re.sub(r"\W", "_", path.name)
        with _hits() as hits:
            bare = map(_bare, self.fixed + self.moving)
            lowered = with_options(on_arrays, compiler_options=options).lower(*bare)
            compiled = lowered.compile()
        if not hits:  # XLA cannot write a program that it has itself read
            with contextlib.suppress(*_NOT_KEPT):
                kept = (serialize_executable.serialize(compiled), _dumped(results[0]))
                _write(path, pickle.dumps(kept))
        return self.called(compiled, results[0])

    def read(self, path: Path) -> Callable[..., PyTree] | None:
        """The program that the file holds; None where there is none that can be read."""
        try:
            executable, result = pickle.loads(path.read_bytes())
            compiled = serialize_executable.deserialize_and_load(*executable)
            return self.called(compiled, pickle.loads(result))
        except _NOT_KEPT:
            return None

    def called(self, compiled: Callable[..., list[Array]], result: PyTree) -> Callable[..., PyTree]:
        described, structure = jax.tree.flatten(result)
        fixed = [_bare(leaf) for leaf in self.fixed]

        def call(*moving: PyTree) -> PyTree:
            arrays = compiled(*fixed, *map(_bare, jax.tree.leaves(moving)))
            filled = [arrays[x.place] if isinstance(x, _Array) else x for x in described]
            return jax.tree.unflatten(structure, filled)

        return call


class _OfKnownCode(pickle.Pickler):
    """Refuses classes and functions whose code is not known to be the same in another process."""

    def reducer_override(self, obj: Any) -> Any:
        if isinstance(obj, type) or callable(getattr(obj, "__get__", None)):
            root = str(getattr(obj, "__module__", "")).partition(".")[0]
            if root not in _KNOWN:
                raise pickle.PicklingError(f"{obj} is not the library's")
        return NotImplemented


def _dumped(tree: PyTree) -> bytes:
    file = io.BytesIO()
    _OfKnownCode(file, protocol=5).dump(tree)
    return file.getvalue()


def _described(tree: PyTree, static: PyTree = None) -> PyTree:
    """The tree with a description in the place of each array."""
    leaves, structure = jax.tree.flatten(eqx.filter(tree, eqx.is_array))
    named = [_Array(place, _kind(leaf)) for place, leaf in enumerate(leaves)]
    rest = eqx.filter(tree, eqx.is_array, inverse=True) if static is None else static
    return eqx.combine(jax.tree.unflatten(structure, named), rest)


def _kind(leaf: Any) -> str:
    """Shape and type of an array in words; a `TypeError` for anything else."""
    shape, dtype, is_weak = _type_of(leaf)
    return f"{shape}{dtype}{is_weak}"


def _type_of(leaf: Any) -> tuple[tuple[int, ...], Any, bool]:
    """Shape and type of an array; a `TypeError` for anything else."""
    if not hasattr(leaf, "__array__"):
        raise TypeError(f"{leaf} is no array")
    return leaf.shape, leaf.dtype, getattr(leaf, "weak_type", False)


def _is_key(leaf: Any) -> bool:
    return jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _bare(leaf: Any) -> Any:
    return jax.random.key_data(leaf) if _is_key(leaf) else leaf


def _as_key(leaf: Any, like: Any) -> Any:
    return jax.random.wrap_key_data(leaf, impl=jax.random.key_impl(like)) if _is_key(like) else leaf


def _settings() -> list[tuple[str, str]]:
    """JAX's settings, which may change what is traced, and the devices that it is compiled for."""
    config: Any = jax.config
    chosen = [name for name in config.values if not any(part in name for part in _NO_PART_OF_IT)]
    values = [repr(getattr(config, name, config.values[name])) for name in sorted(chosen)]
    settings = [*zip(sorted(chosen), values, strict=True)]
    devices = [f"{device.platform} {device.device_kind}" for device in jax.devices()]
    return [*settings, ("devices", repr(devices)), ("flags", os.environ.get("XLA_FLAGS", ""))]


@functools.cache
def _versions() -> bytes:
    """A digest of the library's source, of the dependencies' versions and of the processor."""
    digest = hashlib.sha256()
    root = Path(__file__).parents[1]
    for path in sorted(root.rglob("*.py")):
        digest.update(str(path.relative_to(root)).encode() + path.read_bytes())
    for name in _DEPENDENCIES:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            digest.update(f"{name} {importlib.metadata.version(name)}".encode())
    digest.update(f"{platform.python_version()} {platform.machine()}".encode())
    with contextlib.suppress(OSError):  # only on Linux; lists the processor's features
        processor = Path("/proc/cpuinfo").read_text().partition("\n\n")[0].splitlines()
        said = [line for line in processor if line.startswith(("flags", "Features", "model name"))]
        digest.update("\n".join(said).encode())
    return digest.digest()


@contextlib.contextmanager
def _hits() -> Iterator[list[str]]:
    """Within the block, a list of the programs that JAX's cache has found."""
    found: list[str] = []
    _listeners.append(found)
    _listen()
    try:
        yield found
    finally:
        _listeners.remove(found)


_listeners: list[list[str]] = []


@functools.cache
def _listen() -> None:
    def hear(event: str, **_: Any) -> None:
        if event.endswith("compilation_cache/cache_hits"):
            for found in _listeners:
                found.append(event)

    jax.monitoring.register_event_listener(hear)


def _write(path: Path, content: bytes) -> None:
    """A whole file or none, also where another process writes the same or the disk is full."""
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        (Path(folder) / path.name).write_bytes(content)
        os.replace(Path(folder) / path.name, path)
