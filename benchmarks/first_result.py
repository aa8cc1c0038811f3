"""The seconds of CPU before a first result: cold, and with compiled programs kept.

    python -m benchmarks.first_result

Every figure is of a fresh process, which finds Python's bytecode in place, as installed packages
have it, whatever PYTHONDONTWRITEBYTECODE says. "Cold" starts with an empty folder of compiled
programs, "kept" runs the same once more with what the cold run left there. The rows are of calls
within a process, after the imports, of the imports, and of a whole command. CPU seconds count all
threads, so they change little when the machine does other work; seconds of the clock stand beside
them.

--before DIR runs the same in another checkout of mpfjax, in turns with this one, for a table of
before and after. Into --out DIR go the table as first_result.json and nothing else.
"""

import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.harness import ROOT, Count, Spent, command, data, in_process, settings_of, table

FIGURES = ("cold", "kept", "kept, clock", "kept, MB")
Arguments = tuple[str, ...]  # of Python; a script may print the seconds of a part of it
_BEGIN = """
import time, json, jax, jax.numpy as jnp, numpy as np, mpfjax
model = mpfjax.QuadraticModel(0.1, 0.1, -2.5, 2.5)
observations = jnp.abs(jnp.sin(jnp.arange(1.0, 51.0))) + 1
key = jax.random.key(0)
def run(filter):
    return mpfjax.run_filter(key, filter, observations).log_marginal_likelihood.block_until_ready()
def mixture(m):
    return mpfjax.mixture_particle_filter(model, 1000, max_components=m)
start, began = time.process_time(), time.perf_counter()
"""
_END = """
print(json.dumps({"cpu": time.process_time() - start, "wall": time.perf_counter() - began}))
"""
# What the rows import, so that its bytecode is there.
_IMPORT_ALL = """
import contextlib, importlib, pkgutil, mpfjax
names = [found.name for found in pkgutil.walk_packages(mpfjax.__path__, "mpfjax.")
         if not found.name.endswith("__main__")]
names += ["benchmarks.score_vs_particles", "matplotlib.pyplot", "matplotlib.backends.backend_pdf",
          "scipy.optimize"]
for name in names:
    with contextlib.suppress(ImportError):
        importlib.import_module(name)
"""


@command(only="import")
def main(
    *,
    before: Path | None = None,
    rounds: Count = 1,
    only: str = "",
    out: Path = Path("results/first_result"),
) -> None:
    """Round after round of each job, in turns with the other checkout's; then the table.

    - `before`: another checkout, beside this.
    - `rounds`: of which the least counts.
    - `only`: rows with this in their name.
    """
    if before is not None and not (before / "mpfjax").is_dir():
        raise ValueError(f"--before: {before} holds no mpfjax")
    roots = {"now": ROOT} if before is None else {"before": before, "now": ROOT}
    results: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        rows = jobs(Path(folder) / "out")
        chosen = {name: job for name, job in rows.items() if only in name}
        if not chosen:
            raise ValueError(f"--only: no row has {only!r} in its name")
        bytecode = Path(folder) / "bytecode"
        for root in roots.values():
            spent(("-c", _IMPORT_ALL), root, bytecode / "x", bytecode)
        for job, arguments in chosen.items():
            row: dict[str, Any] = {"CPU seconds": f"{job:40s}"}
            for name, root in roots.items():
                figures = least(arguments, root, bytecode, rounds)
                row |= {f"{name}, {each}": x for each, x in zip(FIGURES, figures, strict=True)}
            results.append(row)
            lines = table(None, [row]).splitlines()
            print("\n".join(lines if len(results) == 1 else lines[-1:]))
    settings = settings_of({"rounds": rounds, "before": before})
    data(out / "first_result.json", settings=settings, rows=results)
    print(f"results: {out}/")


def least(job: Arguments, root: Path, bytecode: Path, rounds: int) -> list[float]:
    """The least of the `FIGURES` over rounds of two processes.

    One has an empty folder of programs, the other what that has left there.
    """
    runs = []
    for _ in range(rounds):
        with tempfile.TemporaryDirectory() as folder:
            runs.append([spent(job, root, Path(folder), bytecode) for _ in range(2)])
    cold, warm = (Spent(*figures) for figures in np.array(runs).min(axis=0).tolist())
    return [cold.cpu, warm.cpu, warm.wall, warm.memory]


def spent(job: Arguments, root: Path, programs: Path, bytecode: Path) -> Spent:
    """What one process took, of a script that says so the part between the imports and the end."""
    settings = {
        "PYTHONPYCACHEPREFIX": str(bytecode),
        "PYTHONDONTWRITEBYTECODE": "",
        "JAX_COMPILATION_CACHE_DIR": str(programs),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
    }
    usage, lines = in_process(*job, root=root, **settings)
    return usage._replace(**json.loads(lines[-1])) if job[0] == "-c" and lines else usage


def jobs(out: Path) -> dict[str, Arguments]:
    """All rows of the table, in order."""
    calls = {
        "run_filter, particle filter": "run(mpfjax.particle_filter(model, 1000))",
        "run_filter, mixture, M = 4": "run(mixture(4))",
        "run_filter, mixture, M = 64": "run(mixture(64))",
        "run_filter, monte_carlo and step, M = 4": (
            "run(mixture(4))\n"
            "keys = jax.random.split(key, 4)\n"
            "mpfjax.monte_carlo(keys, mixture(4), observations).final.log_weights"
            ".block_until_ready()\n"
            "state = mixture(4).init(key)\n"
            "mixture(4).step(key, state, observations[0])[0].log_weights.block_until_ready()"
        ),
    }
    calls_by_name = {"import mpfjax": ("-c", "import mpfjax")}
    calls_by_name |= {name: ("-c", _BEGIN + call + _END) for name, call in calls.items()}
    command = "-m", "benchmarks.score_vs_particles", "--out", str(out)
    return calls_by_name | {"README's first command": command}


if __name__ == "__main__":
    raise SystemExit(main())
