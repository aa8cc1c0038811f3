"""What `test_devices.py` starts in a process of its own, with more devices than the tests'.

    python -m tests.on_devices FILE

Double precision, in which rounding decides no draw, so that every number can be compared.
"""

import json
import math
import re
import sys

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

import mpfjax
from mpfjax.models.series import Series
from mpfjax.operations.islands import DEVICE_AXIS
from mpfjax.running.devices import _spread
from mpfjax.running.islands import IslandInteraction, _run_block

OBSERVATIONS = (1.5, 1.0, 0.4, 0.9)
NUM_KEYS = 11  # eight does not divide it
NUM_ISLANDS = 8


def quadratic():
    return mpfjax.QuadraticModel(0.3, 0.5, -2.0, 2.0)


def observations():
    return jnp.array(OBSERVATIONS)


def of_components(mixture):
    return mixture.component_means(), mixture.mixture_weights


def replicates():
    """Runs that share nothing."""
    filter = mpfjax.particle_filter(quadratic(), 40, ess_threshold=0.5)
    keys = jax.random.split(jax.random.key(0), NUM_KEYS)
    return mpfjax.monte_carlo(keys, filter, observations())


def islands_filter(num_particles=32):
    """A mixture whose islands exchange particles whenever their masses differ at all."""
    model = quadratic()
    moves = [
        IslandInteraction(1.0), mpfjax.Resample(), mpfjax.Propagate(), mpfjax.KMeans(2),
    ]  # fmt: skip
    return mpfjax.Filter(model, moves, num_particles, 2, [mpfjax.KMeans(2, reseed=True)])


def islands():
    """One mixture of eight islands."""
    key = jax.random.key(1)
    return mpfjax.run_islands(key, islands_filter(), observations(), num_islands=NUM_ISLANDS)


def compiled_islands(num_particles):
    """The text of the program of islands on all devices."""
    keys = jax.random.split(jax.random.key(1), NUM_ISLANDS)
    arguments = (islands_filter(num_particles), Series(observations()), of_components)
    mesh = Mesh(np.array(jax.devices()), (DEVICE_AXIS,))
    run = jax.jit(lambda keys: _spread(_run_block, keys, arguments, mesh))
    return str(run.lower(keys).compile().as_text())


def collectives(text):
    """(operation, how many numbers a device gets) for each collective of a program's text."""
    found = []
    sent = r"= (.*?) ((?:ragged-)?all-\w+(?:-\w+)??|reduce-scatter|collective-\w+)(?:-start)?\("
    for shapes, name in re.findall(sent, text):
        sizes = [shape.split(",") for shape in re.findall(r"\w\[([\d,]*)\]", shapes)]
        found.append((name, sum(math.prod(int(d) for d in size if d) for size in sizes)))
    return found


def leaves(**runs):
    """Every array of some runs, by the run's name and the leaf's place in it."""
    return {
        f"{name} {k}": np.asarray(leaf)
        for name, run in runs.items()
        for k, leaf in enumerate(jax.tree.leaves(run))
    }


def main(file):
    jax.config.update("jax_enable_x64", True)
    runs = leaves(replicates=replicates(), islands=islands())
    sent = json.dumps([len(jax.devices()), *collectives(compiled_islands(256))])
    np.savez(file, **runs, sent=np.asarray(sent))  # pyright: ignore[reportArgumentType]


if __name__ == "__main__":
    main(sys.argv[1])
