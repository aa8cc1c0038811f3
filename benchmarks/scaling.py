"""What time and memory grow with: N, M, seeds and T, and what a mixture costs.

    python -m benchmarks.scaling
    python -m benchmarks.scaling --axes components --particles 1000      # a mixture's price
    python -m benchmarks.scaling --against HEAD~5 --particles 1000 10000 # what commits changed
    python -m benchmarks.scaling --axes --islands 10000128               # one filter, as islands

The quadratic model, whose likelihood costs next to nothing, so that what is seen is the filter;
DPS tracks J such objects. One axis is varied at a time, the others have their first size. The cells
of an axis take turns. Timed are calls of `monte_carlo`, which divides the seeds among threads, and
ratios to the plain filter's time are medians over the turns. Slopes are those of log-log points: 1
is proportional, 0 no growth. Memory is what one program of all runs asks for, its temporaries and
results, with nothing collected. Into --out DIR goes scaling.json.
"""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import mpfjax
from benchmarks import commits, harness
from benchmarks.harness import Count, command, data, nothing, pivot, table, turns
from mpfjax.operations.compiling import cpu_options

FILTERS = {
    "pf": "PF",
    "mpf_fixed": "MPF, labels fixed",
    "mpf_default": "MPF: merge, split, K-means at every third step",
    "mpf": "MPF: merge, split, K-means at every step",
    "dps": "DPS, J = M objects",
}
AXES = ("particles", "components", "seeds", "steps")
BUDGET = 6.0  # seconds
NUM_ISLANDS, ISLAND_STEPS = 8, 20
Sizes = Mapping[str, Sequence[int]]  # of each axis


class Cell(NamedTuple):
    """One thing that is timed."""

    filter: str
    particles: int
    components: int
    seeds: int
    steps: int


@command(filters=["pf", "mpf"], particles=[64, 128], components=[2, 4], seeds=[2, 4], steps=[4, 8])
def main(
    *,
    filters: Sequence[Annotated[str, (*FILTERS,)]] = (*FILTERS,),
    axes: Annotated[Sequence[Annotated[str, AXES]], "*"] = AXES,
    particles: Sequence[Count] = (4000, 1000, 16_000, 64_000),
    components: Sequence[Count] = (2, 12, 64),
    seeds: Sequence[Count] = (8, 24, 72),
    steps: Sequence[Count] = (50, 150, 450),
    islands: Annotated[Sequence[Count], "*"] = (),
    repeats: Count = 5,
    against: str = "",
    out: Path = Path("results/scaling"),
) -> None:
    """Axis after axis, each written as it is finished.

    - `axes`: none: leave out.
    - `particles`: the first is N where another axis is varied, likewise below.
    - `islands`: particles of one filter.
    - `repeats`: times that each cell is timed.
    - `against`: a commit, whose filters run in turns with these; nothing else is timed.
    """
    if against:
        entries = commits.ratios(against, particles, repeats)
        print(f"time over that of {against}, {commits.processor()}\n\n{table(None, entries)}")
        data(out / "against.json", settings=harness.settings_of(locals()), results=entries)
        return
    if uneven := [number for number in islands if number % NUM_ISLANDS**2]:
        raise ValueError(f"--islands: {uneven[0]} is not a positive multiple of {NUM_ISLANDS**2}")
    content: dict[str, Any] = {"settings": harness.settings_of(locals()), "results": []}
    sizes: Sizes = dict(zip(AXES, (particles, components, seeds, steps), strict=True))
    memory: dict[Cell, int] = {}
    for axis in axes:
        entries = vary(axis, filters, sizes, memory, repeats)
        content["results"] += entries
        data(out / "scaling.json", **content)
        print(as_tables(axis, entries), end="\n\n")
    if islands:
        content["islands"] = [run_as_islands(number, repeats) for number in islands]
        print(table(None, content["islands"]), end="\n\n")
    data(out / "scaling.json", **content)
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
        moves = [mpfjax.Resample(), mpfjax.Propagate()]
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
    axis: str, filters: Sequence[str], sizes: Sizes, memory: dict[Cell, int], repeats: int
) -> list[dict[str, Any]]:
    """Times and memory with one axis varied; adds to the memory.

    The PF, which has no components, stands there once where M is varied.
    """
    cells = []
    for name in filters:
        for value in sorted(sizes[axis]):
            cell = Cell(name, **({each: sizes[each][0] for each in AXES} | {axis: value}))
            cells.append(cell._replace(components=1) if name == "pf" else cell)
    cells = list(dict.fromkeys(cells))
    calls = {cell: (all_runs(cell), keys_of(cell)) for cell in cells}
    new = [cell for cell in cells if cell not in memory]
    with ThreadPoolExecutor(max_workers=2) as pool:
        program_sizes = pool.map(lambda cell: bytes_of(compiled(*calls[cell])), new)
        memory.update(zip(new, program_sizes, strict=True))
    runs = {cell: lambda _, call=call: call[0](call[1]) for cell, call in calls.items()}
    times = turns(runs, repeats, budget=BUDGET)
    entries = []
    for cell, seconds in times.items():
        median, plain = float(np.median(seconds)), cell._replace(filter="pf", components=1)
        entry = {"axis": axis, **cell._asdict(), "seconds": seconds, "median": median}
        entries.append(entry | {"bytes": memory[cell]})
        if plain in times:
            entries[-1]["ratio"] = harness.ratio(seconds, times[plain])
    return entries


def fit_slope(sizes: Sequence[float], costs: Sequence[float]) -> float | None:
    """The least-squares slope of log cost against log size; None for fewer than two sizes."""
    if len(set(sizes)) < 2:
        return None
    return float(np.polyfit(np.log(sizes), np.log(costs), 1)[0])


def as_tables(axis: str, entries: list[dict[str, Any]]) -> str:
    """Times with their ratios to the PF's of the same size, memory, and slopes.

    That of time is between the last two points, where what does not grow weighs least.
    """
    cells = sorted(entries, key=lambda entry: entry[axis])

    def time_of(entry: dict[str, Any]) -> str:
        over = f" {entry['ratio']:6.2f}" if "ratio" in entry else ""
        return f"{1000 * entry['median']:.4g}{over}"

    def one(title: str, cost: str, form: Callable[[dict[str, Any]], str], last: int) -> str:
        lines = [each | {"at": f"{axis} {each[axis]}", "text": form(each)} for each in cells]
        for name in dict.fromkeys(each["filter"] for each in cells):
            rows = [each for each in cells if each["filter"] == name][-last:]
            slope = fit_slope([each[axis] for each in rows], [each[cost] for each in rows])
            text = "-" if slope is None else f"{slope:.2f}"
            lines.append({"filter": name, "at": "slope", "text": text})
        return pivot(title, lines, lambda line: FILTERS[line["filter"]], "{at}", "{text}")

    times = one("median [ms], ratio to PF", "median", time_of, 2)
    memory = one("memory [MB]", "bytes", lambda entry: f"{entry['bytes'] / 1e6:.3g}", 0)
    return f"{times}\n\n{memory}"


# --- one filter as islands -----------------------------------------------------------------------


def run_as_islands(num_particles: int, repeats: int) -> dict[str, Any]:
    """One particle filter on so many particles, its islands exchanging when they have to."""
    model = mpfjax.QuadraticModel(0.1, 0.1, -2.5, 2.5)
    moves = [mpfjax.IslandInteraction(), mpfjax.Resample(), mpfjax.Propagate()]
    filter = mpfjax.Filter(model, moves, num_particles // NUM_ISLANDS)
    observations = observed(ISLAND_STEPS)

    def run_islands(key: jax.Array) -> jax.Array:
        run = mpfjax.run_islands(key, filter, observations, nothing, num_islands=NUM_ISLANDS)
        return run.log_marginal_likelihood

    program = compiled(run_islands, jax.random.key(0))
    runs = {"islands": lambda turn: program(jax.random.key(turn))}
    median = float(np.median(turns(runs, repeats, budget=BUDGET)["islands"]))
    nanoseconds = 1e9 * median / ISLAND_STEPS / num_particles
    return {
        f"particles on {NUM_ISLANDS} islands, {ISLAND_STEPS} steps": num_particles,
        "median [s]": median, "[ns] a particle and step": nanoseconds,
        "memory [MB]": bytes_of(program) / 1e6,
    }  # fmt: skip


if __name__ == "__main__":
    raise SystemExit(main())
