"""Work in a process of its own: so that its peak memory is its own, a device count can be chosen,
and what breaks one library leaves the others alone.

`Worker` is the parent's end. The other end is a function of the arguments that says what there is,
and hands over the function that does what it is asked for.
"""

import contextlib
import multiprocessing
import os
import sys
import time
from collections.abc import Callable, Iterable
from importlib import metadata
from pathlib import Path
from typing import Any

from benchmarks.peers.jobs import JOBS

PATIENCE = 10.0
Made = tuple[dict[str, Any], Callable[..., dict[str, Any]]]


class Worker:
    """A process in which `make(*arguments)` works; its first answer is what `make` says of it."""

    def __init__(self, make: Callable[..., Made], *arguments: Any) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, end = context.Pipe()
        self._process = context.Process(target=_serve, args=(end, make, arguments))
        self._process.start()
        end.close()  # or nobody would hear of it where the process ends

    def ask(self, **request: Any) -> None:
        """Have it work once on this."""
        with contextlib.suppress(OSError):  # what is wrong with it, `answer` finds out
            self._pipe.send(request)

    def answer(self, time_limit: float | None = None) -> dict[str, Any]:
        """What it found, or {"error": why it did not}; after an error it has ended."""
        try:
            if self._pipe.poll(time_limit):
                return self._pipe.recv()
        except (EOFError, OSError):
            self._process.join(PATIENCE)
            return {"error": f"its process ended with status {self._process.exitcode}"}
        self.stop()
        return {"error": f"no answer within {time_limit:g} s"}

    def run(self, time_limit: float | None = None, **request: Any) -> dict[str, Any]:
        """Ask, and wait for the answer."""
        self.ask(**request)
        return self.answer(time_limit)

    def dismiss(self) -> None:
        """Tell it that there is no more to do; it may wait for others to be told as well."""
        with contextlib.suppress(OSError):
            self._pipe.send(None)

    def stop(self, patience: float = 0.0) -> None:
        """End the process, whatever it is at, if it has not ended on its own by then."""
        self.dismiss()
        self._process.join(patience)
        self._process.kill()
        self._process.join()


def stop_all(workers: Iterable[Worker]) -> None:
    """End processes that may work together: all are dismissed before any is waited for."""
    workers = list(workers)
    for worker in workers:
        worker.dismiss()
    for worker in workers:
        worker.stop(PATIENCE)


def _serve(pipe: Any, make: Callable[..., Made], arguments: tuple[Any, ...]) -> None:
    """The process's end: what is asked for, until no more is."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # libraries print what nobody wants to read
    try:
        told, work = make(*arguments)
        pipe.send(told)
        while (request := pipe.recv()) is not None:
            pipe.send(work(**request))
    except Exception as error:
        pipe.send({"error": f"{type(error).__name__}: {error}"})


def library_at_work(
    library: str,
    job: str,
    num_devices: int | None = None,
    processes: tuple[str, int, int] | None = None,
) -> Made:
    """A library on one job: versions and devices, and what runs the job.

    `processes`: (address of process 0, how many processes, which one this is), where several work
    together. Imports what the library needs, so that jobs are not charged for it.
    """
    from benchmarks.peers import libraries

    name = library.removesuffix("_2")
    told: dict[str, Any] = {"version": metadata.version(name)}
    if name != "particles":
        import jax

        if num_devices is not None:
            jax.config.update("jax_num_cpu_devices", num_devices)
        if processes is not None:
            jax.distributed.initialize(*processes)
        told["devices"] = [device.device_kind for device in jax.devices()]
    libraries.prepare(library, JOBS[job], 2, 2)
    before = peak_memory()
    prepared: dict[tuple[int, int], Any] = {}

    def work(particles: int, seeds: int, seed: int) -> dict[str, Any]:
        size = particles, seeds
        if size not in prepared:
            prepared[size] = libraries.prepare(library, JOBS[job], *size)
        return timed(prepared[size], JOBS[job], seeds, seed) | {"memory": peak_memory() - before}

    return told, work


def timed(prepared: Any, job: Any, num_seeds: int, seed: int) -> dict[str, Any]:
    """Seconds of one run of the job, and what came out of it for each seed."""
    import numpy as np

    given = prepared.make_input(seed)
    start = time.perf_counter()
    result = prepared.run(given)
    seconds = time.perf_counter() - start
    means, sizes, log_likelihoods = (np.asarray(value, float) for value in result)
    expected = (num_seeds, job.num_steps)
    shapes = (means.shape, sizes.shape, log_likelihoods.shape)
    if shapes != ((*expected, *job.state_shape), expected, expected[:1]):
        raise ValueError(f"results of shapes {shapes}")
    return {
        "seconds": seconds,
        "log_likelihoods": log_likelihoods.tolist(),
        "effective_sample_sizes": sizes.mean(axis=1).tolist(),
    }


def peak_memory() -> int:
    """The most bytes that this process has held, without importing mpfjax for it.

    Linux's `ru_maxrss` goes on from the parent's at a fork; VmHWM starts anew with the program.
    """
    try:
        status = Path("/proc/self/status").read_text()
        return 1024 * int(status.split("VmHWM:")[1].split()[0])
    except (OSError, IndexError):
        import resource

        unit = 1 if sys.platform == "darwin" else 1024
        return unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
