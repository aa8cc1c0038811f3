"""What time and memory grow with: N, M, seeds and T, and what devices and processes gain.

    python -m benchmarks.scaling
    python -m benchmarks.scaling --axes --devices --processes             # a mixture's price alone
    python -m benchmarks.scaling --axes --no-price --islands 10000000     # one filter, as islands

The quadratic model, whose likelihood costs next to nothing, so that what is seen is the filter;
DPS tracks J such objects. One axis is varied at a time, from a common middle. The cells of an
axis take turns. Slopes are fitted to log-log points: 1 is proportional, 0 no growth. Memory is
what the compiled program asks for, its temporaries and results, with nothing collected. Into
--out DIR go scaling.json and, where an axis was varied, scaling.png.
"""

import argparse
import os
import platform
import sys
from pathlib import Path
from typing import Any

import jax

import mpfjax
from benchmarks.scaling.cells import (
    AXES,
    FILTERS,
    FULL,
    QUICK,
    Cell,
    Sizes,
    bytes_of,
    cells_of,
    compile_cells,
    entry_of,
    measure,
    slopes_of,
)
from benchmarks.scaling.islands import NUM_ISLANDS, island_table, run_as_islands
from benchmarks.scaling.price import FULL_PRICE, QUICK_PRICE, first_calls, price, price_table
from benchmarks.scaling.spread import spread_over, spread_table
from benchmarks.scaling.tables import as_tables, draw
from mpfjax.console import exit_status, whole, write_figure, write_json


def main(arguments: list[str] | None = None) -> int:
    """Run the study, print its tables, and write its results and figure."""
    options = parse(arguments)
    return exit_status(lambda: run(options), arguments)


def parse(arguments: list[str] | None) -> argparse.Namespace:
    """The options, or a message that names the one that cannot be run."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.scaling")
    parser.add_argument("--filters", nargs="+", choices=list(FILTERS), default=list(FILTERS))
    parser.add_argument("--axes", nargs="*", choices=list(AXES), default=list(AXES))
    parser.add_argument(
        "--islands",
        type=whole(),
        nargs="*",
        default=[],
        metavar="N",
        help="particles of one filter",
    )
    parser.add_argument("--repeats", type=whole(), default=5, help="times that each cell is timed")
    parser.add_argument(
        "--devices", type=whole(), nargs="*", default=[1, 2], help="none: leave out"
    )
    parser.add_argument(
        "--processes", type=whole(), nargs="*", default=[1, 2], help="none: leave out"
    )
    parser.add_argument(
        "--price",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="of a mixture over a plain filter, by N and M, with first calls",
    )
    parser.add_argument("--quick", action="store_true", help="tiny, to see that it runs")
    parser.add_argument("--out", default="results/scaling", metavar="DIR")
    options = parser.parse_args(arguments)
    uneven = [number for number in options.islands if number % NUM_ISLANDS**2]
    if uneven:
        parser.error(f"--islands: {uneven[0]} is not a positive multiple of {NUM_ISLANDS**2}")
    return options


def run(options: argparse.Namespace) -> None:
    """Axis after axis, then devices and processes, each written as it is finished."""
    out = Path(options.out)
    sizes = QUICK if options.quick else FULL
    content: dict[str, Any] = {
        "settings": settings_of(options, sizes), "results": [], "slopes": [], "spread": [],
        "price": [], "first_calls": [], "islands": [],
    }  # fmt: skip
    programs: dict[Cell, Any] = {}
    for axis in options.axes:
        cells = cells_of(axis, options.filters, sizes)
        compile_cells(cells, programs)
        measured = measure({cell: programs[cell] for cell in cells}, options.repeats)
        entries = [
            entry_of(axis, cell, seconds, bytes_of(programs[cell]))
            for cell, seconds in measured.items()
        ]
        content["results"] += entries
        content["slopes"] += slopes_of(axis, entries)
        write_json(out / "scaling.json", content)
        print(as_tables(axis, entries, content["slopes"]), end="\n\n")
    for kind in ("devices", "processes"):
        found = spread_over(kind, getattr(options, kind), sizes.spread, options.repeats)
        content["spread"] += found
        if found:
            print(spread_table(kind, found, sizes.spread), end="\n\n")
    if options.price:
        priced = QUICK_PRICE if options.quick else FULL_PRICE
        content["price"] = price(priced, options.repeats)
        content["first_calls"] = first_calls(priced)
        print(price_table(content["price"], content["first_calls"]), end="\n\n")
    content["islands"] = [run_as_islands(number, options.repeats) for number in options.islands]
    if options.islands:
        print(island_table(content["islands"]), end="\n\n")
    write_json(out / "scaling.json", content)
    if content["results"]:
        write_figure(out / "scaling.png", draw(content["results"]), dpi=150)
    print(f"results: {out}/")


def settings_of(options: argparse.Namespace, sizes: Sizes) -> dict[str, Any]:
    """What a second run needs to be the same, and the machine."""
    return {
        **sizes._asdict(),
        "filters": options.filters,
        "repeats": options.repeats,
        "jax": jax.__version__,
        "mpfjax": mpfjax.__version__,
        "python": platform.python_version(),
        "machine": platform.machine(),
        "processors": os.cpu_count(),
        "devices": [device.device_kind for device in jax.devices()],
    }


if __name__ == "__main__":
    sys.exit(main())
