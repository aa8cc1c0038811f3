"""Files that are written whole or not at all, and that load without running code."""

import json
import os
import platform
import re
import secrets
import zipfile
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from mpfjax.checks import check_type


def as_path(path: str | os.PathLike[str], name: str = "path") -> Path:
    """The path, or a `ValueError` naming the argument where it is none or empty."""
    check_type((str, os.PathLike), "a path", **{name: path})
    if not os.fspath(path):
        raise ValueError(f"{name}: '' is no path; '.' is the folder that this runs in")
    return Path(path)


def write_whole(path: str | os.PathLike[str], write: Callable[[BinaryIO], object]) -> None:
    """Write a file so that an interruption or an error leaves the old one or the new one.

    Several threads and processes may write one path. The file is that of the last one to end, and
    it is whole whenever it is read. Raises `OSError` that names the file where there is no room for
    it, or no permission.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    # Writers that shared a name would write into each other's file, and take it from each other.
    ours = f"{platform.node()}-{os.getpid()}"
    partial = path.with_name(f"{path.name}.{ours}-{secrets.token_hex(8)}.partial")
    _remove_what_the_killed_left(path)
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


def _remove_what_the_killed_left(path: Path) -> None:
    """Remove temporary files for this path that processes on this machine left when killed."""
    if os.name != "posix":
        return
    name = re.compile(rf"{re.escape(f'{path.name}.{platform.node()}')}-(\d+)-[0-9a-f]+\.partial")
    for other in path.parent.iterdir():
        found = name.fullmatch(other.name)
        if found is not None and not _is_running(int(found[1])):
            other.unlink(missing_ok=True)


def _is_running(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


def write_arrays(path: str | os.PathLike[str], arrays: Mapping[str, np.ndarray]) -> None:
    """Write arrays by name as .npz, whole or not at all; `np.load` reads it without pickles.

    Raises `ValueError` for an array that could not be read so, and `OSError` as `write_whole`.
    """
    for name, array in arrays.items():
        if array.dtype.hasobject or array.dtype.kind == "V":
            raise ValueError(f"{name}: an array of {array.dtype} does not load without pickles")

    def write(file: BinaryIO) -> None:
        # Not by np.savez, which takes an array named "file" for its first argument.
        with zipfile.ZipFile(file, "w") as archive:
            for name, array in arrays.items():
                with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                    np.lib.format.write_array(member, array, allow_pickle=False)

    write_whole(path, write)


# The errors that a flipped bit may lead to; the last is for an unknown compression or encryption.
_DAMAGE = (
    zipfile.BadZipFile, zlib.error, EOFError, OSError, MemoryError, OverflowError, ValueError,
    RuntimeError,
)  # fmt: skip


def load_arrays(path: str | os.PathLike[str]) -> dict[str, np.ndarray]:
    """The arrays of a .npz file; `ValueError` for one that is cut off, damaged or none."""
    with open(path, "rb") as file:
        try:
            found = np.load(file, allow_pickle=False)
            if not isinstance(found, Mapping):
                raise ValueError("it holds one array")
            arrays: dict[str, np.ndarray] = dict(found)
            others = [name for name in arrays if not isinstance(arrays[name], np.ndarray)]
            if others:
                raise ValueError(f"{others[0]} is no array")
        except _DAMAGE as error:
            raise ValueError(f"{path}: cut off, damaged or no .npz file ({error})") from error
    return arrays


def read_description(
    path: Path, arrays: Mapping[str, np.ndarray], name: str = "description"
) -> dict[str, Any]:
    """The description in the arrays of a checkpoint, stored as JSON under this name."""
    if name not in arrays:
        raise ValueError(f"{path}: no checkpoint, for it does not describe what it holds")
    try:
        return dict(json.loads(str(arrays[name])))
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path}: no checkpoint, its description is no JSON ({error})") from error
