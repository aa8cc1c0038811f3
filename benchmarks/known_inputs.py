"""What known inputs cost: a run with u_t by time, beside one of the model with u built in.

    python -m benchmarks.known_inputs

A driven Ornstein-Uhlenbeck process whose control and time step are the same at every step. One
model holds them as constants, the other is given them as inputs, so that both make the same draws.
They run in turns, and each turn has its ratio of processor time. Printed are the median of these
ratios, the ratio of the least times, and how often JAX traced the model when other inputs of the
same shape came: 0. Into --out DIR goes known_inputs.json.
"""

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key, PyTree

import mpfjax
from mpfjax.console import exit_status, format_table, whole, write_json

FILTERS: dict[str, Callable[[Any, int], mpfjax.Filter]] = {
    "PF": mpfjax.particle_filter,
    "MPF, 4 components": lambda model, size: mpfjax.mixture_particle_filter(model, size, 4),
}
HEADER = ["filter", "N", "ms a run", "median ratio", "ratio of the least", "traced again"]
_RATE, _GAIN, _SPREAD, _ERROR = 0.8, 1.2, 0.7, 0.4
_traced: list[None] = []


class Driven(mpfjax.AbstractStateSpaceModel):
    """dx = k (g u - x) dt + s dW over a time dt, seen with an error."""

    inputs: Any = None
    noise_dimension = 1

    def sample_initial(self, key: Key[Array, ""], num_particles: int) -> Float[Array, " n"]:
        """Standard normal numbers."""
        return mpfjax.normal(key, (num_particles,))

    def transition_from_noise(
        self, noise: Float[Array, "n 1"], states: Float[Array, " n"]
    ) -> Float[Array, " n"]:
        """The exact transition over the time."""
        _traced.append(None)
        kept = jnp.exp(-_RATE * self.inputs["dt"])
        spread = _SPREAD * jnp.sqrt((1 - kept**2) / (2 * _RATE))
        return kept * states + (1 - kept) * _GAIN * self.inputs["u"] + spread * noise[:, 0]

    def log_likelihood(self, observation: PyTree, states: Float[Array, " n"]) -> Float[Array, " n"]:
        """A Gaussian error."""
        return -0.5 * ((observation - states) / _ERROR) ** 2


def main(arguments: list[str] | None = None) -> int:
    """Time both ways, print a table, and write the results."""
    options = parse(arguments)
    return exit_status(lambda: run(options), arguments)


def parse(arguments: list[str] | None) -> argparse.Namespace:
    """The options, or a message that names the one that cannot be run."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.known_inputs")
    parser.add_argument("--particles", type=whole(), nargs="+", default=[1000, 10_000], metavar="N")
    parser.add_argument("--steps", type=whole(), default=200)
    parser.add_argument("--repeats", type=whole(2), default=200, help="turns")
    parser.add_argument("--out", default="results/known_inputs", metavar="DIR")
    return parser.parse_args(arguments)


def run(options: argparse.Namespace) -> None:
    """Each filter and size."""
    results = [
        {"filter": name, "N": size, **measured(make, size, options.steps, options.repeats)}
        for name, make in FILTERS.items()
        for size in options.particles
    ]
    print(format_table(HEADER, [row_of(result) for result in results]))
    out = Path(options.out)
    out.mkdir(parents=True, exist_ok=True)
    write_json(out / "known_inputs.json", {"settings": vars(options), "results": results})
    print(f"results: {out}/")


def measured(
    make: Callable[[Any, int], mpfjax.Filter], size: int, steps: int, repeats: int
) -> dict[str, float]:
    """Milliseconds without inputs, ratios of those with them, and traces by other inputs."""
    constant = {"dt": jnp.asarray(0.5), "u": jnp.asarray(1.0)}
    by_time = jax.tree.map(lambda leaf: jnp.repeat(leaf[None], steps), constant)
    observations = 1 + jax.random.normal(jax.random.key(1), (steps,))
    built_in, given = make(Driven(inputs=constant), size), make(Driven(), size)

    def once(filter: mpfjax.Filter, inputs: PyTree) -> float:
        start = time.process_time()
        run = mpfjax.run_filter(jax.random.key(0), filter, observations, nothing, inputs=inputs)
        jax.block_until_ready(run.log_marginal_likelihood)
        return time.process_time() - start

    once(built_in, None)
    once(given, by_time)
    traced = len(_traced)
    once(given, jax.tree.map(lambda leaf: 0.9 * leaf, by_time))
    traced = len(_traced) - traced
    taken = []
    for turn in range(repeats):  # who comes first changes from turn to turn
        pair = [lambda: once(built_in, None), lambda: once(given, by_time)]
        order = (0, 1) if turn % 2 else (1, 0)
        seconds = {which: pair[which]() for which in order}
        taken.append((seconds[0], seconds[1]))
    without, with_inputs = np.array(taken).T
    return {
        "ms": 1000 * float(without.min()),
        "median_ratio": float(np.median(with_inputs / without)),
        "least_ratio": float(with_inputs.min() / without.min()),
        "traced_again": traced,
    }


def nothing(mixture: mpfjax.ParticleMixture) -> None:
    """What is collected."""


def row_of(result: dict[str, Any]) -> list[str]:
    """A line of the table."""
    return [
        result["filter"],
        str(result["N"]),
        f"{result['ms']:.2f}",
        f"{result['median_ratio']:.3f}",
        f"{result['least_ratio']:.3f}",
        str(result["traced_again"]),
    ]


if __name__ == "__main__":
    sys.exit(main())
