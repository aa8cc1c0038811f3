"""What `test_devices.py` starts in processes of their own, with other devices than the tests'.

    python -m tests.on_devices FILE                 on all devices of this process
    python -m tests.on_devices FILE PORT PROCESS    as one of two processes

Double precision, in which rounding decides no draw, so that every number can be compared.
"""

import json
import math
import re
import sys

import jax
import jax.numpy as jnp
import numpy as np

import mpfjax
from mpfjax.models.series import Series
from mpfjax.running.devices import over_devices
from mpfjax.running.islands import IslandInteraction, _run_block, _run_on_one

OBSERVATIONS = (1.5, 1.0, 0.4, 0.9)
NUM_KEYS = 11  # neither 2 nor 8 divides it
NUM_ISLANDS = 8


def quadratic():
    return mpfjax.QuadraticModel(0.3, 0.5, -2.0, 2.0)


def observations():
    return jnp.array(OBSERVATIONS)


def of_components(mixture):
    return mixture.component_means(), mixture.mixture_weights


def replicates(devices=None, seed=0):
    """Runs that share nothing."""
    filter = mpfjax.particle_filter(quadratic(), 40, ess_threshold=0.5)
    keys = jax.random.split(jax.random.key(seed), NUM_KEYS)
    return mpfjax.monte_carlo(keys, filter, observations(), devices=devices)


def islands_filter(num_particles=32):
    """A mixture whose islands exchange particles whenever their masses differ at all."""
    model = quadratic()
    moves = [
        IslandInteraction(1.0), mpfjax.Resample(), mpfjax.Propagate(), mpfjax.KMeans(2),
    ]  # fmt: skip
    return mpfjax.Filter(model, moves, num_particles, 2, [mpfjax.KMeans(2, reseed=True)])


def islands(devices=None):
    """One mixture of eight islands."""
    return mpfjax.run_islands(
        jax.random.key(1),
        islands_filter(),
        observations(),
        num_islands=NUM_ISLANDS,
        devices=devices,
    )


def compiled_islands(num_particles):
    """The text of the program of islands on all devices."""
    keys = jax.random.split(jax.random.key(1), NUM_ISLANDS)
    arguments = (islands_filter(num_particles), Series(observations()), of_components)
    run = jax.jit(
        lambda keys: over_devices(_run_block, _run_on_one, keys, arguments, jax.devices())
    )
    return str(run.lower(keys).compile().as_text())


def collectives(text):
    """(operation, how many numbers a device gets) for each collective of a program's text."""
    found = []
    sent = r"= (.*?) ((?:ragged-)?all-\w+(?:-\w+)??|reduce-scatter|collective-\w+)(?:-start)?\("
    for shapes, name in re.findall(sent, text):
        sizes = [shape.split(",") for shape in re.findall(r"\w\[([\d,]*)\]", shapes)]
        found.append((name, sum(math.prod(int(d) for d in size if d) for size in sizes)))
    return found


def draw(keys):
    return jax.vmap(jax.random.uniform)(keys)


def error_of(call):
    try:
        call()
    except ValueError as error:
        return str(error)
    return None


def leaves(**runs):
    """Every array of some runs, by the run's name and the leaf's place in it."""
    return {
        f"{name} {k}": np.asarray(leaf)
        for name, run in runs.items()
        for k, leaf in enumerate(jax.tree.leaves(run))
    }


def main(file, port=None, process="0"):
    jax.config.update("jax_enable_x64", True)
    if port is not None:
        jax.distributed.initialize(f"localhost:{port}", 2, int(process), initialization_timeout=60)
    runs = leaves(replicates=replicates(), islands=islands())
    told: dict = {"devices": len(jax.devices())}
    if port is not None:
        told["other keys"] = error_of(lambda: replicates(seed=int(process)))
        told["left out"] = error_of(lambda: replicates(1))
    else:
        told["collectives"] = collectives(compiled_islands(256))
        last, keys = jax.devices()[-1:], jax.random.split(jax.random.key(0), 3)
        told["only device"] = over_devices(draw, jax.jit(draw), keys, (), last).devices() == {*last}
        told["too many"] = error_of(lambda: replicates(9))
        told["twice"] = error_of(lambda: replicates([*last, *last]))
        told["uneven"] = error_of(lambda: islands(3))
    runs["told"] = np.asarray(json.dumps(told))
    np.savez(file, **runs)  # pyright: ignore[reportArgumentType]


if __name__ == "__main__":
    main(*sys.argv[1:])
