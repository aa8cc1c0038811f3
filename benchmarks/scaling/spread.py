"""The particle filter's seeds over devices of one process, or over processes."""

import socket
from collections.abc import Mapping
from typing import Any

import numpy as np

from benchmarks.peers.worker import Worker, stop_all
from mpfjax.console import format_table

TIME_LIMIT = 300.0


def spread_over(
    kind: str, numbers: list[int], size: Mapping[str, int], repeats: int
) -> list[dict[str, Any]]:
    """The particle filter's seeds over so many devices of one process, or over processes."""
    groups = {number: start_group(kind, number) for number in numbers}
    elapsed: dict[int, list[float]] = {number: [] for number in numbers}
    try:
        for workers in groups.values():
            _answers(workers)
        for repeat in range(1 + repeats):
            for number, workers in groups.items():
                for worker in workers:
                    worker.ask(**size, seed=repeat)
                seconds = [found["seconds"] for found in _answers(workers)]
                if repeat > 0:
                    elapsed[number].append(max(seconds))
    finally:
        for workers in groups.values():
            stop_all(workers)
    return [
        {"kind": kind, "number": n, "seconds": times, "median": float(np.median(times))}
        for n, times in elapsed.items()
    ]


def start_group(kind: str, number: int) -> list[Worker]:
    """One process with so many devices, or so many processes with one device each."""
    if kind == "devices":
        return [Worker("mpfjax", "quadratic", number)]
    with socket.socket() as probe:
        probe.bind(("localhost", 0))
        address = f"localhost:{probe.getsockname()[1]}"
    return [Worker("mpfjax", "quadratic", 1, (address, number, index)) for index in range(number)]


def _answers(workers: list[Worker]) -> list[dict[str, Any]]:
    found = [worker.answer(TIME_LIMIT) for worker in workers]
    for each in found:
        if "error" in each:
            raise ValueError(f"a process of the benchmark failed: {each['error']}")
    return found


def spread_table(kind: str, found: list[dict[str, Any]], size: Mapping[str, int]) -> str:
    """Times over devices or processes, and how many times faster than the first."""
    rows = [
        [
            str(entry["number"]),
            f"{1000 * entry['median']:.4g}",
            f"{found[0]['median'] / entry['median']:.2f}",
        ]
        for entry in found
    ]
    title = f"{kind} (PF, N = {size['particles']}, {size['seeds']} seeds)"
    return format_table([title, "median [ms]", "gain"], rows)
