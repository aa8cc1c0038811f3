"""The time of filters at this commit over their time at another one, in turns in two processes.

    python -m benchmarks.scaling --against COMMIT

Each process has the library of one commit: `python commits.py FOLDER` times runs with the library
in the folder. A line with the name of a filter is answered by the seconds of twenty runs of it.
"""

import contextlib
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO

import numpy as np

NUM_RUNS, NUM_STEPS, NUM_COMPONENTS = 20, 100, 12


def ratios(commit: str, particles: Sequence[int], repeats: int) -> list[dict[str, object]]:
    """Per filter and N the median of the ratios of a turn, and their quartiles."""
    root = Path(__file__).parents[1]
    entries: list[dict[str, object]] = []
    with _checked_out(root, commit) as other, _worker(other) as before, _worker(root) as now:
        for kind in ("plain filter", f"mixture of {NUM_COMPONENTS}"):
            for number in particles:
                name = f"{kind}, {number}"
                pairs = [(_seconds(before, name), _seconds(now, name)) for _ in range(repeats + 2)]
                quotients = [late / early for early, late in pairs[2:]]  # the first compile
                low, median, high = np.quantile(quotients, [0.25, 0.5, 0.75])
                entries.append({
                    "filter": kind, "N": number, "time over before": float(median),
                    "lower quartile": float(low), "upper quartile": float(high),
                    "ms before": 1000 * float(np.median([early for early, _ in pairs[2:]])),
                })  # fmt: skip
    return entries


def processor() -> str:
    """The name of the processor, and the widest vectors that it has."""
    lines = Path("/proc/cpuinfo").read_text().splitlines() if sys.platform == "linux" else []
    names = [line.partition(": ")[2] for line in lines if line.startswith("model name")]
    wide = "AVX-512" if any("avx512f" in line for line in lines) else "no AVX-512"
    return f"{names[0]}, {wide}" if names else sys.platform


@contextlib.contextmanager
def _checked_out(root: Path, commit: str) -> Iterator[Path]:
    """A folder with that commit's files."""
    git = ("git", "-C", str(root), "worktree")
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder) / "before"
        added = [*git, "add", "--detach", str(place), commit]
        if subprocess.run(added, capture_output=True, check=False).returncode:
            raise ValueError(f"--against: {commit} is no commit of this repository")
        try:
            yield place
        finally:
            subprocess.run([*git, "remove", "--force", str(place)], check=True)


@contextlib.contextmanager
def _worker(folder: Path) -> Iterator[tuple[IO[str], IO[str]]]:
    """A process that times the library in the folder: its questions and its answers."""
    command = [sys.executable, __file__, str(folder)]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, cwd=folder, stdin=pipe, stdout=pipe, text=True) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        yield process.stdin, process.stdout
        process.stdin.close()


def _seconds(worker: tuple[IO[str], IO[str]], name: str) -> float:
    questions, answers = worker
    questions.write(f"{name}\n")
    questions.flush()
    if not (answer := answers.readline()):
        raise RuntimeError(f"--against: the process for {name!r} ended")
    return float(answer)


def _serve(folder: str) -> None:
    """Time what each line names, with the library in the folder."""
    sys.path.insert(0, folder)
    import jax
    import jax.numpy as jnp

    import mpfjax

    assert str(mpfjax.__file__).startswith(folder)
    model = mpfjax.QuadraticModel(0.1, 0.1, -2.5, 2.5)
    series = (2 * jnp.sin(2 * jnp.pi * jnp.arange(1.0, NUM_STEPS + 1) / 100)) ** 2
    filters: dict[str, mpfjax.Filter] = {}

    def means(mixture: mpfjax.ParticleMixture) -> jax.Array:
        return mixture.log_weights.max()

    for turn, line in enumerate(sys.stdin):
        kind, _, number = line.strip().rpartition(", ")
        if line not in filters:
            is_plain = kind == "plain filter"
            make = mpfjax.particle_filter if is_plain else mpfjax.mixture_particle_filter
            filters[line] = make(model, int(number), *([] if is_plain else [NUM_COMPONENTS]))
        keys = jax.random.split(jax.random.key(turn), NUM_RUNS)
        start = time.perf_counter()
        jax.block_until_ready(mpfjax.monte_carlo(keys, filters[line], series, collect=means))
        print(time.perf_counter() - start, flush=True)


if __name__ == "__main__":
    _serve(sys.argv[1])
