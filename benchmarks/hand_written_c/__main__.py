"""The plain filter beside one written by hand in C, and what each part of a step costs.

    python -m benchmarks.hand_written_c

The job is that of `benchmarks.peers` on the quadratic model: systematic resampling at every step,
20 seeds; mean, effective sample size and log-likelihood come out. The C program (`filter.c`) is
compiled by GCC for this processor. It is written for this model alone, keeps nothing else, and
draws by the same Threefry and the same polynomials. Both share the seeds among threads, take turns,
and are timed once their log-likelihoods agree with each other's and with the exact one.

The parts are differences: a run that draws, one that weighs as well, and the whole filter. Printed
are nanoseconds of processor time for a particle and step, medians over the turns, and the medians
of the turns' ratios, of processor time and by the clock. Into --out DIR goes hand_written_c.json.
"""

import argparse
import ctypes
import platform
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import mpfjax
from benchmarks.peers.__main__ import exact_log_likelihood
from benchmarks.peers.comparison import disagreement
from benchmarks.peers.jobs import Quadratic
from benchmarks.peers.libraries import model_of, through_mpfjax
from mpfjax.console import exit_status, format_table, whole, write_json
from mpfjax.moves import Propagate

SOURCE = Path(__file__).with_name("filter.c")
FLAGS = ["-O3", "-march=native", "-ffast-math", "-std=gnu11", "-shared", "-fPIC"]
BLOCK = 64
DRAW, WEIGH, ALL = 1, 2, 3
PARTS = ["draw", "weigh", "resample", "all"]
HEADER = ["N", "", *PARTS, "ratio", "by the clock"]


def main(arguments: list[str] | None = None) -> int:
    """Time both, print the table and write it."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.hand_written_c")
    parser.add_argument(
        "--particles", type=whole(2), nargs="+", default=[1000, 10_000, 100_000], metavar="N"
    )
    parser.add_argument("--seeds", type=whole(3), default=20, help="runs, at once")
    parser.add_argument("--threads", type=whole(), default=2, help="of the C program")
    parser.add_argument("--repeats", type=whole(), default=9, help="turns")
    parser.add_argument("--out", default="results/hand_written_c", metavar="DIR")
    options = parser.parse_args(arguments)
    return exit_status(lambda: run(options), arguments)


def run(options: argparse.Namespace) -> None:
    """All numbers of particles in turn."""
    job, library = Quadratic(), compiled()
    exact, results = exact_log_likelihood(job), []
    for num_particles in options.particles:
        by_hand = HandWritten(library, job, num_particles, options.seeds, options.threads)
        results.append(compare(by_hand, job, exact, options))
    rows = [row for result in results for row in as_rows(result)]
    print(format_table(HEADER, rows))
    write_json(Path(options.out) / "hand_written_c.json", results)


def compiled() -> Any:
    """The C program as a library of this process."""
    compiler = shutil.which("gcc")
    if compiler is None:
        raise ValueError("no C compiler: gcc is not on the PATH")
    wide = ["-mprefer-vector-width=512"] if platform.machine() in ("x86_64", "AMD64") else []
    with tempfile.TemporaryDirectory() as folder:
        path = str(Path(folder) / "filter.so")
        made = [compiler, *FLAGS, *wide, str(SOURCE), "-o", path, "-lm"]
        subprocess.run(made, check=True)
        return ctypes.CDLL(path)


Given = tuple[np.ndarray, np.ndarray, np.ndarray]


class HandWritten:
    """The runs of the C program for all seeds."""

    def __init__(
        self, library: Any, job: Quadratic, num_particles: int, num_seeds: int, num_threads: int
    ) -> None:
        self._library, self._job, self.num_particles = library, job, num_particles
        self._threads, self._observations = ThreadPoolExecutor(num_threads), job.observations
        size = -(-num_particles // BLOCK) * BLOCK
        self._arrays = [np.zeros((5, size), np.float32) for _ in range(num_seeds)]

    def prepared(self, seed: int) -> list[Given]:
        """What each run is given: keys, shifts of the points of resampling, and room."""
        random = np.random.default_rng(seed)
        num_steps = len(self._observations)
        return [
            (
                random.integers(0, 2**32, (num_steps + 1, 2), np.uint32),
                random.random(num_steps, np.float32),
                arrays,
            )
            for arrays in self._arrays
        ]

    def run(self, runs: list[Given], parts: int = ALL) -> np.ndarray:
        """The means, sample sizes and increments of every run, (seeds, t, 3)."""
        return np.stack(list(self._threads.map(self._run, runs, [parts] * len(runs))))

    def _run(self, given: Given, parts: int) -> np.ndarray:
        keys, shifts, arrays = given
        job = self._job
        found = np.zeros((len(shifts), 3), np.float32)
        numbers = map(ctypes.c_float, (job.sigma_x, job.sigma_y, job.low, job.high))
        self._library.run(
            *map(_address, (keys, shifts, self._observations)),
            len(shifts), self.num_particles, parts, *numbers, *map(_address, arrays),
            _address(found),
        )  # fmt: skip
        return found


def _address(array: np.ndarray) -> ctypes.c_void_p:
    return array.ctypes.data_as(ctypes.c_void_p)


def through_parts(job: Quadratic, num_particles: int) -> dict[int, Callable[[Any], Any]]:
    """Runs of mpfjax over the keys: one that draws, one that weighs as well, and the filter."""
    model, observations = model_of(job), jnp.asarray(job.observations)

    def collect(mixture: mpfjax.ParticleMixture) -> Any:
        return mixture.mean(), mixture.effective_sample_size

    weighing = mpfjax.Filter(model, [Propagate(model)], num_particles)
    unseen = jnp.full_like(observations, jnp.nan)

    def draw(keys: Any) -> Any:
        """A filter without observations; the sum needs every particle."""
        run = mpfjax.monte_carlo(keys, weighing, unseen, _sum_of_states, missing="skip")
        return jax.block_until_ready(run.collected)

    def weigh(keys: Any) -> Any:
        run = mpfjax.monte_carlo(keys, weighing, observations, collect)
        return jax.block_until_ready(run.collected)

    return {DRAW: draw, WEIGH: weigh, ALL: through_mpfjax(job, num_particles)}


def _sum_of_states(mixture: mpfjax.ParticleMixture) -> Any:
    return jnp.sum(mixture.particles)


def compare(
    by_hand: HandWritten, job: Quadratic, exact: float, options: argparse.Namespace
) -> dict[str, Any]:
    """The times of both at one number of particles; raises where their answers differ."""
    num_particles = by_hand.num_particles
    ours = through_parts(job, num_particles)
    keys = [
        jax.random.split(jax.random.key(seed), options.seeds) for seed in range(options.repeats)
    ]
    for part in ours.values():
        part(keys[0])
    _, sizes, log_likelihoods = ours[ALL](keys[0])
    found = by_hand.run(by_hand.prepared(0))
    reason = disagreement(
        {"log_likelihoods": found[..., 2].sum(1), "effective_sample_sizes": found[..., 1].mean(1)},
        {"log_likelihoods": log_likelihoods, "effective_sample_sizes": np.mean(sizes, axis=1)},
        exact,
    )
    if reason is not None:
        raise ValueError(f"N = {num_particles}: the C program's {reason}")
    seconds = []
    for seed, key in enumerate(keys):
        runs, turn = by_hand.prepared(seed), {}
        for part, one in ours.items():
            turn[f"mpfjax {part}"] = timed(one, key)
            turn[f"C {part}"] = timed(by_hand.run, runs, part)
        seconds.append(turn)
    return {"particles": num_particles, "steps": job.num_steps * options.seeds, "seconds": seconds}


def timed(run: Callable[..., Any], *arguments: Any) -> tuple[float, float]:
    """Seconds of processor time, and by the clock."""
    processor, clock = time.process_time(), time.perf_counter()
    run(*arguments)
    return time.process_time() - processor, time.perf_counter() - clock


def as_rows(result: dict[str, Any]) -> list[list[str]]:
    """A row for mpfjax, and one for the C program with the ratios."""
    seconds, size = result["seconds"], result["steps"] * result["particles"]
    rows = []
    for who in ("mpfjax", "C"):
        upto = [np.median([turn[f"{who} {part}"][0] for turn in seconds]) for part in (1, 2, 3)]
        parts = [upto[0], upto[1] - upto[0], upto[2] - upto[1], upto[2]]
        ratios = ["", ""]
        if who == "C":
            both = np.array(
                [[turn[f"{name} {ALL}"] for name in ("mpfjax", "C")] for turn in seconds]
            )
            ratios = [f"{ratio:.1f}" for ratio in np.median(both[:, 0] / both[:, 1], axis=0)]
        nanoseconds = [f"{1e9 * part / size:.2f}" for part in parts]
        rows.append([str(result["particles"]), who, *nanoseconds, *ratios])
    return rows


if __name__ == "__main__":
    sys.exit(main())
