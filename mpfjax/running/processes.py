"""Several processes that work together on one study."""

import math
import os
import sys
import threading

import jax.extend.core


def join_processes(
    coordinator_address: str | None = None,
    num_processes: int | None = None,
    process_id: int | None = None,
    *,
    timeout_seconds: float = 300.0,
) -> None:
    """Join the other processes of a study, so that each sees the devices of all.

    The same script runs in every process, and calls this before anything else of JAX. Then
    `monte_carlo` and `run_islands` spread over all devices of all processes: each process makes
    the same calls with the same arguments, and gets the whole result. It is
    `jax.distributed.initialize` with a time limit and a clear message.

    - Under SLURM, Open MPI or Kubernetes, give no argument: JAX asks the scheduler.
    - Elsewhere `coordinator_address` is "host:port" of process 0, `num_processes` the number of
      processes, and `process_id` the number of this process, from 0.

    Raises `ValueError` if no cluster is found or an argument is out of range, and RuntimeError if
    JAX is in use already. If some process has not joined within `timeout_seconds`, there is no
    exception, since nothing can interrupt JAX's own wait: this process prints a message on stderr
    and ends with exit status 1.
    """
    if not timeout_seconds > 0:
        raise ValueError(f"timeout_seconds: {timeout_seconds} is not positive")
    if None not in (process_id, num_processes) and process_id not in range(num_processes or 0):
        raise ValueError(f"process_id: {process_id} is not in [0, {num_processes})")
    if getattr(jax.config, "jax_cpu_collectives_implementation", None) in (None, "none"):
        jax.config.update("jax_cpu_collectives_implementation", "gloo")
    joined = threading.Event()
    who = "this process" if process_id is None else f"process {process_id} of {num_processes}"
    where = "the cluster's coordinator" if coordinator_address is None else coordinator_address

    def end_when_late() -> None:
        if not joined.wait(timeout_seconds):
            print(
                f"join_processes: {who} has waited {timeout_seconds:g} s for all processes to"
                f" join at {where}. Some process never started, cannot reach that address, or was"
                " told another number of processes. This process ends now.",
                file=sys.stderr,
                flush=True,
            )
            os._exit(1)

    threading.Thread(target=end_when_late, daemon=True).start()
    try:
        # JAX's own time limit aborts the process with a stack trace, so ours must be shorter.
        jax.distributed.initialize(
            coordinator_address,
            num_processes,
            process_id,
            initialization_timeout=math.ceil(timeout_seconds) + 60,
        )
    except ValueError as error:
        raise ValueError(
            f"coordinator_address, num_processes, process_id: {error} No scheduler was found that"
            " knows them: give all three."
        ) from error
    finally:
        joined.set()
