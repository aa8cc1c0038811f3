"""Running a filter over observations: once, or once for each of many keys."""

from collections.abc import Callable
from typing import Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Key, PyTree

from mpfjax.checks import Count, checked
from mpfjax.filter import Filter
from mpfjax.memory import at_start
from mpfjax.mixture import ParticleMixture
from mpfjax.models.series import as_series, series_of
from mpfjax.operations.compiling import is_traced, jit_on_wide_vectors, with_floats_traced
from mpfjax.running.devices import available_devices, num_processors, over_devices, over_threads
from mpfjax.running.diagnosis import sound, warn_of_start
from mpfjax.running.results import FilterRun
from mpfjax.running.scan import first_mixture, initial_keys, scan

# How many particles, with the temporaries of a step, fit into a CPU's caches. Few components
# have a row of particles each, which counts as so many times the particles.
_IN_NEAR_CACHE, _IN_CACHE = 2**15, 2**16
_WORTH_A_THREAD = 2**9  # particles in all runs of the thread


@checked
def run_filter(
    key: Key[Array, ""],
    filter: Filter,
    observations: PyTree,
    collect: Callable[[ParticleMixture], PyTree] | None = None,
    *,
    inputs: PyTree = None,
    missing: Literal["error", "skip"] = "error",
) -> FilterRun:
    """Run a filter over observations y_1..y_t in one scan.

    - `observations`: a pytree whose leaves have a leading axis t; or a `Series`, for which `inputs`
      and `missing` are short.
    - `collect`: a function of the mixture after each step, whose `t` is the step; its results are
      stacked over t. None stores the whole mixture. The same function object compiles once; a new
      lambda in every call compiles again. Methods of a mixture are for a single mixture:
      `jax.vmap(lambda m: m.mean())` maps them over a collected stack.
    - `inputs`: u_1, ..., u_t, known data besides the observations: a pytree of finite numbers whose
      leaves have a leading axis t. At each step the model finds u_t in its field `inputs`; see
      `AbstractStateSpaceModel`. A step without an observation has an input nevertheless.
    - `missing`: "error" raises a `ValueError` that names the first step whose observation has a NaN
      or an infinity. "skip" treats such steps as missing and only predicts. A model with
      `handles_missing = True` receives the NaN; with "skip", only a step with nothing but NaN is
      missing.

    Raises `ValueError` before anything compiles: for an argument of another kind, no observations,
    leaves of different lengths, complex numbers, numbers that JAX's type cannot represent, or
    inputs of a model that has no field for them. Raises `ValueError` during tracing for a model
    whose draws or densities have the wrong shape or type, and RuntimeError if its densities are
    NaN.
    """
    series = as_series(series_of(observations, inputs, missing), filter.model)
    run = with_floats_traced(lambda traced: _run(key, traced, series, collect), filter)
    return warn_of_start(sound(run), filter)


@checked
def monte_carlo(
    keys: Key[Array, " seeds"],
    filter: Filter,
    observations: PyTree,
    collect: Callable[[ParticleMixture], PyTree] | None = None,
    *,
    inputs: PyTree = None,
    missing: Literal["error", "skip"] = "error",
    num_slots: Count | None = None,
) -> FilterRun:
    """Run a filter once for each key, all on the same observations, under `vmap`.

    Every field of the result has a leading axis of seeds. Run k equals `run_filter(keys[k], ...)`,
    whose arguments these are, and whose errors it raises. All devices of the process share the
    runs, and the result is gathered on the first one; under the caller's own jit, grad or vmap one
    device has them. On one CPU device, the runs are shared by a thread for each processor, if there
    is enough to do.

    - `num_slots`: the length of the particle arrays, at least N; the slots after the first N stay
      empty. None is N. Filters that differ only in N compile once if they have the same
      `num_slots`: 1000, for example, for N = 50, 200 and 1000; only the initialisation compiles for
      each N. Each run then takes as long as 1000 particles. A run has the same distribution as one
      without `num_slots`, though not the same particles. `collect` receives the empty slots as
      well, with `occupied` false.

    Raises `ValueError` for fewer slots than particles, and for `num_slots` with the moves that need
    every slot, `PropagateIndependently` and `PropagateInClusters`.
    """
    if num_slots is not None and num_slots < filter.num_particles:
        raise ValueError(f"num_slots: {num_slots} is not at least N, {filter.num_particles}")
    series = as_series(series_of(observations, inputs, missing), filter.model)

    def run(filter: Filter) -> FilterRun:
        starts = (keys, None)
        if num_slots is not None:
            # A program of its own, since draws and moves of x_0 may depend on N.
            starts = (keys, _start_each(keys, filter, series, int(num_slots)))
            filter = filter.replace(num_particles=int(num_slots))
        arguments = (filter, series, collect)
        return over_devices(_run_each, _run_on_threads, starts, arguments, available_devices())

    return warn_of_start(sound(with_floats_traced(run, filter)), filter)


_run = jit_on_wide_vectors(scan)


@jit_on_wide_vectors
def _start_each(keys, filter, series, num_slots):
    """The mixture of x_0 of each run, in this number of slots."""

    def start(key: Key[Array, ""]) -> ParticleMixture:
        mixture = first_mixture(initial_keys(key, filter), filter, series)
        number = jnp.asarray(filter.num_particles, jnp.int32)
        slot = jnp.arange(num_slots, dtype=jnp.int32)
        # Those that stay empty hold one of the particles as well.
        filled = at_start(mixture.at(jnp.minimum(slot, number - 1)))
        log_weights = jnp.where(slot < number, filled.log_weights, -jnp.inf)
        return filled.replace(log_weights=log_weights, ancestor_indices=slot, usable_slots=number)

    return jax.vmap(start)(keys)


def _run_each(starts, filter, series, collect):
    num_runs = starts[0].shape[0]
    size = _group_size(num_runs, filter)

    def run_together(starts: PyTree) -> FilterRun:
        return jax.vmap(lambda key, initial: scan(key, filter, series, collect, initial))(*starts)

    if size == num_runs:
        return run_together(starts)
    in_groups = jax.tree.map(lambda leaf: leaf.reshape(-1, size, *leaf.shape[1:]), starts)
    runs = jax.lax.map(run_together, in_groups)
    return jax.tree.map(lambda leaf: leaf.reshape(num_runs, *leaf.shape[2:]), runs)


def _group_size(num_runs: int, filter: Filter) -> int:
    """How many runs are advanced together: on a CPU, no more than fit into its cache."""
    one_run = filter.num_particles
    if jax.default_backend() != "cpu" or num_runs * one_run <= _IN_CACHE:
        return num_runs
    sizes = [size for size in range(1, num_runs + 1) if num_runs % size == 0]
    return max(size for size in sizes if size == 1 or size * one_run <= _IN_NEAR_CACHE)


_run_all = jit_on_wide_vectors(_run_each)


def _run_on_threads(starts, filter, series, collect):
    """All runs on one device; on a CPU, several threads share them."""
    num_runs = starts[0].shape[0]
    num_worth_it = num_runs * filter.num_particles // _WORTH_A_THREAD
    num_threads = min(num_processors(), num_runs, num_worth_it)
    keeps_all = collect is None  # threads would hold two copies of it for a while
    arguments = (filter, series, collect)
    leave_to_caller = is_traced((starts, arguments)) or jax.default_backend() != "cpu"
    if num_threads < 2 or keeps_all or leave_to_caller:
        return _run_all(starts, *arguments)
    return over_threads(_run_each, starts, arguments, num_threads)
