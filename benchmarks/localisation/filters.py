"""What is compared: the plain filter, AMCL, the mixture, and the mixture with restarts."""

import time
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

import mpfjax
from mpfjax import robots
from mpfjax.models.base import replace_fields


class AdaptiveMonteCarlo(mpfjax.AbstractPropagation):
    """A step of AMCL (Fox 2003; Thrun, Burgard and Fox 2005, table 8.3) as ROS has it.

    Particles are drawn one by one, until the bound on the Kullback-Leibler divergence holds for the
    bins that they occupy. Each is a new draw of x_0 with probability max(0, 1 - w_fast / w_slow),
    from running averages of the likelihood. The settings are those that its documentation advises.
    """

    approximate = True
    keeps_parents = False
    least, error, z = 2000, 0.05, 0.99  # the most is the filter's N
    slow, fast = 0.001, 0.1
    bins = (0.5, 0.5, np.pi / 18)

    def initial_memory(self, now: mpfjax.Step, num_components: int) -> dict[str, Any]:
        """The logarithms of w_slow and w_fast."""
        del now, num_components
        return {"averages": jnp.full(2, -jnp.inf)}

    def __call__(
        self, key: Key[Array, ""], mixture: mpfjax.ParticleMixture, now: mpfjax.Step
    ) -> mpfjax.ParticleMixture:
        """Draw, move, and weigh."""
        keys, most = jax.random.split(key, 5), mixture.num_particles
        slow, fast = mixture.memory["averages"]
        anew = jnp.maximum(0.0, -jnp.expm1(jnp.where(slow > -jnp.inf, fast - slow, 0.0)))
        upto = jnp.cumsum(mixture.weights)
        points = upto[-1] * jax.random.uniform(keys[0], (most,))
        chosen = mixture.particles[jnp.clip(jnp.searchsorted(upto, points), 0, most - 1)]
        is_new = jax.random.uniform(keys[1], (most, 1)) < anew
        drawn = jnp.where(is_new, now.model.sample_initial(keys[2], most), chosen)
        number = self.number(drawn)
        moved = now.model.sample_transition(keys[3], drawn)
        logs = now.model.log_likelihood(now.observation, moved) - jnp.log(number)
        logs = jnp.where(jnp.arange(most) < number, logs, -jnp.inf)
        latest = jax.nn.logsumexp(logs)
        # A step with new draws forgets both averages.
        averages = [
            jnp.where(
                (before > -jnp.inf) & (anew == 0),
                jnp.logaddexp(jnp.log1p(-rate) + before, jnp.log(rate) + latest),
                latest,
            )
            for before, rate in ((slow, self.slow), (fast, self.fast))
        ]
        return mixture.replace(
            particles=moved, log_weights=logs, ancestor_indices=jnp.full(most, -1, jnp.int32),
            memory=mixture.memory | {"averages": jnp.stack(averages)},
        )  # fmt: skip

    def number(self, drawn: Float[Array, "n 3"]) -> Int[Array, ""]:
        """How many are drawn before there are enough for the bins that they occupy."""
        most = len(drawn)
        cells = jnp.floor(drawn / jnp.array([self.bins])).astype(jnp.int32)
        order = jnp.lexsort([cells[:, 0], cells[:, 1], cells[:, 2]])
        ordered = cells[order]
        is_first = jnp.any(ordered != jnp.roll(ordered, 1, axis=0), axis=1).at[0].set(True)
        occupied = jnp.cumsum(jnp.zeros(most, jnp.int32).at[order].set(is_first.astype(jnp.int32)))
        more = jnp.maximum(occupied - 1, 1).astype(jnp.float32)
        ratio = 2 / (9 * more)
        enough = more / (2 * self.error) * (1 - ratio + jnp.sqrt(ratio) * self.z) ** 3
        enough = jnp.where(occupied > 1, jnp.clip(enough, self.least, most), most)
        is_enough = jnp.arange(1.0, most + 1) > enough
        return jnp.where(jnp.any(is_enough), jnp.argmax(is_enough) + 1, most).astype(jnp.int32)


def as_amcl(model: Any) -> Any:
    """The model as AMCL weighs scans: by cubes of its likelihood field, of all beams.

    The ring has no laser, and keeps its likelihood.
    """
    laser = getattr(model, "sensor", None)
    if not isinstance(laser, robots.AbstractLaser):
        return model
    field = robots.LikelihoodField(
        laser.angles, laser_max_range=laser.laser_max_range, z_hit=laser.z_hit,
        z_rand=laser.z_rand, sigma_hit=laser.sigma_hit, weighting="cubes",
    )  # fmt: skip
    return replace_fields(model, sensor=field)


def mixture(model: Any, num_particles: int, max_components: int) -> mpfjax.Filter:
    """Units are those of x, y, and the cosine and sine of the heading."""
    scale = (1.0, 1.0, 0.5, 0.5)
    return mpfjax.mixture_particle_filter(model, num_particles, max_components, scale=scale)


FILTERS: dict[str, Callable[[Any, int, int], mpfjax.Filter]] = {
    "particle filter": lambda model, n, m: mpfjax.particle_filter(model, n, ess_threshold=0.5),
    "AMCL": lambda model, n, m: mpfjax.Filter(as_amcl(model), [AdaptiveMonteCarlo()], 5000),
    "mixture": mixture,
    "mixture, with_restarts": lambda model, n, m: mpfjax.with_restarts(mixture(model, n, m)),
    "mixture, with_initialisation": lambda model, n, m: mpfjax.with_alarm(
        mpfjax.with_initialisation(mixture(model, n, m))
    ),
    "the same, with_restarts": lambda model, n, m: mpfjax.with_restarts(
        mpfjax.with_initialisation(mixture(model, n, m))
    ),
    "with_initialisation, equal slots": lambda model, n, m: mpfjax.with_initialisation(
        mpfjax.with_resampling(mixture(model, n, m), mpfjax.Resample(allocation="equal"))
    ),
}


class Trace(NamedTuple):
    """What is retained of the steps of a run, (t, ...)."""

    particles: Array
    log_weights: Array
    localised: Array
    averages: Array
    """The logarithms of w_slow and w_fast, of AMCL."""


class Runs(NamedTuple):
    """Traces of runs, (runs, t, ...), and what the filters say of themselves."""

    trace: Trace
    increments: np.ndarray
    """of log Ẑ."""
    lost: np.ndarray | None
    """`robots.lost` of a filter with an alarm, and AMCL's own measure, 1 - w_fast / w_slow."""
    milliseconds: np.ndarray
    """of CPU time per scan, of each run."""


def run(
    name: str, model: Any, size: int, components: int, near: float,
    drives: Iterable[tuple[Array, tuple[Any, Any]]],
) -> list[Runs]:  # fmt: skip
    """Runs one after the other on drives: keys, and (observations, inputs)."""
    filter = FILTERS[name](model, size, components)

    def traced(mixture: mpfjax.ParticleMixture) -> Trace:
        averages = mixture.memory.get("averages", jnp.zeros(2))
        localised = robots.localised(mixture, near)
        return Trace(mixture.particles, mixture.log_weights, localised, averages)

    return [_run(filter, traced, keys, mpfjax.Series(*series)) for keys, series in drives]


def _run(filter: mpfjax.Filter, traced: Any, keys: Array, data: mpfjax.Series) -> Runs:
    # Not under `vmap`, where a restart of one run takes the time of a restart of all.
    runs, seconds = [], []
    for key in keys:
        began = time.process_time()
        runs.append(jax.device_get(mpfjax.run_filter(key, filter, data, traced)))
        seconds.append(time.process_time() - began)
    each = jax.tree.map(lambda *leaves: np.stack(leaves), *runs)
    trace, lost = each.collected, None
    if "averages" in runs[0].final.memory:
        lost = -np.expm1(np.minimum(trace.averages[..., 1] - trace.averages[..., 0], 0.0))
    elif each.log_evidence_against_start is not None:
        lost = robots.lost(trace.localised, each.log_evidence_against_start)
    times = 1e3 * np.array(seconds) / data.length
    return Runs(trace, each.log_likelihood_increments, lost, times)
