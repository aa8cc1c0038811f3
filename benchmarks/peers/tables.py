"""The tables and the picture of the comparison."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from benchmarks import figures as plotting
from benchmarks.peers.jobs import JOBS
from mpfjax.console import format_table


def as_tables(job_name: str, results: list[dict[str, Any]], labels: Mapping[str, str]) -> str:
    """Times with their ratios to mpfjax's, and below them starts and memory."""
    entries = {(e["library"], e["particles"]): e for e in results if e["job"] == job_name}
    sizes = sorted({size for _, size in entries})
    names = [name for name in labels if any(name == library for library, _ in entries)]

    def table(title: str, form: Any) -> str:
        rows = [
            [labels[name], *(form(entries.get((name, size), {})) for size in sizes)]
            for name in names
        ]
        return format_table([title, *(f"N = {size}" for size in sizes)], rows)

    return "\n\n".join(
        [
            JOBS[job_name].title,
            table("median [ms], ratio", _time),
            table("start [s], memory [MB]", _start),
        ]
    )


def _time(entry: Mapping[str, Any]) -> str:
    if entry.get("refused"):
        return "refused"
    if entry.get("median") is None:
        return "-"
    ratio = "" if entry["ratio"] is None else f" {entry['ratio']:6.2f}"
    return f"{1000 * entry['median']:.4g}{ratio}"


def _start(entry: Mapping[str, Any]) -> str:
    if entry.get("start") is None:
        return "-"
    memory = "-" if entry["memory"] is None else f"{entry['memory'] / 1e6:.0f}"
    return f"{entry['start']:.1f} {memory:>5}"


def draw(results: list[dict[str, Any]], labels: Mapping[str, str]) -> Any:
    """Time against N, a panel for each job and a line for each library; particles' faster mode."""
    panels = []
    for job_name in dict.fromkeys(entry["job"] for entry in results):
        lines: dict[str, dict[float, float]] = {}
        for entry in results:
            if entry["job"] != job_name or entry["median"] is None:
                continue
            # The two modes have one line.
            label = labels[entry["library"]]
            label = "particles" if entry["library"].startswith("particles") else label
            line, milliseconds = lines.setdefault(label, {}), 1000 * entry["median"]
            size = entry["particles"]
            line[size] = min(milliseconds, line.get(size, np.inf))
        job = JOBS[job_name]
        panels.append(
            plotting.CostPanel(
                f"{job.title}, {job.num_steps} steps",
                "number of particles $N$",
                "time of all runs [ms]",
                {label: list(line.items()) for label, line in lines.items()},
            )
        )
    return plotting.draw_costs([panels])
