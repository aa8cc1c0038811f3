"""A library at work in a process of its own: asked and answering in lines of JSON.

So a library's peak memory is its own, a device count can be chosen, and what breaks one library
leaves the others alone. `Worker` is the parent's end; run as a module, this is the child's.
"""

import argparse
import contextlib
import json
import os
import select
import subprocess
import sys
import time
from collections.abc import Iterable
from importlib import metadata
from pathlib import Path
from typing import Any

from benchmarks.peers.jobs import JOBS

ROOT = Path(__file__).resolve().parents[2]
PATIENCE = 10.0


class Worker:
    """A process that runs one library on one job, whenever it is asked to.

    `num_devices` host devices where it is given; `processes` is (address of process 0, how many
    processes, which one this is) where several work together.
    """

    def __init__(
        self,
        library: str,
        job: str,
        num_devices: int | None = None,
        processes: tuple[str, int, int] | None = None,
    ) -> None:
        command = [sys.executable, "-m", "benchmarks.peers.worker", library, job]
        if num_devices is not None:
            command += ["--devices", str(num_devices)]
        if processes is not None:
            command += ["--processes", *map(str, processes)]
        paths = [str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
        self._process: Any = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
            env=os.environ | {"PYTHONPATH": os.pathsep.join(paths)},
        )  # fmt: skip

    def ask(self, **request: Any) -> None:
        """Have it run the job once with these `particles`, `seeds` and `seed`."""
        with contextlib.suppress(BrokenPipeError):  # what is wrong with it, `answer` finds out
            self._process.stdin.write(json.dumps(request) + "\n")
            self._process.stdin.flush()

    def answer(self, time_limit: float) -> dict[str, Any]:
        """What it found, or {"error": why it did not}; after an error it has ended."""
        pipe = self._process.stdout
        if not select.select([pipe], [], [], time_limit)[0]:
            self.stop()
            return {"error": f"no answer within {time_limit:g} s"}
        line = pipe.readline()
        if not line:
            return {"error": f"its process ended with status {self._process.wait()}"}
        return json.loads(line)

    def run(self, time_limit: float, **request: Any) -> dict[str, Any]:
        """Ask, and wait for the answer."""
        self.ask(**request)
        return self.answer(time_limit)

    def dismiss(self) -> None:
        """Tell it that there is no more to do; it may wait for others to be told as well."""
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.close()

    def stop(self, patience: float = 0.0) -> None:
        """End the process, whatever it is at, if it has not ended on its own by then."""
        self.dismiss()
        try:
            self._process.wait(patience)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._process.stdout.close()


def stop_all(workers: Iterable[Worker]) -> None:
    """End processes that may work together: all are dismissed before any is waited for."""
    workers = list(workers)
    for worker in workers:
        worker.dismiss()
    for worker in workers:
        worker.stop(PATIENCE)


def main() -> None:
    """Say what there is, then run what is asked for until no more is."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.peers.worker")
    parser.add_argument("library")
    parser.add_argument("job", choices=list(JOBS))
    parser.add_argument("--devices", type=int)
    parser.add_argument("--processes", nargs=3, metavar=("ADDRESS", "NUMBER", "INDEX"))
    options = parser.parse_args()
    # Answers go out on a descriptor of their own: what libraries print is no answer.
    channel = os.fdopen(os.dup(1), "w")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)

    def reply(content: dict[str, Any]) -> None:
        channel.write(json.dumps(content) + "\n")
        channel.flush()

    reply(introduce(options))
    before = peak_memory()
    prepared: dict[tuple[int, int], Any] = {}
    for line in sys.stdin:
        request = json.loads(line)
        try:
            reply(answer(options, request, prepared) | {"memory": peak_memory() - before})
        except Exception as error:
            reply({"error": f"{type(error).__name__}: {error}"})
            return


def introduce(options: argparse.Namespace) -> dict[str, Any]:
    """Versions and devices; imports what the library needs, so that jobs are not charged for it."""
    from benchmarks.peers import libraries

    name = options.library.removesuffix("_2")
    found: dict[str, Any] = {"version": metadata.version(name)}
    if name != "particles":
        import jax

        if options.devices is not None:
            jax.config.update("jax_num_cpu_devices", options.devices)
        if options.processes is not None:
            address, number, index = options.processes
            jax.distributed.initialize(address, int(number), int(index))
        found["devices"] = [device.device_kind for device in jax.devices()]
    libraries.prepare(options.library, JOBS[options.job], 2, 2)
    return found


def answer(
    options: argparse.Namespace, request: dict[str, Any], prepared: dict[tuple[int, int], Any]
) -> dict[str, Any]:
    """Seconds of one run of the job, and what came out of it for each seed."""
    import numpy as np

    from benchmarks.peers import libraries

    job = JOBS[options.job]
    size = request["particles"], request["seeds"]
    if size not in prepared:
        prepared[size] = libraries.prepare(options.library, job, *size)
    given = prepared[size].make_input(request["seed"])
    start = time.perf_counter()
    result = prepared[size].run(given)
    seconds = time.perf_counter() - start
    means, sizes, log_likelihoods = (np.asarray(value, float) for value in result)
    expected = (request["seeds"], job.num_steps)
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


if __name__ == "__main__":
    main()
