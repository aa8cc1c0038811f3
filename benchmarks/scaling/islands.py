"""One particle filter on more particles than other filters take, as islands."""

import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import mpfjax
from benchmarks.scaling.cells import FEWEST_REPEATS, SLOW_SECONDS, bytes_of, nothing
from mpfjax.console import format_table
from mpfjax.operations.compiling import cpu_options

NUM_ISLANDS, ISLAND_STEPS = 8, 20


def run_as_islands(num_particles: int, repeats: int) -> dict[str, Any]:
    """One particle filter on so many particles, its islands exchanging when they have to."""
    model = mpfjax.QuadraticModel(0.1, 0.1, -2.5, 2.5)
    moves = [mpfjax.IslandInteraction(), mpfjax.Resample(), mpfjax.Propagate(model)]
    filter = mpfjax.Filter(model, moves, num_particles // NUM_ISLANDS)
    observations = (2 * jnp.sin(2 * jnp.pi * jnp.arange(1.0, ISLAND_STEPS + 1) / 100)) ** 2

    def run_islands(key: jax.Array) -> jax.Array:
        run = mpfjax.run_islands(key, filter, observations, nothing, num_islands=NUM_ISLANDS)
        return run.log_marginal_likelihood

    program = jax.jit(run_islands, compiler_options=cpu_options())
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
