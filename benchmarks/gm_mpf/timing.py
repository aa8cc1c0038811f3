"""How long a frame takes: the filters in turns, and the parts of a step on their own."""

import time
from collections.abc import Callable, Iterable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import mpfjax
from benchmarks.gm_mpf import sizes
from benchmarks.gm_mpf.filters import NAMES, make_filter, make_model, motion
from benchmarks.gm_mpf.targets import Targets
from mpfjax.mixture import ParticleMixture
from mpfjax.vision.colour.histograms import integral_histogram
from mpfjax.vision.files import boxes as box_files


def time_filters(
    targets: Targets, seed: int, names: Iterable[str] = NAMES
) -> dict[str, list[float]]:
    """Milliseconds of each of 50 frames with 1000 particles, the filters in random order."""
    model = make_model(targets.stills[0], box_files.top_left(targets.truth[0]))
    filters = {name: make_filter(name, model, sizes.TIMED_PARTICLES) for name in names}
    stills = [jnp.asarray(still) for still in targets.stills]
    return time_steps(filters, stills, seed)


def time_steps(
    filters: dict[str, mpfjax.Filter], observations: list[Any], seed: int
) -> dict[str, list[float]]:
    """Milliseconds of `TIMED_FRAMES` steps of each filter after a warm-up, in shuffled order."""
    rng = np.random.default_rng(seed)
    key = jax.random.key(seed)
    mixtures = {name: filter.init(key) for name, filter in filters.items()}
    elapsed: dict[str, list[float]] = {name: [] for name in filters}
    for t in range(sizes.WARM_UP + sizes.TIMED_FRAMES):
        observation = observations[t % len(observations)]
        for name in rng.permutation(list(filters)).tolist():
            step_key = jax.block_until_ready(jax.random.fold_in(key, t))
            start = time.perf_counter()
            mixtures[name], _ = jax.block_until_ready(
                filters[name].step(step_key, mixtures[name], observation)
            )
            if t >= sizes.WARM_UP:
                elapsed[name].append(1000 * (time.perf_counter() - start))
    return elapsed


def time_quadratic(
    seed: int, names: Iterable[str] = NAMES, num_steps: int = 200
) -> dict[str, list[float]]:
    """Milliseconds a step where the likelihood costs next to nothing: the cost of the mixture.

    The filters of the literature as they are, with all their regrouping at every step; each of 50
    runs of `num_steps` steps is one scan, so that no time goes into calling it.
    """
    model = mpfjax.QuadraticModel(0.1, 0.1, -2.5, 2.5)
    observations = (2 * jnp.sin(2 * jnp.pi * jnp.arange(1.0, num_steps + 1) / 100)) ** 2
    n = sizes.TIMED_PARTICLES
    grouping = [mpfjax.Merge(), mpfjax.Split(), mpfjax.KMeans()]
    every = {
        "pf": mpfjax.particle_filter(model, n),
        "gpf": mpfjax.gaussian_particle_filter(model, n),
        "mpf": mpfjax.mixture_particle_filter(model, n, 2, regroup=grouping, regroup_every=1),
        "gm_mpf": mpfjax.gaussian_mixture_particle_filter(model, n, 2),
    }
    filters = {name: every[name] for name in names}
    rng = np.random.default_rng(seed)
    elapsed: dict[str, list[float]] = {name: [] for name in filters}
    for repeat in range(1 + sizes.TIMED_FRAMES):
        key = jax.block_until_ready(jax.random.key(repeat))
        for name in rng.permutation(list(filters)).tolist():
            start = time.perf_counter()
            run = mpfjax.run_filter(key, filters[name], observations, _nothing)
            jax.block_until_ready(run.log_marginal_likelihood)
            if repeat > 0:
                elapsed[name].append(1000 * (time.perf_counter() - start) / num_steps)
    return elapsed


def _nothing(mixture: ParticleMixture) -> None:
    """Collect nothing: one function, since a new one at every call would compile anew."""
    del mixture


def profile(targets: Targets, seed: int) -> dict[str, float]:
    """Median milliseconds of each part of a step on its own, with 1000 particles."""
    model = make_model(targets.stills[0], box_files.top_left(targets.truth[0]))
    still = jnp.asarray(targets.stills[0])
    table = integral_histogram(still, model.colours)
    mixture = make_filter("mpf", model, sizes.TIMED_PARTICLES).init(jax.random.key(seed))
    key = jax.random.key(seed + 1)
    redraw = mpfjax.GaussianRegeneration(where=motion)
    parts: dict[str, Callable[[], Any]] = {
        "integral histogram of the frame": eqx.Partial(
            eqx.filter_jit(integral_histogram), still, model.colours
        ),
        "likelihood of all boxes": eqx.Partial(
            eqx.filter_jit(model.log_likelihood), table, mixture.particles
        ),
        "dynamics": eqx.Partial(eqx.filter_jit(model.sample_transition), key, mixture.particles),
        "resampling, two components": eqx.Partial(eqx.filter_jit(mpfjax.Resample()), key, mixture),
        "Gaussian regeneration, two components": eqx.Partial(eqx.filter_jit(redraw), key, mixture),
    }
    elapsed: dict[str, list[float]] = {name: [] for name in parts}
    for repeat in range(sizes.WARM_UP + sizes.TIMED_FRAMES):
        for name, part in parts.items():
            start = time.perf_counter()
            jax.block_until_ready(part())
            if repeat >= sizes.WARM_UP:
                elapsed[name].append(1000 * (time.perf_counter() - start))
    return {name: float(np.median(times)) for name, times in elapsed.items()}
