"""The plain filter beside one written by hand in C, and what each part of a step costs.

    python -m benchmarks.hand_written_c

The job is that of `benchmarks.peers` on the quadratic model: systematic resampling at every step,
20 seeds; mean, effective sample size and log-likelihood come out. The C program (the file beside
this one) is compiled by GCC for this processor. It is written for this model alone, keeps nothing
else, and draws by the same Threefry and the same polynomials. Both share the seeds among threads,
take turns, and are timed once their log-likelihoods agree with each other's and with the exact one.

The parts are differences: a run that draws, one that weighs as well, and the whole filter. Printed
are nanoseconds of processor time for a particle and step, medians over the turns, and the medians
of the turns' ratios, of processor time and by the clock. Into --out DIR goes hand_written_c.json.
"""

import ctypes
import platform
import shutil
import subprocess
import tempfile
import time
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np

import mpfjax
from benchmarks.harness import AtLeast2, Count, command, data, ratio, settings_of, table, turns
from benchmarks.peers.__main__ import disagreement, exact_log_likelihood
from benchmarks.peers.jobs import Quadratic
from benchmarks.peers.libraries import model_of, through_mpfjax
from mpfjax.console import whole

SOURCE = Path(__file__).with_suffix(".c")
FLAGS = ["-O3", "-march=native", "-ffast-math", "-std=gnu11", "-shared", "-fPIC"]
BLOCK = 64
DRAW, WEIGH, ALL = 1, 2, 3  # the parts of a run, for the C program


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
        results += [{"N": size, **row} for row in as_rows(seconds, number)]
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

    def run(self, runs: list[tuple[np.ndarray, ...]], parts: int = ALL) -> np.ndarray:
        """The means, sample sizes and increments of every run, (seeds, t, 3)."""
        return np.stack(list(self._threads.map(self._run, runs, [parts] * len(runs))))

    def _run(self, inputs: tuple[np.ndarray, ...], parts: int) -> np.ndarray:
        keys, shifts, arrays = inputs
        job = self._job
        results = np.zeros((len(shifts), 3), np.float32)
        numbers = map(ctypes.c_float, (job.sigma_x, job.sigma_y, job.low, job.high))
        self._library.run(
            *map(_address, (keys, shifts, self._observations)),
            len(shifts), self.num_particles, parts, *numbers, *map(_address, arrays),
            _address(results),
        )  # fmt: skip
        return results


def _address(array: np.ndarray) -> ctypes.c_void_p:
    return array.ctypes.data_as(ctypes.c_void_p)


def through_parts(job: Quadratic, num_particles: int) -> dict[int, Callable[[Any], Any]]:
    """Runs of mpfjax over the keys: one that draws, one that weighs as well, and the filter."""
    model, observations = model_of(job), jnp.asarray(job.observations)
    weighing = mpfjax.Filter(model, [mpfjax.Propagate()], num_particles)
    unseen = jnp.full_like(observations, jnp.nan)
    sums = lambda mixture: jnp.sum(mixture.particles)  # noqa: E731
    moments = lambda mixture: (mixture.mean(), mixture.effective_sample_size)  # noqa: E731

    def draw(keys: Any) -> Any:
        """A filter without observations; the sum needs every particle."""
        run = mpfjax.monte_carlo(keys, weighing, mpfjax.Series.skipping(unseen), sums)
        return jax.block_until_ready(run.collected)

    def weigh(keys: Any) -> Any:
        run = mpfjax.monte_carlo(keys, weighing, observations, moments)
        return jax.block_until_ready(run.collected)

    return {DRAW: draw, WEIGH: weigh, ALL: through_mpfjax(job, num_particles)}


def compare(
    by_hand: HandWritten, job: Quadratic, exact: float, num_seeds: int, repeats: int
) -> dict[tuple[str, int], np.ndarray]:
    """Seconds of both by the processor and by the clock, (turns, 2), of each part; raises where
    their answers differ.
    """
    # Of runs without resampling, which are meant to degenerate.
    warnings.simplefilter("ignore", RuntimeWarning)
    ours = through_parts(job, by_hand.num_particles)
    # The first turn compiles; what it is given says whether both agree.
    keys = [jax.random.split(jax.random.key(turn), num_seeds) for turn in range(1 + repeats)]
    inputs = [by_hand.prepared(turn) for turn in range(1 + repeats)]
    _, sizes, log_likelihoods = ours[ALL](keys[0])
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
    runs: dict[tuple[str, int], Callable[[int], Any]] = {}
    for part, one in ours.items():
        runs["mpfjax", part] = lambda turn, one=one: one(keys[turn])
        runs["C", part] = lambda turn, part=part: by_hand.run(inputs[turn], part)
    both: Any = lambda: np.array([time.process_time(), time.perf_counter()])  # noqa: E731
    return turns(runs, repeats, clock=both)


def as_rows(seconds: dict[tuple[str, int], np.ndarray], number: int) -> list[dict[str, Any]]:
    """Nanoseconds of each part for mpfjax, with the ratios, and for the C program."""
    rows = []
    for who in ("mpfjax", "C"):
        draw, weigh, whole = (
            1e9 * np.median(seconds[who, part][:, 0]) / number for part in (DRAW, WEIGH, ALL)
        )
        parts = {"draw": draw, "weigh": weigh - draw, "resample": whole - weigh, "all": whole}
        rows.append({"": who, **parts})
    ours, theirs = seconds["mpfjax", ALL], seconds["C", ALL]
    rows[0] |= {
        "ratio": ratio(ours[:, 0], theirs[:, 0]), "by the clock": ratio(ours[:, 1], theirs[:, 1])
    }  # fmt: skip
    return rows


if __name__ == "__main__":
    raise SystemExit(main())
