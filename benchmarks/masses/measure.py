"""The errors of masses and of log Ẑ over runs, and the time of a step."""

import time

import jax
import jax.numpy as jnp
import numpy as np

import mpfjax
from benchmarks.masses.scenes import Scene, masses

# Runs of the filter that says what is true where nothing else does.
REFERENCE_RUNS = 8
_REPEATS = 5


def truth(scene: Scene, num_particles: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """The masses, and their standard errors: zero where a grid or symmetry tells them."""
    if scene.exact is not None:
        known = scene.exact[0]
        return known, np.zeros_like(known)
    filter = mpfjax.particle_filter(scene.model, num_particles)
    found = []
    for key in jax.random.split(jax.random.key(seed), REFERENCE_RUNS):
        run = mpfjax.run_filter(key, filter, scene.observations, _nothing)
        found.append((masses(scene, run.final), run.log_marginal_likelihood))
    # Each run counts by its Ẑ: the masses of all particles together.
    logs = np.array([float(log_z) for _, log_z in found])
    weights = np.exp(logs - logs.max())
    weights /= weights.sum()
    rows = np.stack([np.asarray(row) for row, _ in found])
    mean = weights @ rows
    return mean, np.sqrt(np.sum((weights[:, None] * (rows - mean)) ** 2, axis=0))


def errors(
    scene: Scene, filter: mpfjax.Filter, known: np.ndarray, seeds: int, seed: int
) -> dict[str, float]:
    """The RMS error of the masses at the end, and the standard deviation of log Ẑ."""
    keys = jax.random.split(jax.random.key(seed), seeds)
    run = mpfjax.monte_carlo(keys, filter, scene.observations, _nothing)
    found = np.asarray(jax.vmap(lambda mixture: masses(scene, mixture))(run.final))
    return summary(found, np.asarray(run.log_marginal_likelihood), known)


def summary(found: np.ndarray, logs: np.ndarray, known: np.ndarray) -> dict[str, float]:
    """Errors of the masses (runs, regions) and spread of log Ẑ (runs,), with standard errors."""
    squares = np.mean((found - known) ** 2, axis=1)
    rmse, runs = float(np.sqrt(squares.mean())), len(logs)
    return {
        "mass_rmse": rmse,
        "mass_rmse_error": float(squares.std(ddof=1) / np.sqrt(runs) / max(2 * rmse, 1e-12)),
        "largest_mass": float(np.median(found.max(axis=1))),
        "log_z_sd": float(logs.std(ddof=1)),
        "log_z_sd_error": float(logs.std(ddof=1) / np.sqrt(2 * (runs - 1))),
        "log_z_mean": float(logs.mean()),
    }


def milliseconds(scene: Scene, filters: dict[str, mpfjax.Filter], seed: int) -> dict[str, float]:
    """The median time of a step of each filter, one run at a time, in turns."""
    observations = jnp.asarray(scene.observations)
    key = jax.random.key(seed)
    taken: dict[str, list[float]] = {name: [] for name in filters}
    for repeat in range(_REPEATS + 1):
        for name, filter in filters.items():
            start = time.perf_counter()
            run = mpfjax.run_filter(key, filter, observations, _nothing)
            jax.block_until_ready(run.log_marginal_likelihood)
            if repeat > 0:  # the first one compiles
                taken[name].append(time.perf_counter() - start)
    steps = len(scene.observations)
    return {name: 1e3 * float(np.median(times)) / steps for name, times in taken.items()}


def _nothing(mixture: mpfjax.ParticleMixture) -> None:
    del mixture
