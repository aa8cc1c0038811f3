"""The errors of masses and of log Ẑ over runs, and the time of a step."""

import time
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import mpfjax
from benchmarks.masses.scenes import Scene, masses

# Runs of the filter that says what is true where nothing else does.
REFERENCE_RUNS = 8
# A mode with less of the mass is lost.
LOST = 0.01
_REPEATS = 5


class Found(NamedTuple):
    """What the runs of a filter say: the masses of the regions, and log Ẑ."""

    masses: np.ndarray  # (runs, regions)
    log_z: np.ndarray  # (runs,)


class Known(NamedTuple):
    """What is true, and how surely: errors are zero where a grid or symmetry tells it."""

    masses: np.ndarray
    errors: np.ndarray
    log_z: float
    log_z_error: float


def truth(scene: Scene, num_particles: int, seed: int) -> Known:
    """The masses and log Z, by the plain filter of so many particles where nothing else does."""
    exactly, exact_log_z = (None, None) if scene.exact is None else scene.exact
    if exactly is not None and exact_log_z is not None:
        return Known(exactly, np.zeros_like(exactly), exact_log_z, 0.0)
    filter = mpfjax.particle_filter(scene.model, num_particles)
    found = []
    for key in jax.random.split(jax.random.key(seed), REFERENCE_RUNS):
        run = mpfjax.run_filter(key, filter, scene.observations, _nothing)
        found.append((masses(scene, run.final), run.log_marginal_likelihood))
    # Each run counts by its Ẑ: the masses of all particles together.
    logs = np.array([float(log_z) for _, log_z in found])
    weights = np.exp(logs - logs.max())
    log_z = float(logs.max() + np.log(weights.mean()))
    log_z_error = float(weights.std(ddof=1) / weights.mean() / np.sqrt(len(weights)))
    if exactly is not None:
        return Known(exactly, np.zeros_like(exactly), log_z, log_z_error)
    weights /= weights.sum()
    rows = np.stack([np.asarray(row) for row, _ in found])
    mean = weights @ rows
    errors = np.sqrt(np.sum((weights[:, None] * (rows - mean)) ** 2, axis=0))
    return Known(mean, errors, log_z, log_z_error)


def results(scene: Scene, filter: mpfjax.Filter, seeds: int, seed: int) -> Found:
    """Of `seeds` runs of the filter, whose keys are split from that of `seed`."""
    keys = jax.random.split(jax.random.key(seed), seeds)
    run = mpfjax.monte_carlo(keys, filter, scene.observations, _nothing)
    found = jax.vmap(lambda mixture: masses(scene, mixture))(run.final)
    return Found(np.asarray(found), np.asarray(run.log_marginal_likelihood))


def summary(found: Found, known: Known, region: int) -> dict[str, float]:
    """Errors of the masses and of log Ẑ, with standard errors.

    `lost` is the share of runs that leave the true `region` less than a hundredth of the mass.
    """
    squares, log_squares, gone = _losses(found, known, region)
    rmse, runs = float(np.sqrt(squares.mean())), len(gone)
    lost = float(gone.mean())
    log_rmse = float(np.sqrt(log_squares.mean()))
    return {
        "mass_of_truth": float(found.masses[:, region].mean()),
        "lost": lost,
        "lost_error": float(np.sqrt(lost * (1 - lost) / runs)),
        "log_z_rmse": log_rmse,
        "log_z_rmse_error": float(
            log_squares.std(ddof=1) / np.sqrt(runs) / max(2 * log_rmse, 1e-12)
        ),
        "mass_rmse": rmse,
        "mass_rmse_error": float(squares.std(ddof=1) / np.sqrt(runs) / max(2 * rmse, 1e-12)),
        "largest_mass": float(np.median(found.masses.max(axis=1))),
        "log_z_sd": float(found.log_z.std(ddof=1)),
        "log_z_sd_error": float(found.log_z.std(ddof=1) / np.sqrt(2 * (runs - 1))),
        "log_z_mean": float(found.log_z.mean()),
    }


def worse(found: Found, first: Found, known: Known, region: int) -> dict[str, float]:
    """By how many standard errors of the paired differences a filter is worse than the `first`.

    In the mean squared errors of the masses and of log Ẑ, and in the share of runs that lost the
    true `region`. Negative is better.
    """
    names = ("masses_worse", "log_z_worse", "lost_worse")
    losses = zip(_losses(found, known, region), _losses(first, known, region), strict=True)
    return {
        name: _standardised(one - other) for name, (one, other) in zip(names, losses, strict=True)
    }


def _losses(found: Found, known: Known, region: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of each run: squared errors of the masses and of log Ẑ, and whether the mode is lost."""
    return (
        np.mean((found.masses - known.masses) ** 2, axis=1),
        (found.log_z - known.log_z) ** 2,
        (found.masses[:, region] < LOST).astype(float),
    )


def _standardised(differences: np.ndarray) -> float:
    """Their mean in standard errors of it, zero where all are zero."""
    error = differences.std(ddof=1) / np.sqrt(len(differences))
    return float(differences.mean() / error) if error > 0 else 0.0


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
