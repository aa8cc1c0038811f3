"""What is compared: plain filters, AMCL, a peer, the mixture, and the mixture with restarts."""

import importlib.util
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

import mpfjax
from benchmarks.peers.libraries import blackjax_steps
from mpfjax import robots
from mpfjax.models.base import replace_fields

PEER = "blackjax, bootstrap filter"


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


def replace_some(
    key: Key[Array, ""], mixture: mpfjax.ParticleMixture, now: mpfjax.Step
) -> mpfjax.ParticleMixture:
    """One in a hundred particles is drawn from x_0's law."""
    keys, size = jax.random.split(key), mixture.num_particles
    is_new = jax.random.uniform(keys[0], (size, 1)) < 0.01
    drawn = now.model.sample_initial(keys[1], size)
    return mixture.replace(particles=jnp.where(is_new, drawn, mixture.particles))


def mixture(model: Any, num_particles: int, max_components: int) -> mpfjax.Filter:
    """Units are those of x, y, and the cosine and sine of the heading."""
    scale = (1.0, 1.0, 0.5, 0.5)
    return mpfjax.mixture_particle_filter(model, num_particles, max_components, scale=scale)


FILTERS: dict[str, Callable[[Any, int, int], mpfjax.Filter]] = {
    "particle filter": lambda model, n, m: mpfjax.particle_filter(model, n, ess_threshold=0.5),
    "replacing 1%": lambda model, n, m: mpfjax.Filter(
        model, [mpfjax.Resample(), replace_some, mpfjax.Propagate()], n
    ),
    "AMCL": lambda model, n, m: mpfjax.Filter(as_amcl(model), [AdaptiveMonteCarlo()], 5000),
    "mixture": mixture,
    "mixture, with_restarts": lambda model, n, m: mpfjax.with_restarts(mixture(model, n, m)),
    "mixture, with_initialisation": lambda model, n, m: mpfjax.with_initialisation(
        mixture(model, n, m)
    ),
    "the same, with_restarts": lambda model, n, m: mpfjax.with_restarts(
        mpfjax.with_initialisation(mixture(model, n, m))
    ),
    "with_initialisation, equal slots": lambda model, n, m: mpfjax.with_initialisation(
        mpfjax.with_resampling(mixture(model, n, m), mpfjax.Resample(allocation="equal"))
    ),
}
NAMES = [*FILTERS, *([PEER] if importlib.util.find_spec("blackjax") else [])]


class Trace(NamedTuple):
    """What is kept of the steps of runs, (runs, t, ...)."""

    particles: Array
    log_weights: Array
    localised: Array | np.ndarray
    averages: Array | np.ndarray
    """The logarithms of w_slow and w_fast, of AMCL."""


def run(
    name: str, model: Any, size: int, components: int, keys: Array, series: Any, near: float
) -> tuple[Trace, Any, Any]:
    """Traces of runs on (observations, inputs), log Ẑ's increments, and "lost", (runs, t), if any.

    "Lost" is the probability of `robots.lost` for filters with an alarm, and AMCL's own measure,
    1 - w_fast / w_slow.
    """
    if name == PEER:
        particles, logs, increments = _through_blackjax(model, size)(keys, series)
        return Trace(particles, logs, np.empty(0), np.empty(0)), increments, None

    def traced(mixture: mpfjax.ParticleMixture) -> Trace:
        averages = mixture.memory.get("averages", jnp.zeros(2))
        localised = robots.localised(mixture, near)
        return Trace(mixture.particles, mixture.log_weights, localised, averages)

    filter = FILTERS[name](model, size, components)
    runs = mpfjax.monte_carlo(keys, filter, mpfjax.Series(*series), traced)
    trace, lost = runs.collected, None
    if name == "AMCL":
        lost = -np.expm1(np.minimum(trace.averages[..., 1] - trace.averages[..., 0], 0.0))
    elif runs.log_evidence_against_start is not None:
        lost = robots.lost(trace.localised, runs.log_evidence_against_start)
    return trace, runs.log_likelihood_increments, lost


def milliseconds(name: str, model: Any, size: int, components: int, series: Any) -> float | None:
    """Of a scan, in the second of two runs."""
    if name == PEER:
        return None
    filter, data = FILTERS[name](model, size, components), mpfjax.Series(*series)
    seconds = []
    for seed in range(2):
        began = time.perf_counter()
        mpfjax.run_filter(jax.random.key(seed), filter, data).final.particles.block_until_ready()
        seconds.append(time.perf_counter() - began)
    return 1e3 * seconds[-1] / data.length


def _through_blackjax(model: Any, size: int) -> Callable[..., Any]:
    """A row of the series is (observation, inputs)."""
    one = blackjax_steps(
        lambda key: model.sample_initial(key, size),
        lambda key, x, row: model.with_inputs(row[1]).sample_transition(key, x),
        lambda row, x: model.log_likelihood(row[0], x),
        lambda state, increment: (state.particles, jnp.log(state.weights), increment),
    )
    return jax.jit(jax.vmap(one, in_axes=(0, None)))
