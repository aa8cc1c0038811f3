"""What is kept of every run, and what is measured of it."""

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import mpfjax
from benchmarks.coverage import REACH
from benchmarks.gm_mpf import sizes
from benchmarks.gm_mpf.filters import NAMES, make_filter, make_model
from benchmarks.gm_mpf.targets import Targets
from mpfjax.mixture import ParticleMixture
from mpfjax.vision.boxes.colour_model import ColourModel
from mpfjax.vision.files import boxes as box_files

LAST_FRAMES, LEAST_SHARE = 10, 0.1


class Step(NamedTuple):
    """What is kept of each frame of a run."""

    estimates: Any  # (2, 2), the centre of the component that stands for each target
    effective_sample_size: Any  # eq. 14, summed over the components
    centres: Any  # (n, 2), of the particles' boxes
    target: Any  # (n,), the reference of each particle


class Collect(eqx.Module):
    """Reduces a mixture to a `Step`: a target's component is the one that its particles started.

    A filter of one component has the same estimate of both targets.
    """

    model: ColourModel

    def __call__(self, mixture: ParticleMixture) -> Step:
        """What is kept of one frame."""
        means = mixture.component_averages(self.model.boxes(mixture.particles))[:, :2]
        owners = mixture.component_averages(mixture.particles.reference.astype(means.dtype))
        swapped = (mixture.num_components == 2) & (owners[0] > owners[-1])
        ends = jnp.stack([means[0], means[-1]])
        return Step(
            jnp.where(swapped, ends[::-1], ends),
            jnp.sum(mixture.component_effective_sample_sizes),
            mixture.particles.box[:, :2],
            mixture.particles.reference,
        )


def errors(estimates: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """The distance in pixels of each estimate (..., t, 2 targets, 2) from its target's centre."""
    return np.linalg.norm(estimates - truth[:, :, :2], axis=-1)


def held(step: Step, truth: np.ndarray) -> np.ndarray:
    """Whether each run keeps both targets: in all of the last frames the particles that stand for
    a target and lie on it are at least `LEAST_SHARE` of its equal share, which is half of all.
    """
    gaps = np.abs(step.centres[:, :, None] - truth[None, :, :, None, :2])
    near = (gaps < np.array(REACH) * truth[None, :, :, None, 2:]).all(axis=-1)
    own = step.target[:, :, None] == np.arange(2)[None, None, :, None]
    shares = 2 * (near & own).mean(axis=-1)
    return (shares[:, -LAST_FRAMES:] >= LEAST_SHARE).all(axis=(1, 2))


def study(
    targets: Targets,
    sizes: list[int],
    num_seeds: int,
    seed: int,
    show: Callable[[], Any],
    names: Iterable[str] = NAMES,
) -> dict[str, dict[int, Step]]:
    """Every filter at every number of particles, `num_seeds` runs of each under one vmap."""
    model = make_model(targets.stills[0], box_files.top_left(targets.truth[0]))
    keys = jax.random.split(jax.random.key(seed), num_seeds)
    stills = jnp.asarray(targets.stills)
    found: dict[str, dict[int, Step]] = {}
    for name in names:
        for size in sizes:
            run = mpfjax.monte_carlo(keys, make_filter(name, model, size), stills, Collect(model))
            found.setdefault(name, {})[size] = jax.tree.map(np.asarray, run.collected)
            show()
    return found


def reference_estimates(targets: Targets, seed: int, names: Iterable[str]) -> dict[str, np.ndarray]:
    """E(x_t | y_1..y_t) as each filter has it with a great many particles, (t, 2 targets, 2).

    The distance from it is what more particles can mend; what is left of the distance from the
    true box is the model's, or the annotation's.
    """
    size, num_runs = sizes.REFERENCE_PARTICLES, sizes.REFERENCE_RUNS
    found = study(targets, [size], num_runs, seed + 1, lambda: None, names)
    return {name: by_size[size].estimates.mean(axis=0) for name, by_size in found.items()}


def summary(step: Step, targets: Targets) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation over seeds of each target's RMSE as section 5 defines it: the
    mean over frames of the distance between the estimate and the target.
    """
    by_seed = errors(step.estimates, targets.truth).mean(axis=1)
    return by_seed.mean(axis=0), by_seed.std(axis=0)


def errors_by_size(by_size: dict[int, Step], truth: np.ndarray) -> dict[int, np.ndarray]:
    """The error of each run and target, (seeds, 2), averaged over frames."""
    return {size: errors(step.estimates, truth).mean(axis=1) for size, step in by_size.items()}
