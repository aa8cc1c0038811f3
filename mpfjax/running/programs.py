"""JAX's own cache of compiled programs, switched on for all of a process."""

import os
from pathlib import Path

import jax
from jax.experimental.compilation_cache import compilation_cache

_FOLDER = "jax_compilation_cache_dir"


def enable_compilation_cache(folder: str | Path | None = None) -> Path:
    """Keep compiled programs in a folder: a later process that needs the same ones starts sooner.

    This switches on JAX's persistent compilation cache, for every program of the process, whatever
    its size and its time to compile. A program is traced and then found by its operations, its
    options, JAX and the processor; numbers in a model may differ. Nothing is ever deleted, but you
    may delete the folder at any time. Its content is executed: do not let others write to it.

    - `folder`: None takes `jax_compilation_cache_dir` if that is set, and otherwise `mpfjax` in the
      user's folder of caches ($XDG_CACHE_HOME, or ~/.cache).

    Returns the folder. Raises `OSError` where it cannot be made. Use it once, at the beginning of a
    script or notebook; the commands of mpfjax and its benchmarks do.
    """
    if folder is None:
        caches = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        setting: str | None = getattr(jax.config, _FOLDER)
        folder = setting or caches / "mpfjax"
    path = Path(folder)
    path.mkdir(parents=True, exist_ok=True)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    if str(path) != getattr(jax.config, _FOLDER):
        jax.config.update(_FOLDER, str(path))
        # An earlier compilation may have decided that there is no cache.
        compilation_cache.reset_cache()
    return path
