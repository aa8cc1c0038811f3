"""What time and memory grow with: N, M, seeds and T, and what devices and processes gain.

    python -m benchmarks.scaling
    python -m benchmarks.scaling --axes --islands 10000000    # one filter, as islands

The quadratic model, whose likelihood costs next to nothing, so that what is seen is the filter;
DPS tracks J such objects. One axis is varied at a time, from a common middle. The cells of an
axis take turns. Slopes are fitted to log-log points: 1 is proportional, 0 no growth. Memory is
what the compiled program asks for, its temporaries and results, with nothing collected. Into
--out DIR go scaling.json and, where an axis was varied, scaling.png.
"""

import argparse
import os
import platform
import socket
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import mpfjax
from benchmarks.peer_worker import Worker, stop_all
from mpfjax import plotting
from mpfjax.console import exit_status, format_table, whole, write_json
from mpfjax.operations.compiling import wide_vectors

FILTERS = {
    "pf": "PF",
    "mpf_fixed": "MPF, labels fixed",
    "mpf_kmeans": "MPF, K-means at every step",
    "mpf": "MPF: merge, split, K-means",
    "dps": "DPS, J = M objects",
}
AXES = {
    "particles": "number of particles $N$",
    "components": "number of components $M$",
    "seeds": "number of seeds",
    "steps": "number of steps $T$",
}
NUM_ISLANDS, ISLAND_STEPS = 8, 20
SLOW_SECONDS, FEWEST_REPEATS = 6.0, 3
TIME_LIMIT = 300.0


class Cell(NamedTuple):
    """One thing that is timed."""

    filter: str
    particles: int
    components: int
    seeds: int
    steps: int


class Sizes(NamedTuple):
    """The middle, the values of each axis, and what is run on devices and processes.

    The middle is a point of every axis, so that it compiles once.
    """

    middle: dict[str, int]
    axes: dict[str, list[int]]
    spread: dict[str, int]
    """N and seeds of the job that is spread."""


FULL = Sizes(
    {"particles": 4000, "components": 2, "seeds": 8, "steps": 50},
    {
        "particles": [1000, 4000, 16_000, 64_000],
        "components": [2, 12, 64],
        "seeds": [8, 24, 72],
        "steps": [50, 150, 450],
    },
    {"particles": 10_000, "seeds": 20},
)
QUICK = Sizes(
    {"particles": 64, "components": 2, "seeds": 2, "steps": 4},
    {"particles": [64, 128], "components": [2, 4], "seeds": [2, 4], "steps": [4, 8]},
    {"particles": 64, "seeds": 4},
)


def main(arguments: list[str] | None = None) -> int:
    """Run the study, print its tables, and write its results and figure."""
    options = parse(arguments)
    return exit_status(lambda: run(options))


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
        "islands": [],
    }  # fmt: skip
    programs: dict[Cell, Any] = {}
    for axis in options.axes:
        cells = cells_of(axis, options.filters, sizes)
        compile_cells(cells, programs)
        measured = measure({cell: programs[cell] for cell in cells}, options.repeats)
        entries = [entry_of(axis, cell, *found) for cell, found in measured.items()]
        content["results"] += entries
        content["slopes"] += slopes_of(axis, entries)
        write_json(out / "scaling.json", content)
        print(as_tables(axis, entries, content["slopes"]), end="\n\n")
    for kind in ("devices", "processes"):
        found = spread_over(kind, getattr(options, kind), sizes.spread, options.repeats)
        content["spread"] += found
        if found:
            print(spread_table(kind, found, sizes.spread), end="\n\n")
    content["islands"] = [run_as_islands(number, options.repeats) for number in options.islands]
    if options.islands:
        print(island_table(content["islands"]), end="\n\n")
    write_json(out / "scaling.json", content)
    if content["results"]:
        draw(content["results"]).savefig(out / "scaling.png", dpi=150)
    print(f"results: {out}/")


# --- the filters ------------------------------------------------------------------------------


def cells_of(axis: str, filters: Sequence[str], sizes: Sizes) -> list[Cell]:
    """The middle with one axis varied; the PF, which has no components, once where M is varied."""
    cells = []
    for name in filters:
        for value in sizes.axes[axis]:
            cell = Cell(filter=name, **(sizes.middle | {axis: value}))
            cells.append(cell._replace(components=1) if name == "pf" else cell)
    return list(dict.fromkeys(cells))


def build(cell: Cell) -> tuple[mpfjax.Filter, jax.Array]:
    """The filter of a cell, and observations for it."""
    model = mpfjax.QuadraticModel(0.1, 0.1, -2.5, 2.5)
    observations = (2 * jnp.sin(2 * jnp.pi * jnp.arange(1.0, cell.steps + 1) / 100)) ** 2
    n, m = cell.particles, cell.components
    if cell.filter == "pf":
        return mpfjax.particle_filter(model, n), observations
    if cell.filter == "mpf":
        return mpfjax.mixture_particle_filter(model, n, m), observations
    if cell.filter == "dps":
        objects = mpfjax.MultiObjectModel(model, m)
        every = jnp.broadcast_to(observations[:, None], (cell.steps, m))
        return mpfjax.distributed_partitioned_sampling(objects, n), every
    moves: list[Any] = [mpfjax.Resample(), mpfjax.Propagate(model)]
    if cell.filter == "mpf_kmeans":
        moves.append(mpfjax.KMeans())
    # Dealt at random at the start, which costs next to nothing at any T.
    return mpfjax.Filter(model, moves, n, m, [mpfjax.RandomPartition()]), observations


def nothing(mixture: mpfjax.ParticleMixture) -> None:
    """What is collected."""
    del mixture


# --- what is measured -------------------------------------------------------------------------


def compile_cells(cells: list[Cell], programs: dict[Cell, Any]) -> None:
    """Add the programs that are not there yet, two at a time."""
    new = [cell for cell in cells if cell not in programs]
    with ThreadPoolExecutor(max_workers=2) as pool:
        programs.update(zip(new, pool.map(compile_cell, new), strict=True))


def measure(programs: Mapping[Cell, Any], repeats: int) -> dict[Cell, tuple[list[float], int]]:
    """Seconds of each run of every cell, in turns, and the bytes that its program asks for."""
    cells = list(programs)
    keys = {
        cell: jax.block_until_ready(jax.random.split(jax.random.key(0), cell.seeds))
        for cell in cells
    }
    elapsed: dict[Cell, list[float]] = {cell: [] for cell in cells}
    order = np.random.default_rng(0)
    for repeat in range(1 + repeats):
        for index in order.permutation(len(cells)).tolist():
            cell = cells[index]
            if sum(elapsed[cell]) > SLOW_SECONDS and len(elapsed[cell]) >= FEWEST_REPEATS:
                continue
            start = time.perf_counter()
            jax.block_until_ready(programs[cell](keys[cell]))
            if repeat > 0:
                elapsed[cell].append(time.perf_counter() - start)
    return {cell: (elapsed[cell], bytes_of(programs[cell])) for cell in cells}


def compile_cell(cell: Cell) -> Any:
    """The program that runs a cell, from keys to results."""
    filter, observations = build(cell)

    def run_all(keys: jax.Array) -> mpfjax.FilterRun:
        return mpfjax.monte_carlo(keys, filter, observations, nothing)

    keys = jax.eval_shape(lambda: jax.random.split(jax.random.key(0), cell.seeds))
    return jax.jit(run_all, compiler_options=wide_vectors()).lower(keys).compile()


def bytes_of(program: Any) -> int:
    """Temporaries and results of a compiled program; exact, and known before it runs."""
    memory = program.memory_analysis()
    return int(memory.temp_size_in_bytes + memory.output_size_in_bytes)


def fit_slope(sizes: Sequence[float], costs: Sequence[float]) -> float | None:
    """The least-squares slope of log cost against log size; None for fewer than two sizes."""
    if len(set(sizes)) < 2:
        return None
    return float(np.polyfit(np.log(sizes), np.log(costs), 1)[0])


def entry_of(axis: str, cell: Cell, seconds: list[float], memory: int) -> dict[str, Any]:
    """One entry of the results: times in seconds, memory in bytes."""
    median = float(np.median(seconds))
    return {"axis": axis, **cell._asdict(), "seconds": seconds, "median": median, "bytes": memory}


def slopes_of(axis: str, entries: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """How time and memory grow along an axis, for each filter; also between the last two points,
    where what does not grow weighs least.
    """
    found = []
    for name in dict.fromkeys(entry["filter"] for entry in entries):
        own = sorted((e for e in entries if e["filter"] == name), key=lambda e: e[axis])
        sizes = [entry[axis] for entry in own]
        times = [entry["median"] for entry in own]
        found.append(
            {
                "axis": axis,
                "filter": name,
                "time": fit_slope(sizes, times),
                "time_last": fit_slope(sizes[-2:], times[-2:]),
                "memory": fit_slope(sizes, [entry["bytes"] for entry in own]),
            }
        )
    return found


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


def run_as_islands(num_particles: int, repeats: int) -> dict[str, Any]:
    """One particle filter on so many particles, its islands exchanging when they have to."""
    model = mpfjax.QuadraticModel(0.1, 0.1, -2.5, 2.5)
    moves = [mpfjax.Exchange(), mpfjax.Resample(), mpfjax.Propagate(model)]
    filter = mpfjax.Filter(model, moves, num_particles // NUM_ISLANDS)
    observations = (2 * jnp.sin(2 * jnp.pi * jnp.arange(1.0, ISLAND_STEPS + 1) / 100)) ** 2

    def run_islands(key: jax.Array) -> jax.Array:
        run = mpfjax.run_islands(key, filter, observations, nothing, num_islands=NUM_ISLANDS)
        return run.log_marginal_likelihood

    program = jax.jit(run_islands, compiler_options=wide_vectors())
    program = program.lower(jax.random.key(0)).compile()
    seconds = []
    for repeat in range(1 + repeats):
        start = time.perf_counter()
        jax.block_until_ready(program(jax.random.key(repeat)))
        seconds.append(time.perf_counter() - start)
        if sum(seconds[1:]) > SLOW_SECONDS and len(seconds) > FEWEST_REPEATS:
            break
    found = {"particles": num_particles, "islands": NUM_ISLANDS, "steps": ISLAND_STEPS}
    timed = {"seconds": seconds[1:], "median": float(np.median(seconds[1:]))}
    return {**found, **timed, "bytes": bytes_of(program)}


# --- tables and the picture -------------------------------------------------------------------


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


def island_table(found: list[dict[str, Any]]) -> str:
    """Time of a whole run, of a step and particle, and memory."""
    rows = [
        [
            str(entry["particles"]),
            f"{entry['median']:.3g}",
            f"{1e9 * entry['median'] / entry['steps'] / entry['particles']:.3g}",
            f"{entry['bytes'] / 1e6:.3g}",
        ]
        for entry in found
    ]
    title = f"particles on {NUM_ISLANDS} islands, {ISLAND_STEPS} steps"
    return format_table([title, "median [s]", "[ns] a particle and step", "memory [MB]"], rows)


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
