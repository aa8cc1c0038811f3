"""Shared by all commands: reading numbers, one-line errors, memory.

A number out of range is an error of argparse, with exit status 2.
"""

import argparse
import contextlib
import gc
import importlib
import math
import os
import sys
import warnings
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from tqdm import tqdm


def _read_by(
    kind: Callable[[str], Any], holds: Callable[[Any], bool], what: str
) -> Callable[[str], Any]:
    def read(text: str) -> Any:
        with contextlib.suppress(ValueError):
            if holds(number := kind(text)):
                return number
        raise argparse.ArgumentTypeError(f"{text!r} is not {what}")

    return read


def whole(least: int = 1, most: int = 2**31 - 1) -> Callable[[str], int]:
    """The type of an option that is a whole number in this range, by default a count."""
    what = f"a whole number from {least} to {most}"
    return _read_by(int, lambda number: least <= number <= most, what)


# JAX makes a key of the last 32 bits only: larger seeds would repeat smaller ones.
seed = whole(0, 2**32 - 1)
positive = _read_by(float, lambda number: 0 < number < math.inf, "a positive, finite number")
finite = _read_by(float, math.isfinite, "a finite number")


def check_outputs(folder: Path, outputs: Iterable[str], inputs: dict[str, Any]) -> None:
    """Raise `ValueError` where an output in `folder` cannot be written, or is also an input file.

    `inputs`: the input files, by the argument that names each; None for one not given. An input is
    known under any of its names.
    """
    place = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    if not (place.is_dir() and os.access(place, os.W_OK | os.X_OK)):
        raise ValueError(f"--out: {place} is no folder that can be written to")
    for path in filter(Path.exists, (folder / output for output in outputs)):
        if not (path.is_file() and os.access(path, os.W_OK)):
            raise ValueError(f"--out: {path} is no file that can be written over")
        for argument, source in inputs.items():
            if source is not None and Path(source).exists() and path.samefile(source):
                raise ValueError(
                    f"--out: {path} is the file of {argument}, and would be overwritten"
                )


def exit_status(run: Callable[[], None], arguments: Sequence[str] | None = ()) -> int:
    """Run a command: bad input is one line on the error stream and 2, an interruption 130.

    Compiled programs are kept for the next run, where there is a folder for them. Where `arguments`
    is None, the process is the command's own, and an interruption ends it here: if it comes while
    JAX traces or compiles, JAX's caches are left in a state in which the interpreter's usual end is
    a segmentation fault.
    """
    with contextlib.suppress(OSError, RuntimeError):  # the latter where there is no home
        # Imported only now: reading the arguments does not wait for JAX.
        importlib.import_module("mpfjax.operations.compiling").enable_compilation_cache()
    # Tracing leaves so many objects that Python's collector takes a third of the time before a
    # first result, by going through them again and again.
    gc.set_threshold(100_000, 20, 20)
    try:
        run()
    except (ValueError, OSError, ImportError) as error:
        print("error:", "; ".join([str(error), *getattr(error, "__notes__", [])]), file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted; what was finished is written", file=sys.stderr)
        if arguments is None:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(130)
        return 130
    return 0


def say_warnings(category: type[Warning]) -> None:
    """From here on show each warning of this kind as one line, without overwriting a progress bar.

    Call it inside `warnings.catch_warnings()`, which ends it.
    """
    before = warnings.showwarning

    def show(message: Any, kind: type[Warning], *rest: Any) -> None:
        if issubclass(kind, category):
            tqdm.write(f"warning: {message}", file=sys.stderr)
        else:
            before(message, kind, *rest)

    warnings.filterwarnings("always", category=category)
    warnings.showwarning = show


def peak_memory() -> float:
    """The peak memory of this process, in MB of 2²⁰ bytes.

    After a fork, Linux's `ru_maxrss` starts from the parent's value; VmHWM starts anew with the
    program.
    """
    try:
        status = Path("/proc/self/status").read_text()
        return int(status.split("VmHWM:")[1].split()[0]) / 2**10
    except (OSError, IndexError):
        import resource

        unit = 2**20 if sys.platform == "darwin" else 2**10
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit
