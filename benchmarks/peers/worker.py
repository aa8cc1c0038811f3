"""A library at work in a process of its own: its peak memory is its own, and what breaks it leaves
the others alone.
"""

import multiprocessing
import os
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from functools import cache
from importlib import metadata
from typing import Any

import numpy as np

from benchmarks.peers import libraries
from benchmarks.peers.jobs import JOBS
from mpfjax.console import peak_memory


@contextmanager
def process() -> Iterator[ProcessPoolExecutor]:
    """One that starts anew, and keeps what it has made from one call to the next."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), _silent) as pool:
        yield pool
        # It does not wait for processes of its own, which joblib leaves.
        with suppress(BrokenProcessPool):
            pool.submit(os._exit, 0)


def _silent() -> None:
    """Libraries print what nobody wants to read."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)


@cache
def settings_at_start(library: str, job: str) -> dict[str, Any]:
    """Version, devices and memory, once all is imported that jobs are not charged for."""
    name = library.partition("_")[0]
    settings: dict[str, Any] = {"version": metadata.version(name)}
    if name != "particles":
        import jax

        settings["devices"] = [device.device_kind for device in jax.devices()]
    libraries.prepare(library, JOBS[job], 2, 2)
    return settings | {"memory": peak_memory()}


_prepare = cache(libraries.prepare)


def run_once(
    library: str, job: str, num_particles: int, num_seeds: int, seed: int
) -> dict[str, Any]:
    """Seconds of one run of the job, MB above the imports', and what came out for each seed."""
    settings = settings_at_start(library, job)
    prepared = _prepare(library, JOBS[job], num_particles, num_seeds)
    argument = prepared.make_input(seed)
    start = time.perf_counter()
    result = prepared.run(argument)
    seconds = time.perf_counter() - start
    _, sizes, log_likelihoods = (np.asarray(value, float) for value in result)
    return settings | {
        "seconds": seconds,
        "memory": peak_memory() - settings["memory"],
        "log_likelihoods": log_likelihoods,
        "effective_sample_sizes": sizes.mean(axis=1),
    }
