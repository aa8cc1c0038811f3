"""The tables and the picture of the axes."""

from collections.abc import Callable
from typing import Any

from benchmarks import figures as plotting
from benchmarks.scaling.cells import AXES, FILTERS
from mpfjax.console import format_table


def as_tables(axis: str, entries: list[dict[str, Any]], slopes: list[dict[str, Any]]) -> str:
    """Times with their ratios to the PF's of the same size, memory, and the slopes of both."""
    values = sorted({entry[axis] for entry in entries})
    cells = {(entry["filter"], entry[axis]): entry for entry in entries}
    by_filter = {slope["filter"]: slope for slope in slopes if slope["axis"] == axis}

    def of_pf(value: int) -> dict[str, Any] | None:
        return cells.get(("pf", 1 if axis == "components" else value))

    def time_of(entry: dict[str, Any]) -> str:
        pf = of_pf(entry[axis])
        ratio = "" if pf is None else f" {entry['median'] / pf['median']:6.2f}"
        return f"{1000 * entry['median']:.4g}{ratio}"

    def table(title: str, form: Callable[[dict[str, Any]], str], of_what: list[str]) -> str:
        rows = [
            [
                FILTERS[name],
                *(form(cells[name, v]) if (name, v) in cells else "-" for v in values),
                *(_form(slope[what]) for what in of_what),
            ]
            for name, slope in by_filter.items()
        ]
        ends = ["slope", "slope at the end"][: len(of_what)]
        return format_table([title, *(f"{axis} {value}" for value in values), *ends], rows)

    memory = lambda entry: f"{entry['bytes'] / 1e6:.3g}"  # noqa: E731
    return "\n\n".join(
        [
            table("median [ms], ratio to PF", time_of, ["time", "time_last"]),
            table("memory [MB]", memory, ["memory"]),
        ]
    )


def _form(slope: float | None) -> str:
    return "-" if slope is None else f"{slope:.2f}"


def draw(results: list[dict[str, Any]]) -> Any:
    """A column for each axis, time above memory, a line for each filter."""
    axes = list(dict.fromkeys(entry["axis"] for entry in results))

    def panel(axis: str, ylabel: str, cost: Callable[[dict[str, Any]], float]) -> Any:
        lines: dict[str, list[tuple[float, float]]] = {}
        for entry in results:
            if entry["axis"] == axis:
                points = lines.setdefault(FILTERS[entry["filter"]], [])
                points.append((entry[axis], cost(entry)))
        return plotting.CostPanel("", AXES[axis], ylabel, lines)

    return plotting.draw_costs(
        [
            [panel(axis, "time of all runs [ms]", lambda e: 1000 * e["median"]) for axis in axes],
            [panel(axis, "memory [MB]", lambda e: e["bytes"] / 1e6) for axis in axes],
        ]
    )
