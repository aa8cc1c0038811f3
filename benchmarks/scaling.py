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

import contextlib
import socket
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.compilation_cache import compilation_cache

import mpfjax
from benchmarks import figures as plotting
from benchmarks import harness
from benchmarks.harness import Count, command, data, nothing, pivot, table, turns
from benchmarks.peers.worker import Worker, library_at_work, stop_all
from mpfjax.operations.compiling import cpu_options
from mpfjax.running.islands import IslandInteraction

FILTERS = {
    "pf": "PF",
    "mpf_fixed": "MPF, labels fixed",
    "mpf_kmeans": "MPF, K-means at every step",
    "mpf_default": "MPF: merge, split, K-means at every third step",
    "mpf": "MPF: merge, split, K-means at every step",
    "dps": "DPS, J = M objects",
}
PRICED = {
    "mpf_fixed": "labels fixed",
    "mpf_kmeans": "K-means at every step",
    "mpf_default": "merge, split, K-means at every third step, the default",
    "mpf": "merge, split, K-means at every step",
}
AXES = {
    "particles": "number of particles $N$",
    "components": "number of components $M$",
    "seeds": "number of seeds",
    "steps": "number of steps $T$",
}
BUDGET, TIME_LIMIT = 6.0, 300.0  # seconds
NUM_ISLANDS, ISLAND_STEPS = 8, 20


class Cell(NamedTuple):
    """One thing that is timed."""

    filter: str
    particles: int
    components: int
    seeds: int
    steps: int


class Sizes(NamedTuple):
    """What is measured: the middle is a point of every axis, so that it compiles once.

    - `spread`: N and seeds of the job that is spread over devices and processes.
    - `priced`: the N whose mixtures are compared with plain filters, at every M of the axis; first
      calls are of the first of them.
    """

    middle: dict[str, int]
    axes: dict[str, list[int]]
    spread: dict[str, int]
    priced: list[int]


FULL = Sizes(
    {"particles": 4000, "components": 2, "seeds": 8, "steps": 50},
    {
        "particles": [1000, 4000, 16_000, 64_000],
        "components": [2, 12, 64],
        "seeds": [8, 24, 72],
        "steps": [50, 150, 450],
    },
    {"particles": 10_000, "seeds": 20},
    [1000, 4000, 16_000],
)
TINY = Sizes(
    {"particles": 64, "components": 2, "seeds": 2, "steps": 4},
    {"particles": [64, 128], "components": [2, 4], "seeds": [2, 4], "steps": [4, 8]},
    {"particles": 64, "seeds": 4},
    [64],
)


@command()
def main(
    *,
    filters: Sequence[Annotated[str, (*FILTERS,)]] = (*FILTERS,),
    axes: Annotated[Sequence[Annotated[str, (*AXES,)]], "*"] = (*AXES,),
    islands: Annotated[Sequence[Count], "*"] = (),
    repeats: Count = 5,
    devices: Annotated[Sequence[Count], "*"] = (1, 2),
    processes: Annotated[Sequence[Count], "*"] = (1, 2),
    price: bool = True,
    quick: bool = False,
    out: Path = Path("results/scaling"),
) -> None:
    """Axis after axis, then devices and processes, each written as it is finished.

    - `axes`: none: leave out.
    - `islands`: particles of one filter.
    - `repeats`: times that each cell is timed.
    - `devices`: none: leave out.
    - `processes`: none: leave out.
    - `price`: of a mixture over a plain filter, by N and M, with first calls.
    """
    if uneven := [number for number in islands if number % NUM_ISLANDS**2]:
        raise ValueError(f"--islands: {uneven[0]} is not a positive multiple of {NUM_ISLANDS**2}")
    sizes = TINY if quick else FULL
    content: dict[str, Any] = {
        "settings": harness.settings_of(locals() | sizes._asdict(), sizes=None), "results": [],
        "slopes": [], "spread": [], "price": [], "first_calls": [], "islands": [],
    }  # fmt: skip
    programs: dict[Cell, Any] = {}
    for axis in axes:
        entries = vary(axis, filters, sizes, programs, repeats)
        content["results"] += entries
        content["slopes"] += slopes_of(axis, entries)
        data(out / "scaling.json", **content)
        print(as_tables(axis, entries, content["slopes"]), end="\n\n")
    for kind, numbers in (("devices", devices), ("processes", processes)):
        if numbers:
            found = spread_over(kind, numbers, sizes.spread, repeats)
            content["spread"] += found
            title = f"{kind} (PF, N = {sizes.spread['particles']}, {sizes.spread['seeds']} seeds)"
            columns = {title: "{number}", "median [ms]": "{milliseconds:.4g}", "gain": "{gain:.2f}"}
            print(table(columns, found), end="\n\n")
    if price:
        content["price"] = price_of(sizes, repeats)
        content["first_calls"] = first_calls(sizes)
        print(price_table(content["price"], content["first_calls"]), end="\n\n")
    if islands:
        content["islands"] = [run_as_islands(number, repeats) for number in islands]
        print(table(ISLAND_COLUMNS, content["islands"]), end="\n\n")
    data(out / "scaling.json", **content)
    if content["results"]:
        harness.figures(out, scaling=draw(content["results"]))
    print(f"results: {out}/")


def observed(num_steps: int) -> jax.Array:
    """Observations of the quadratic model."""
    return (2 * jnp.sin(2 * jnp.pi * jnp.arange(1.0, num_steps + 1) / 100)) ** 2


def all_runs(cell: Cell) -> Callable[[Any], mpfjax.FilterRun]:
    """A function from the keys of a cell's seeds to their runs, as a user would call it."""
    model = mpfjax.QuadraticModel(0.1, 0.1, -2.5, 2.5)
    observations, n, m = observed(cell.steps), cell.particles, cell.components
    if cell.filter == "pf":
        filter = mpfjax.particle_filter(model, n)
    elif cell.filter == "mpf":
        filter = mpfjax.mixture_particle_filter(model, n, m, regroup_every=1)
    elif cell.filter == "mpf_default":
        filter = mpfjax.mixture_particle_filter(model, n, m)
    elif cell.filter == "dps":
        filter = mpfjax.distributed_partitioned_sampling(mpfjax.MultiObjectModel(model, m), n)
        observations = jnp.broadcast_to(observations[:, None], (cell.steps, m))
    else:
        moves: list[Any] = [mpfjax.Resample(), mpfjax.Propagate(model)]
        moves += [mpfjax.KMeans()] if cell.filter == "mpf_kmeans" else []
        # Dealt at random at the start, which costs next to nothing at any T.
        filter = mpfjax.Filter(model, moves, n, m, [mpfjax.RandomPartition()])
    return lambda keys: mpfjax.monte_carlo(keys, filter, observations, nothing)


def keys_of(cell: Cell) -> jax.Array:
    """Of all its seeds."""
    return jax.random.split(jax.random.key(0), cell.seeds)


def compiled(function: Callable[..., Any], *arguments: Any) -> Any:
    """A function as one program."""
    return jax.jit(function, compiler_options=cpu_options()).lower(*arguments).compile()


def bytes_of(program: Any) -> int:
    """Temporaries and results of a compiled program; exact, and known before it runs."""
    memory = program.memory_analysis()
    return int(memory.temp_size_in_bytes + memory.output_size_in_bytes)


def vary(
    axis: str, filters: Sequence[str], sizes: Sizes, programs: dict[Cell, Any], repeats: int
) -> list[dict[str, Any]]:
    """Times and memory of the middle with one axis varied; adds to the programs.

    The PF, which has no components, stands there once where M is varied.
    """
    cells = []
    for name in filters:
        for value in sizes.axes[axis]:
            cell = Cell(filter=name, **(sizes.middle | {axis: value}))
            cells.append(cell._replace(components=1) if name == "pf" else cell)
    cells = list(dict.fromkeys(cells))
    new = [cell for cell in cells if cell not in programs]
    with ThreadPoolExecutor(max_workers=2) as pool:
        made = pool.map(lambda cell: compiled(all_runs(cell), keys_of(cell)), new)
        programs.update(zip(new, made, strict=True))
    keys = {cell: keys_of(cell) for cell in cells}
    runs = {cell: lambda _, cell=cell: programs[cell](keys[cell]) for cell in cells}
    return [
        {"axis": axis, **cell._asdict(), "seconds": seconds, "median": float(np.median(seconds)),
         "bytes": bytes_of(programs[cell])}
        for cell, seconds in turns(runs, repeats, budget=BUDGET).items()
    ]  # fmt: skip


def fit_slope(sizes: Sequence[float], costs: Sequence[float]) -> float | None:
    """The least-squares slope of log cost against log size; None for fewer than two sizes."""
    if len(set(sizes)) < 2:
        return None
    return float(np.polyfit(np.log(sizes), np.log(costs), 1)[0])


def slopes_of(axis: str, entries: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """How time and memory grow along an axis, for each filter; also between the last two points,
    where what does not grow weighs least.
    """
    found = []
    for name in dict.fromkeys(entry["filter"] for entry in entries):
        own = sorted((e for e in entries if e["filter"] == name), key=lambda e: e[axis])
        sizes = [entry[axis] for entry in own]
        times = [entry["median"] for entry in own]
        found.append({
            "axis": axis, "filter": name, "time": fit_slope(sizes, times),
            "time_last": fit_slope(sizes[-2:], times[-2:]),
            "memory": fit_slope(sizes, [entry["bytes"] for entry in own]),
        })  # fmt: skip
    return found


def as_tables(axis: str, entries: list[dict[str, Any]], slopes: list[dict[str, Any]]) -> str:
    """Times with their ratios to the PF's of the same size, memory, and the slopes of both."""
    plain = {entry[axis]: entry["median"] for entry in entries if entry["filter"] == "pf"}
    own = [slope for slope in slopes if slope["axis"] == axis]
    cells = sorted(entries, key=lambda entry: entry[axis])

    def time_of(entry: dict[str, Any]) -> str:
        pf = plain.get(1 if axis == "components" else entry[axis])
        over = "" if pf is None else f" {entry['median'] / pf:6.2f}"
        return f"{1000 * entry['median']:.4g}{over}"

    def one(title: str, form: Callable[[dict[str, Any]], str], ends: dict[str, str]) -> str:
        lines = [each | {"at": f"{axis} {each[axis]}", "text": form(each)} for each in cells]
        for end, name in ends.items():
            lines += [
                slope | {"at": end, "text": "-" if slope[name] is None else f"{slope[name]:.2f}"}
                for slope in own
            ]
        return pivot(title, lines, lambda line: FILTERS[line["filter"]], "{at}", "{text}")

    times = {"slope": "time", "slope at the end": "time_last"}
    memory = one("memory [MB]", lambda e: f"{e['bytes'] / 1e6:.3g}", {"slope": "memory"})
    return f"{one('median [ms], ratio to PF', time_of, times)}\n\n{memory}"


def draw(results: list[dict[str, Any]]) -> Any:
    """A column for each axis, time above memory, a line for each filter."""

    def panel(axis: str, label: str, cost: Callable[[dict[str, Any]], float]) -> Any:
        own = [entry for entry in results if entry["axis"] == axis]
        lines = plotting.lines_of(own, lambda e: FILTERS[e["filter"]], axis, cost)
        return plotting.Panel("", AXES[axis], label, lines)

    axes = list(dict.fromkeys(entry["axis"] for entry in results))
    times = [panel(axis, "time of all runs [ms]", lambda e: 1000 * e["median"]) for axis in axes]
    memory = [panel(axis, "memory [MB]", lambda e: e["bytes"] / 1e6) for axis in axes]
    return plotting.draw_panels([times, memory])


# --- a mixture's price --------------------------------------------------------------------------


def price_of(sizes: Sizes, repeats: int) -> list[dict[str, Any]]:
    """Each filter at each size, with the median ratio of its time to the plain filter's.

    Timed are calls of `monte_carlo`, which divides the seeds among threads.
    """
    entries = []
    for n in sizes.priced:
        plain, *mixtures = priced_cells(sizes, n)
        keys = keys_of(plain)
        runs = {cell: all_runs(cell) for cell in [plain, *mixtures]}
        calls = {cell: lambda _, run=run, keys=keys: run(keys) for cell, run in runs.items()}
        taken = turns(calls, repeats, budget=BUDGET)
        entries += [
            cell._asdict()
            | {"seconds": taken[cell], "ratio": harness.ratio(taken[cell], taken[plain])}
            for cell in mixtures
        ]
    return entries


def priced_cells(sizes: Sizes, n: int) -> list[Cell]:
    """The plain filter, and every mixture with every number of components."""
    rest = sizes.middle["seeds"], sizes.middle["steps"]
    mixtures = [Cell(name, n, m, *rest) for name in PRICED for m in sizes.axes["components"]]
    return [Cell("pf", n, 1, *rest), *mixtures]


def first_calls(sizes: Sizes) -> list[dict[str, Any]]:
    """Seconds from a filter to its first results, with nothing compiled before."""
    entries = []
    with _nothing_kept():
        for cell in priced_cells(sizes, sizes.priced[0]):
            jax.clear_caches()
            run_all, keys = all_runs(cell), keys_of(cell)
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
    lines = [e | {"what": f"N = {e['particles']}", "text": f"{e['ratio']:.2f}"} for e in entries]
    for cell in dict.fromkeys((e["filter"], e["components"]) for e in entries):
        own = [e for e in entries if (e["filter"], e["components"]) == cell]
        times = [float(np.median(e["seconds"])) for e in own]
        slope = fit_slope([e["particles"] for e in own], times)
        text = "-" if slope is None else f"{slope:.2f}"
        lines.append(own[0] | {"what": "slope in N", "text": text})
    plain, *mixtures = calls
    lines += [e | {"what": "first call [s]", "text": f"{e['first_call']:.1f}"} for e in mixtures]
    lines.sort(key=lambda line: list(PRICED).index(line["filter"]))
    title = f"time over the plain filter's (its first call: {plain['first_call']:.1f} s)"
    name = lambda line: f"{PRICED[line['filter']]}: {line['what']}"  # noqa: E731
    return pivot(title, lines, name, "M = {components}", "{text}")


# --- devices, processes and islands -------------------------------------------------------------


def spread_over(
    kind: str, numbers: Sequence[int], size: dict[str, int], repeats: int
) -> list[dict[str, Any]]:
    """The particle filter's seeds over so many devices of one process, or over processes."""
    groups = {number: start_group(kind, number) for number in numbers}
    taken: dict[int, list[float]] = {number: [] for number in numbers}
    try:
        for workers in groups.values():
            _answers(workers)
        for repeat in range(1 + repeats):
            for number, workers in groups.items():
                for worker in workers:
                    worker.ask(**size, seed=repeat)
                taken[number].append(max(found["seconds"] for found in _answers(workers)))
    finally:
        for workers in groups.values():
            stop_all(workers)
    medians = {number: float(np.median(seconds[1:])) for number, seconds in taken.items()}
    return [
        {"kind": kind, "number": number, "seconds": taken[number][1:], "median": median,
         "milliseconds": 1000 * median, "gain": medians[numbers[0]] / median}
        for number, median in medians.items()
    ]  # fmt: skip


def start_group(kind: str, number: int) -> list[Worker]:
    """One process with so many devices, or so many processes with one device each."""
    if kind == "devices":
        return [Worker(library_at_work, "mpfjax", "quadratic", number)]
    with socket.socket() as probe:
        probe.bind(("localhost", 0))
        address = f"localhost:{probe.getsockname()[1]}"
    return [
        Worker(library_at_work, "mpfjax", "quadratic", 1, (address, number, index))
        for index in range(number)
    ]


def _answers(workers: list[Worker]) -> list[dict[str, Any]]:
    found = [worker.answer(TIME_LIMIT) for worker in workers]
    for each in found:
        if "error" in each:
            raise ValueError(f"a process of the benchmark failed: {each['error']}")
    return found


ISLAND_COLUMNS = {
    f"particles on {NUM_ISLANDS} islands, {ISLAND_STEPS} steps": "{particles}",
    "median [s]": "{median:.3g}",
    "[ns] a particle and step": lambda e: f"{1e9 * e['median'] / e['steps'] / e['particles']:.3g}",
    "memory [MB]": lambda e: f"{e['bytes'] / 1e6:.3g}",
}


def run_as_islands(num_particles: int, repeats: int) -> dict[str, Any]:
    """One particle filter on so many particles, its islands exchanging when they have to."""
    model = mpfjax.QuadraticModel(0.1, 0.1, -2.5, 2.5)
    moves = [IslandInteraction(), mpfjax.Resample(), mpfjax.Propagate(model)]
    filter = mpfjax.Filter(model, moves, num_particles // NUM_ISLANDS)
    observations = observed(ISLAND_STEPS)

    def run_islands(key: jax.Array) -> jax.Array:
        run = mpfjax.run_islands(key, filter, observations, nothing, num_islands=NUM_ISLANDS)
        return run.log_marginal_likelihood

    program = compiled(run_islands, jax.random.key(0))
    (seconds,) = turns(
        {"islands": lambda turn: program(jax.random.key(turn))}, repeats, budget=BUDGET
    ).values()
    return {
        "particles": num_particles, "islands": NUM_ISLANDS, "steps": ISLAND_STEPS,
        "seconds": seconds, "median": float(np.median(seconds)), "bytes": bytes_of(program),
    }  # fmt: skip


if __name__ == "__main__":
    raise SystemExit(main())
