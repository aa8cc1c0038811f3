"""What `test_devices.py` starts in a process of its own, with more devices than the tests'.

    python -m tests.on_devices FILE

Double precision, in which rounding decides no draw, so that every number can be compared.
"""

import sys

import jax
import jax.numpy as jnp
import numpy as np

import mpfjax

OBSERVATIONS = (1.5, 1.0, 0.4, 0.9)
NUM_KEYS = 11  # eight does not divide it


def quadratic():
    return mpfjax.QuadraticModel(0.3, 0.5, -2.0, 2.0)


def observations():
    return jnp.array(OBSERVATIONS)


def replicates():
    """Runs that share nothing."""
    filter = mpfjax.particle_filter(quadratic(), 40, ess_threshold=0.5)
    keys = jax.random.split(jax.random.key(0), NUM_KEYS)
    return mpfjax.monte_carlo(keys, filter, observations())


def islands():
    """One mixture of eight islands, which exchange particles where their masses differ at all."""
    exchange = mpfjax.IslandInteraction(1.0)
    moves = [exchange, mpfjax.Resample(), mpfjax.Propagate(), mpfjax.KMeans(2)]
    filter = mpfjax.Filter(quadratic(), moves, 32, 2, [mpfjax.KMeans(2, reseed=True)])
    return mpfjax.run_islands(jax.random.key(1), filter, observations(), num_islands=8)


def leaves(**runs):
    """Every array of some runs, by the run's name and the leaf's place in it."""
    return {
        f"{name} {k}": np.asarray(leaf)
        for name, run in runs.items()
        for k, leaf in enumerate(jax.tree.leaves(run))
    }


def main(file):
    jax.config.update("jax_enable_x64", True)
    assert len(jax.devices()) == 8
    runs = leaves(replicates=replicates(), islands=islands())
    np.savez(file, **runs)  # pyright: ignore[reportArgumentType]


if __name__ == "__main__":
    main(sys.argv[1])
