"""The jobs of `benchmarks.peers` through each library, in the best way that its pages document.

All do the same: a bootstrap filter with systematic resampling at every step, for all seeds, in
the library's default precision; out come mean and effective sample size of every step, and the
log marginal likelihood. The three in JAX are given keys, are vmapped over them and jitted, and
keep no particles of earlier steps.
"""

# The rivals are installed for this benchmark only.
# pyright: reportMissingImports=false

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from benchmarks.peers.jobs import Job, Quadratic

LIBRARIES = {
    "mpfjax": "mpfjax",
    "particles": "particles, 1 process",
    "particles_2": "particles, 2 processes",
    "blackjax": "blackjax",
    "cuthbert": "cuthbert",
}


class Prepared(NamedTuple):
    """A job that is ready to be timed: `run(make_input(seed))`, of which only `run` counts.

    `run` returns when its result is there: means (seeds, t, ...), effective sample sizes
    (seeds, t) and log marginal likelihoods (seeds,).
    """

    make_input: Callable[[int], Any]
    run: Callable[[Any], tuple[Any, Any, Any]]


def prepare(library: str, job: Job, num_particles: int, num_seeds: int) -> Prepared:
    """The job through one of the `LIBRARIES`."""
    if library.startswith("particles"):
        from benchmarks.peers import through_particles

        num_processes = 2 if library == "particles_2" else 1
        run = through_particles.prepare(job, num_particles, num_seeds, num_processes)
        return Prepared(np.random.seed, lambda _: run())

    import jax

    def make_keys(seed: int) -> Any:
        return jax.block_until_ready(jax.random.split(jax.random.key(seed), num_seeds))

    if library == "mpfjax":
        return Prepared(make_keys, through_mpfjax(job, num_particles))
    one_run = {"blackjax": through_blackjax, "cuthbert": through_cuthbert}[library]
    all_runs = jax.jit(jax.vmap(one_run(job, num_particles)))
    return Prepared(make_keys, lambda keys: jax.block_until_ready(all_runs(keys)))


def through_mpfjax(job: Job, num_particles: int) -> Callable[[Any], tuple[Any, Any, Any]]:
    """`particle_filter` on the library's own model, and `monte_carlo` over the keys."""
    import jax

    import mpfjax

    filter = mpfjax.particle_filter(model_of(job), num_particles)
    observations = jax.numpy.asarray(job.observations)

    def collect(mixture: mpfjax.ParticleMixture) -> tuple[Any, Any]:
        return mixture.mean(), mixture.effective_sample_size

    def run(keys: Any) -> tuple[Any, Any, Any]:
        result = mpfjax.monte_carlo(keys, filter, observations, collect)
        return jax.block_until_ready((*result.collected, result.log_marginal_likelihood))

    return run


def model_of(job: Job) -> Any:
    """The job as a model of mpfjax."""
    import mpfjax

    if isinstance(job, Quadratic):
        return mpfjax.QuadraticModel(
            job.sigma_x, job.sigma_y, job.low, job.high, initial_draw="independent"
        )
    return mpfjax.LinearGaussianModel(
        job.A, job.Q, job.H, job.R, np.zeros(4, np.float32), np.eye(4, dtype=np.float32)
    )


def jax_functions(job: Job) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """(key, shape) -> x_0 and (key, x_{t-1}) -> x_t in plain JAX, in as few operations as can be.

    Each works on one state and on any number of them: leading axes come before the state's own.
    """
    import jax

    if isinstance(job, Quadratic):
        return (
            lambda key, shape: jax.random.uniform(key, shape, minval=job.low, maxval=job.high),
            lambda key, x: x + job.sigma_x * jax.random.normal(key, x.shape),
        )
    A, factor = job.A.T, np.linalg.cholesky(job.Q).T
    return jax.random.normal, lambda key, x: x @ A + jax.random.normal(key, x.shape) @ factor


def through_blackjax(job: Job, num_particles: int) -> Callable[[Any], tuple[Any, Any, Any]]:
    """Of one seed."""
    import jax.numpy as jnp

    initial, transition = jax_functions(job)
    observations = jnp.asarray(job.observations)

    def summary(state: Any, increment: Any) -> tuple[Any, Any, Any]:
        return state.weights @ state.particles, 1 / jnp.sum(state.weights**2), increment

    steps = blackjax_steps(
        lambda key: initial(key, (num_particles, *job.state_shape)),
        lambda key, x, _: transition(key, x), job.log_likelihood, summary,
    )  # fmt: skip

    def run(key: Any) -> tuple[Any, Any, Any]:
        means, sizes, increments = steps(key, observations)
        return means, sizes, jnp.sum(increments)

    return run


def blackjax_steps(
    initial: Callable[[Any], Any],
    transition: Callable[[Any, Any, Any], Any],
    log_likelihood: Callable[[Any, Any], Any],
    summary: Callable[[Any, Any], Any],
) -> Callable[[Any, Any], Any]:
    """`smc.base.step` in a scan, as its docstring says: M_t, G_t and R_t of Feynman-Kac.

    A function of a key and a series: what is `summary` of each step, of the state and the increment
    of log Ẑ. `transition` and `log_likelihood` are given the series' row. blackjax hands
    `update_fn` a key for each particle. One of them draws for all, which is faster.
    """
    import jax
    from blackjax.smc import base, resampling

    def run(key: Any, series: Any) -> Any:
        initial_key, steps_key = jax.random.split(key)

        def advance(state: Any, inputs: tuple[Any, Any]) -> tuple[Any, Any]:
            step_key, now = inputs
            new: Any
            new, info = base.step(
                step_key,
                state,
                update_fn=lambda keys, x, _: (transition(keys[0], x, now), None),
                weight_fn=lambda x: log_likelihood(now, x),
                resample_fn=resampling.systematic,
            )
            return new, summary(new, info.log_likelihood_increment)

        keys = jax.random.split(steps_key, len(jax.tree.leaves(series)[0]))
        return jax.lax.scan(advance, base.init(initial(initial_key), {}), (keys, series))[1]

    return run


def through_cuthbert(job: Job, num_particles: int) -> Callable[[Any], tuple[Any, Any, Any]]:
    """`smc.particle_filter.build_filter`, and its online interface in a scan.

    `cuthbert.filter` is the same scan, but keeps all particles of all steps.
    """
    import jax
    import jax.numpy as jnp
    from cuthbert.smc import particle_filter
    from cuthbertlib.resampling import systematic

    initial, transition = jax_functions(job)
    observations = jnp.asarray(job.observations)
    filter = particle_filter.build_filter(
        init_sample=lambda key: initial(key, job.state_shape),
        propagate_sample=lambda key, state, model_inputs: transition(key, state),
        log_potential=lambda previous, state, model_inputs: job.log_likelihood(model_inputs, state),
        n_filter_particles=num_particles,
        resampling_fn=systematic.resampling,
    )

    def run(key: Any) -> tuple[Any, Any, Any]:
        initial_key, steps_key = jax.random.split(key)
        state = filter.init_prepare(key=initial_key)._replace(model_inputs=observations[0])

        def advance(state: Any, inputs: tuple[Any, Any]) -> tuple[Any, Any]:
            step_key, observation = inputs
            prepared = filter.filter_prepare(observation, key=step_key)
            state = filter.filter_combine(state, prepared)
            weights = jax.nn.softmax(state.log_weights)
            return state, (weights @ state.particles, 1 / jnp.sum(weights**2))

        keys = jax.random.split(steps_key, job.num_steps)
        final, (means, sizes) = jax.lax.scan(advance, state, (keys, observations))
        return means, sizes, final.log_normalizing_constant

    return run
