"""What a mixture costs over a plain filter: ratios by N and M, and the seconds of a first call."""

import contextlib
import time
from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.experimental.compilation_cache import compilation_cache

from benchmarks.scaling.cells import Cell, all_runs, fit_slope, measure
from mpfjax.console import format_table

PRICED = {
    "mpf_fixed": "labels fixed",
    "mpf_kmeans": "K-means at every step",
    "mpf_default": "merge, split, K-means at every third step, the default",
    "mpf": "merge, split, K-means at every step",
}


class PriceSizes(NamedTuple):
    """All particles with all components, and the seeds and steps of every run."""

    particles: list[int]
    components: list[int]
    seeds: int
    steps: int
    first_call: int
    """N of the first calls"""


FULL_PRICE = PriceSizes([1000, 4000, 16_000], [2, 12, 64], 8, 50, 1000)
QUICK_PRICE = PriceSizes([64], [2, 4], 2, 4, 64)


def price(sizes: PriceSizes, repeats: int) -> list[dict[str, Any]]:
    """Each filter at each size, with the median ratio of its time to the plain filter's.

    Timed are calls of `monte_carlo`, which divides the seeds among threads. Ratios are of runs of
    one turn, so that what slows the machine slows both.
    """
    entries = []
    for n in sizes.particles:
        plain = Cell("pf", n, 1, sizes.seeds, sizes.steps)
        mixtures = [
            Cell(name, n, m, sizes.seeds, sizes.steps) for name in PRICED for m in sizes.components
        ]
        elapsed = measure({cell: all_runs(cell) for cell in [plain, *mixtures]}, repeats)
        for cell in mixtures:
            turns = zip(elapsed[cell], elapsed[plain], strict=False)
            ratio = float(np.median([own / of_plain for own, of_plain in turns]))
            entries.append(cell._asdict() | {"seconds": elapsed[cell], "ratio": ratio})
    return entries


def first_calls(sizes: PriceSizes) -> list[dict[str, Any]]:
    """Seconds from a filter to its first results, with nothing compiled before."""
    size = {"particles": sizes.first_call, "seeds": sizes.seeds, "steps": sizes.steps}
    cells = [Cell(filter="pf", components=1, **size)]
    cells += [Cell(filter=name, components=m, **size) for name in PRICED for m in sizes.components]
    entries = []
    with _nothing_kept():
        for cell in cells:
            jax.clear_caches()
            run_all = all_runs(cell)
            keys = jax.random.split(jax.random.key(0), cell.seeds)
            start = time.perf_counter()
            jax.block_until_ready(run_all(keys))
            entries.append(cell._asdict() | {"first_call": time.perf_counter() - start})
    return entries


@contextlib.contextmanager
def _nothing_kept() -> Iterator[None]:
    """Without the programs of earlier processes."""
    settings: Any = jax.config
    folder = settings.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", None)
    compilation_cache.reset_cache()
    try:
        yield
    finally:
        jax.config.update("jax_compilation_cache_dir", folder)
        compilation_cache.reset_cache()


def price_table(entries: list[dict[str, Any]], calls: list[dict[str, Any]]) -> str:
    """A line for each filter and N, with the slope in N, and one for each filter's first call."""
    components = sorted({entry["components"] for entry in entries})
    numbers = sorted({entry["particles"] for entry in entries})
    found = {(e["filter"], e["particles"], e["components"]): e for e in entries}
    first = {(call["filter"], call["components"]): call["first_call"] for call in calls}

    def slope(name: str, m: int) -> str:
        times = [float(np.median(found[name, n, m]["seconds"])) for n in numbers]
        fitted = fit_slope(numbers, times)
        return "-" if fitted is None else f"{fitted:.2f}"

    rows = []
    for name, title in PRICED.items():
        for n in numbers:
            ratios = [f"{found[name, n, m]['ratio']:.2f}" for m in components]
            rows.append([title, f"N = {n}", *ratios])
        rows.append([title, "slope in N", *(slope(name, m) for m in components)])
        rows.append([title, "first call [s]", *(f"{first[name, m]:.1f}" for m in components)])
    plain = f"{first['pf', 1]:.1f}"
    header = ["time over the plain filter's", f"(its first call: {plain} s)"]
    return format_table([*header, *(f"M = {m}" for m in components)], rows)
