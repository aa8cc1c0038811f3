"""A study of one small program, for the tests and for the processes that they kill."""

import jax
import numpy as np

import mpfjax

# No array of JAX here: a process that has made one cannot be forked.
OBSERVATIONS = np.array([1.5, 1.0, 0.4], np.float32)


def build(num_particles, noise):
    return mpfjax.particle_filter(mpfjax.QuadraticModel(0.3, noise, -2.0, 2.0), num_particles)


def mean(mixture):
    return mixture.mean()


def measure(run):
    return {"evidence": run.log_marginal_likelihood, "means": run.collected}


def small_study(num_cells=5, **changes):
    """Cells that differ in a number only, so that all of them are one program."""
    arguments = {
        "filters": {"pf": build},
        "num_particles": [8],
        "keys": jax.random.split(jax.random.key(0), 4),
        "observations": OBSERVATIONS,
        "settings": {"noise": np.linspace(0.1, 1.0, num_cells)},
        "measure": measure,
        "collect": mean,
    }
    return mpfjax.Study(**arguments | changes)


def run_in_process(directory, num_cells, compiled):
    """What a process of its own does; `compiled` keeps its programs for those after it."""
    jax.config.update("jax_compilation_cache_dir", str(compiled))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)
    mpfjax.run_study(small_study(num_cells), directory, resume=True)
