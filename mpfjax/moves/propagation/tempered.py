"""Tempered propagation: the likelihood enters by powers, and particles move in between."""

from typing import Annotated, Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key, PyTree

from mpfjax.checks import Count, InnerShare, entries, to_numbers
from mpfjax.mixture import ParticleMixture
from mpfjax.models.base import require_noise
from mpfjax.models.law import refuse_marginalised
from mpfjax.models.noise import noise_dtype
from mpfjax.moves.base import AbstractPropagation, AbstractWrapper, Step, is_missing
from mpfjax.moves.propagation.propagate import predict
from mpfjax.moves.resampling.resample import Resample
from mpfjax.operations.logarithms import finite_max
from mpfjax.operations.random import normal, split, uniform
from mpfjax.operations.rows import select_rows


class TemperedParticles(NamedTuple):
    """What is resampled between the stages: x_{t-1}, x_t, the noise that made it, and log L."""

    parents: PyTree
    states: PyTree
    noise: Float[Array, "n d"]
    log_likelihoods: Float[Array, " n"]


_RISING = entries(
    lambda powers: (np.diff(np.ravel(powers), prepend=0) > 0).all() and np.ravel(powers)[-1] == 1,
    "exponents that rise from above 0 to 1",
)


class PropagateTempered(AbstractPropagation, AbstractWrapper):
    """Draw x_t ~ D, then weigh it by L^β1, L^(β2-β1), ... up to L, moving particles in between.

    A tempered step, as in a sequential Monte Carlo sampler (Del Moral, Doucet and Jasra 2006), for
    the target D(x_t | x_{t-1}) L(y_t | x_t)^β with β from β_1 to 1. After each stage but the last,
    particles are resampled within components and move: x_t = f(z, x_{t-1}) is drawn again from z' =
    sqrt(1 - s²) z + s ξ, ξ ~ N(0, I), and accepted with the probability min(1, (L' / L)^β). This
    leaves the target invariant for any f, because it leaves the normal distribution of z invariant
    (the preconditioned Crank-Nicolson step of Cotter and others 2013). It needs no density of the
    dynamics. Nothing is tuned on the particles: Ẑ is unbiased, and the move is exact. The best step
    s depends on β. Every particle therefore draws s anew each time, with log s uniform between log
    `least_step` and 0.

    - `resample`: the resampling between the stages.
    - `exponents`: β_1 < β_2 < ... < 1; the last is 1.
    - `num_moves`: moves after each stage but the last.
    - `least_step`: the smallest s.

    A step evaluates the likelihood 1 + `num_moves` (stages - 1) times for each particle. A
    derivative treats the moves that were accepted as given, as with gradient "none" of `Resample`.
    Raises `ValueError` for exponents that do not rise to 1, for a resampling that sorts, since no
    point set follows, and in a filter of a model without `transition_from_noise`. Use it where the
    likelihood is much narrower than the dynamics, and no proposal is known.
    """

    resample: Resample = eqx.field(default_factory=Resample)
    exponents: Annotated[tuple[float, ...], _RISING] = eqx.field(
        converter=to_numbers("exponents"),
        static=True,
        default=(1 / 64, 1 / 16, 1 / 4, 1.0),
        kw_only=True,
    )
    num_moves: Count = eqx.field(static=True, default=1, kw_only=True)
    least_step: InnerShare = eqx.field(static=True, default=0.02, kw_only=True)

    holds = ("resample",)

    def __check_init__(self) -> None:
        super().__check_init__()
        if self.resample.sort_by is not None:
            raise ValueError("resample: sort_by has no use between the stages")

    def check(self, now: Step, num_particles: int, num_components: int) -> None:
        """Raise a `ValueError` for a model that does not make x_t of noise."""
        super().check(now, num_particles, num_components)
        refuse_marginalised(now.model, "PropagateTempered")
        require_noise(now.model, "PropagateTempered")

    def __call__(self, key: Key[Array, ""], mixture: ParticleMixture, now: Step) -> ParticleMixture:
        """Propagate every particle and weigh it by y_t, stage by stage."""
        model: Any = now.model
        if is_missing(now):
            return predict(key, model, mixture, "none")
        key_noise, key_stages = split(key, 2)
        before, parents = mixture, mixture.particles
        noise = normal(
            key_noise, (mixture.num_particles, model.noise_dimension), noise_dtype(parents)
        )
        states = now.law.make(noise, parents)
        log_likelihoods = now.law.log_likelihood(now.observation, states)
        # Resampling may lose a NaN, or a particle whose likelihood is infinite.
        broken = jnp.any(mixture.occupied & ~(log_likelihoods < jnp.inf))
        # Differences between stages would be lost to rounding beside a large common constant.
        common = finite_max(jnp.where(mixture.occupied, log_likelihoods, -jnp.inf))
        log_likelihoods = log_likelihoods - common
        tempered = TemperedParticles(parents, states, noise, log_likelihoods)
        mixture = mixture.replace(particles=tempered).weighed(self.exponents[0] * log_likelihoods)

        def next_stage(
            mixture: ParticleMixture, stage: tuple[Any, Any, Any]
        ) -> tuple[ParticleMixture, None]:
            key, power, later = stage
            key_draw, *keys = split(key, 1 + self.num_moves)
            mixture = self.resample.resample(key_draw, mixture)
            for key_move in keys:
                mixture = self._moved(key_move, mixture, now, power, common)
            log_factors = (later - power) * mixture.particles.log_likelihoods
            return mixture.weighed(log_factors), None

        exponents = jnp.asarray(self.exponents, mixture.log_weights.dtype)
        stages = (jax.random.split(key_stages, len(exponents) - 1), exponents[:-1], exponents[1:])
        mixture, _ = jax.lax.scan(next_stage, mixture, stages)
        mixture = mixture.weighed(common[None])
        log_weights = jnp.where(broken, jnp.nan, mixture.log_weights)
        states = mixture.particles.states
        mixture = mixture.replace(particles=states, log_weights=log_weights)
        return mixture.with_resampled_of(before)

    def _moved(
        self,
        key: Key[Array, ""],
        mixture: ParticleMixture,
        now: Step,
        exponent: Float[Array, ""],
        common: Float[Array, ""],
    ) -> ParticleMixture:
        """Each particle after one Metropolis step in its noise, with the same parent."""
        here = mixture.particles
        key_step, key_noise, key_taken = split(key, 3)
        shape, dtype = (mixture.num_particles, 1), here.noise.dtype
        step = jnp.asarray(self.least_step, dtype) ** uniform(key_step, shape, dtype)
        noise = jnp.sqrt(1 - step**2) * here.noise + step * normal(
            key_noise, here.noise.shape, dtype
        )
        states = now.law.make(noise, here.parents)
        log_likelihoods = now.law.log_likelihood(now.observation, states) - common
        log_ratio = exponent * log_likelihoods - exponent * here.log_likelihoods
        proposed = TemperedParticles(here.parents, states, noise, log_likelihoods)
        return mixture.replace(particles=accepted(key_taken, log_ratio, proposed, here))


def accepted(
    key: Key[Array, ""], log_ratio: Float[Array, " n"], new: PyTree, old: PyTree
) -> PyTree:
    """The new of each particle with the probability min(1, exp log_ratio), else the old.

    A ratio that is NaN is rejected.
    """
    taken = jnp.log(uniform(key, log_ratio.shape, log_ratio.dtype)) < log_ratio
    return select_rows(taken, new, old)
