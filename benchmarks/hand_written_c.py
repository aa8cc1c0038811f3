"""The plain filter beside one written by hand in C.

    python -m benchmarks.hand_written_c

The job is that of `benchmarks.peers` on the quadratic model: systematic resampling at every step,
20 seeds; mean, effective sample size and log-likelihood come out. The C program (the file beside
this one) is compiled by GCC for this processor. It is written for this model alone, keeps nothing
else, and draws by the same Threefry and the same polynomials. Both share the seeds among threads,
take turns, and are timed once their log-likelihoods agree with each other's and with the exact one.

Printed are nanoseconds of processor time for a particle and step, medians over the turns, and the
medians of the turns' ratios, of processor time and by the clock. Into --out DIR goes
hand_written_c.json.
"""

import ctypes
import platform
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Annotated, Any

import jax
import numpy as np

from benchmarks.harness import AtLeast2, Count, command, data, ratio, settings_of, table, turns
from benchmarks.peers.__main__ import disagreement, exact_log_likelihood
from benchmarks.peers.jobs import Quadratic
from benchmarks.peers.libraries import through_mpfjax
from mpfjax.console import whole

SOURCE = Path(__file__).with_suffix(".c")
FLAGS = ["-O3", "-march=native", "-ffast-math", "-std=gnu11", "-shared", "-fPIC"]
BLOCK = 64


@command(particles=[999, 1025], repeats=2)
def main(
    *,
    particles: Sequence[AtLeast2] = (1000, 10_000, 100_000),
    seeds: Annotated[int, whole(3)] = 20,
    threads: Count = 2,
    repeats: Count = 9,
    out: Path = Path("results/hand_written_c"),
) -> None:
    """Time both, print the table and write it.

    - `seeds`: runs, at once.
    - `threads`: of the C program.
    - `repeats`: turns.
    """
    settings, job, library = settings_of(locals()), Quadratic(), compiled()
    exact = exact_log_likelihood(job)
    results: list[dict[str, Any]] = []
    for size in particles:
        by_hand = HandWritten(library, job, size, seeds, threads)
        seconds = compare(by_hand, job, exact, seeds, repeats)
        number = size * seeds * job.num_steps
        results.append({"N": size, **as_row(seconds, number)})
    print(table(None, results))
    data(out / "hand_written_c.json", settings=settings, results=results)


def compiled() -> Any:
    """The C program as a library of this process."""
    compiler = shutil.which("gcc")
    if compiler is None:
        raise ValueError("no C compiler: gcc is not on the PATH")
    wide = ["-mprefer-vector-width=512"] if platform.machine() in ("x86_64", "AMD64") else []
    with tempfile.TemporaryDirectory() as folder:
        path = str(Path(folder) / "filter.so")
        subprocess.run([compiler, *FLAGS, *wide, str(SOURCE), "-o", path, "-lm"], check=True)
        return ctypes.CDLL(path)


class HandWritten:
    """The runs of the C program for all seeds."""

    def __init__(
        self, library: Any, job: Quadratic, num_particles: int, num_seeds: int, num_threads: int
    ) -> None:
        self._library, self._job, self.num_particles = library, job, num_particles
        self._threads, self._observations = ThreadPoolExecutor(num_threads), job.observations
        size = -(-num_particles // BLOCK) * BLOCK
        self._arrays = [np.zeros((5, size), np.float32) for _ in range(num_seeds)]

    def prepared(self, seed: int) -> list[tuple[np.ndarray, ...]]:
        """What each run is given: keys, shifts of the points of resampling, and room."""
        random, steps = np.random.default_rng(seed), len(self._observations)
        return [
            (random.integers(0, 2**32, (steps + 1, 2), np.uint32),
             random.random(steps, np.float32), arrays)
            for arrays in self._arrays
        ]  # fmt: skip

    def run(self, runs: list[tuple[np.ndarray, ...]]) -> np.ndarray:
        """The means, sample sizes and increments of every run, (seeds, t, 3)."""
        return np.stack(list(self._threads.map(self._run, runs)))

    def _run(self, inputs: tuple[np.ndarray, ...]) -> np.ndarray:
        keys, shifts, arrays = inputs
        job = self._job
        results = np.zeros((len(shifts), 3), np.float32)
        numbers = map(ctypes.c_float, (job.sigma_x, job.sigma_y, job.low, job.high))
        self._library.run(
            *map(_address, (keys, shifts, self._observations)),
            len(shifts), self.num_particles, *numbers, *map(_address, arrays),
            _address(results),
        )  # fmt: skip
        return results


def _address(array: np.ndarray) -> ctypes.c_void_p:
    return array.ctypes.data_as(ctypes.c_void_p)


def compare(
    by_hand: HandWritten, job: Quadratic, exact: float, num_seeds: int, repeats: int
) -> dict[str, np.ndarray]:
    """Seconds of both by the processor and by the clock, (turns, 2); raises where their answers
    differ.
    """
    ours = through_mpfjax(job, by_hand.num_particles)
    # The first turn compiles; what it is given says whether both agree.
    keys = [jax.random.split(jax.random.key(turn), num_seeds) for turn in range(1 + repeats)]
    inputs = [by_hand.prepared(turn) for turn in range(1 + repeats)]
    _, sizes, log_likelihoods = ours(keys[0])
    results = by_hand.run(inputs[0])
    reason = disagreement(
        {
            "log_likelihoods": results[..., 2].sum(1),
            "effective_sample_sizes": results[..., 1].mean(1),
        },
        {"log_likelihoods": log_likelihoods, "effective_sample_sizes": np.mean(sizes, axis=1)},
        exact,
    )
    if reason is not None:
        raise ValueError(f"N = {by_hand.num_particles}: the C program's {reason}")
    runs: dict[str, Callable[[int], Any]] = {
        "mpfjax": lambda turn: ours(keys[turn]), "C": lambda turn: by_hand.run(inputs[turn])
    }  # fmt: skip
    both: Any = lambda: np.array([time.process_time(), time.perf_counter()])  # noqa: E731
    return turns(runs, repeats, clock=both)


def as_row(seconds: dict[str, np.ndarray], number: int) -> dict[str, float]:
    """Nanoseconds of both, and the ratios."""
    (ours, ours_by_clock), (theirs, theirs_by_clock) = seconds["mpfjax"].T, seconds["C"].T
    return {
        "mpfjax": 1e9 * float(np.median(ours)) / number,
        "C": 1e9 * float(np.median(theirs)) / number,
        "ratio": ratio(ours, theirs), "by the clock": ratio(ours_by_clock, theirs_by_clock),
    }  # fmt: skip


if __name__ == "__main__":
    raise SystemExit(main())
