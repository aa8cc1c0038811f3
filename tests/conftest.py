"""What every test runs under: checked shapes and types, strict promotion, no display."""

import atexit
import gc
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import jaxtyping
import matplotlib
import pytest
from jaxtyping import install_import_hook

from tests import typechecking

assert "mpfjax" not in sys.modules, "the import hook must be there before mpfjax is imported"
install_import_hook("mpfjax", f"{typechecking.__name__}.typechecker")
matplotlib.use("Agg")
os.environ.setdefault("MPLBACKEND", "Agg")


def tried(*flags: str) -> subprocess.Popen:
    """A start of XLA with the flags, which ends the process over one that it has not."""
    start = [sys.executable, "-c", "import jax; jax.devices('cpu')"]
    environment = os.environ | {"XLA_FLAGS": " ".join(flags)}
    return subprocess.Popen(start, env=environment, stderr=subprocess.DEVNULL)


# Most programs run once, on little: compiling them is what takes time. Workers, notebooks and
# other processes inherit it. JAX 0.12 has no way around XLA's fusion emitters any more, which take
# about twice as long to compile a filter as what they replace: there the first flag falls away.
quick = os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "1") == "1"
flags = ["--xla_cpu_use_fusion_emitters=false", "--xla_cpu_parallel_codegen_split_count=1"]
trial = tried(*flags) if quick and "XLA_FLAGS" not in os.environ else None

# Workers and the processes that tests start take each other's programs, as modules do when those
# from before were dropped (below). The folder is the session's, gone when it ends.
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    programs = tempfile.mkdtemp(prefix="programs-of-tests-")
    atexit.register(shutil.rmtree, programs, ignore_errors=True)
    os.environ["JAX_COMPILATION_CACHE_DIR"] = programs
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")

import jax  # noqa: E402

# Meanwhile JAX is imported, which reads the flags when it first has something to compile.
if trial is not None:
    if trial.wait() != 0:
        flags = [flag for flag in flags if tried(flag).wait() == 0]
    os.environ["XLA_FLAGS"] = " ".join(flags)
jax.config.update("jax_disable_most_optimizations", quick)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")

# Compiling makes many small objects, few of them garbage: it is swept with the programs, below.
gc.freeze()
gc.set_threshold(50_000, 20, 50)

REPOSITORY = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def data() -> Path:
    """The folder of real sequences; the test is skipped where there is none."""
    folder = Path(os.environ.get("MPFJAX_DATA", REPOSITORY.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no real sequences at {folder}: set MPFJAX_DATA to the folder that has them")
    return folder


@pytest.fixture
def as_installed():
    """Without the type checker, which would find some bad input before the library does."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


# Every compiled program keeps memory maps, and thousands of them in one process reach the kernel's
# limit, 65 530 on Linux, at which the compiler crashes. A process with so many takes up to 2.5 GB.
MANY_MAPS = 3_000


def num_maps() -> float:
    """How many memory maps the process has; infinity on systems that do not tell."""
    try:
        return Path("/proc/self/maps").read_bytes().count(b"\n")
    except OSError:
        return float("inf")


def pytest_collection_finish():
    """What was imported to collect the tests stays: sweeps for garbage leave it out."""
    gc.collect()
    gc.freeze()


@pytest.fixture(autouse=True, scope="module")
def release_compiled_programs():
    """Drop all programs when a module ends and they have become many.

    Modules share what they have in common, most of all single operations, until then.
    """
    yield
    if num_maps() > MANY_MAPS:
        jax.clear_caches()
        gc.collect()
