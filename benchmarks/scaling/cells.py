"""One filter at one size: how it is built, compiled and timed, and what its cost grows with."""

import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import mpfjax
from mpfjax.operations.compiling import cpu_options

FILTERS = {
    "pf": "PF",
    "mpf_fixed": "MPF, labels fixed",
    "mpf_kmeans": "MPF, K-means at every step",
    "mpf_default": "MPF: merge, split, K-means at every third step",
    "mpf": "MPF: merge, split, K-means at every step",
    "dps": "DPS, J = M objects",
}
AXES = {
    "particles": "number of particles $N$",
    "components": "number of components $M$",
    "seeds": "number of seeds",
    "steps": "number of steps $T$",
}
SLOW_SECONDS, FEWEST_REPEATS = 6.0, 3


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
        return mpfjax.mixture_particle_filter(model, n, m, regroup_every=1), observations
    if cell.filter == "mpf_default":
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


def compile_cells(cells: list[Cell], programs: dict[Cell, Any]) -> None:
    """Add the programs that are not there yet, two at a time."""
    new = [cell for cell in cells if cell not in programs]
    with ThreadPoolExecutor(max_workers=2) as pool:
        programs.update(zip(new, pool.map(compile_cell, new), strict=True))


def measure(runs: Mapping[Cell, Callable[[Any], Any]], repeats: int) -> dict[Cell, list[float]]:
    """Seconds of each run of every cell, in turns; `runs` take the keys of all seeds."""
    cells = list(runs)
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
            jax.block_until_ready(runs[cell](keys[cell]))
            if repeat > 0:
                elapsed[cell].append(time.perf_counter() - start)
    return elapsed


def all_runs(cell: Cell) -> Callable[[Any], mpfjax.FilterRun]:
    """A function from the keys of a cell's seeds to their runs, as a user would call it."""
    filter, observations = build(cell)

    def run_all(keys: Any) -> mpfjax.FilterRun:
        return mpfjax.monte_carlo(keys, filter, observations, nothing)

    return run_all


def compile_cell(cell: Cell) -> Any:
    """The runs of a cell as one program, from keys to results."""
    run_all = all_runs(cell)
    keys = jax.eval_shape(lambda: jax.random.split(jax.random.key(0), cell.seeds))
    return jax.jit(run_all, compiler_options=cpu_options()).lower(keys).compile()


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
