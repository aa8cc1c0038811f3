"""Particles of parameters, each with a filter of its own: the step of `smc2`."""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int, Key

from mpfjax.filter import Filter
from mpfjax.mixture import ParticleMixture, single_component
from mpfjax.moves.resampling.resample import Resample
from mpfjax.observations import Series
from mpfjax.operations.compiling import jit_on_wide_vectors
from mpfjax.operations.logarithms import log_sum_exp
from mpfjax.running.scan import first_mixture, step_or_predict
from mpfjax.tuning.densities import (
    Evaluated,
    Prior,
    chosen,
    evaluated,
    is_invalid,
    number_or_zero,
)
from mpfjax.tuning.problem import Problem, Reals
from mpfjax.tuning.walks import accepts, factor_of


class Sample(eqx.Module):
    """A θ with its filter, up to the present observation."""

    reals: Reals
    mixture: ParticleMixture
    log_evidence: Float[Array, "*n"]


class FilterOf(eqx.Module):
    """Runs of a filter over the first observations, with one compiled program for any number."""

    series: Series
    """those there are, and whatever comes after them up to a length that programs share."""

    def start(self, key: Key[Array, ""], filter: Filter) -> ParticleMixture:
        """The mixture of x_0."""
        return first_mixture(key, filter, self.series)

    def step(
        self, key: Key[Array, ""], filter: Filter, mixture: ParticleMixture, t: Int[Array, ""]
    ) -> tuple[ParticleMixture, Float[Array, ""]]:
        """The mixture after one more observation, and the increment of log Ẑ."""
        now = jax.tree.map(lambda leaf: jnp.asarray(leaf)[t], self.series)
        mixture, info = step_or_predict(filter, key, mixture, now)
        return mixture, info.log_likelihood_increment

    def __call__(
        self, key: Key[Array, ""], filter: Filter, num_steps: Int[Array, ""]
    ) -> tuple[ParticleMixture, Float[Array, ""]]:
        """The mixture after some observations, and log Ẑ."""
        key_start, key_steps = jax.random.split(key)
        mixture = self.start(key_start, filter)

        def advance(t: Int[Array, ""], carry: tuple) -> tuple:
            mixture, log_evidence = carry
            mixture, increment = self.step(jax.random.fold_in(key_steps, t), filter, mixture, t)
            return mixture, log_evidence + increment

        nothing = jnp.zeros((), mixture.log_weights.dtype)
        return jax.lax.fori_loop(0, num_steps, advance, (mixture, nothing))


class Sampler(eqx.Module):
    """The problem that the samples belong to, and their moves."""

    problem: Problem
    run: FilterOf
    prior: Prior
    num_moves: int = eqx.field(static=True)
    num_samples: int = eqx.field(static=True)

    @property
    def num_particles(self) -> int:
        """N of each θ's filter."""
        return self.problem.tree.num_particles

    def with_observations(self, run: FilterOf) -> "Sampler":
        """The same over other observations."""
        return dataclasses.replace(self, run=run)

    def with_particles(self, num_particles: int) -> "Sampler":
        """The same with filters of another number of particles."""
        if num_particles == self.num_particles:
            return self
        resized = self.problem.tree.replace(num_particles=num_particles)
        problem = self.problem.with_structure(jax.tree.structure(resized))
        return dataclasses.replace(self, problem=problem)

    def start(self, key: Key[Array, ""], reals: Reals) -> Sample:
        """A θ with the mixture of x_0."""
        mixture = self.run.start(key, self.problem.at(reals))
        return Sample(reals, mixture, jnp.zeros((), mixture.log_weights.dtype))

    def extend(
        self, key: Key[Array, ""], sample: Sample, t: Int[Array, ""]
    ) -> tuple[Sample, Float[Array, ""]]:
        """The sample after one more observation, and its increment."""
        filter = self.problem.at(sample.reals)
        mixture, increment = self.run.step(key, filter, sample.mixture, t)
        log_evidence = sample.log_evidence + number_or_zero(increment)
        return Sample(sample.reals, mixture, log_evidence), increment

    def run_again(
        self, key: Key[Array, ""], reals: Reals, num_steps: Int[Array, ""]
    ) -> tuple[Sample, Evaluated]:
        """A θ with a new filter over all observations so far."""
        mixture, log_evidence = self.run(key, self.problem.at(reals), num_steps)
        found = evaluated(self.prior(reals), log_evidence)
        return Sample(reals, mixture, found.log_likelihood), found

    def move(
        self,
        key: Key[Array, ""],
        sample: Sample,
        factor: Float[Array, "d d"],
        num_steps: Int[Array, ""],
    ) -> tuple[Sample, Bool[Array, ""], dict[str, Bool[Array, ""]]]:
        """One step of particle marginal Metropolis-Hastings, and whether it moved."""
        key_walk, key_filter, key_accept = jax.random.split(key, 3)
        u, unravel = ravel_pytree(sample.reals)
        noise = jax.random.normal(key_walk, u.shape, u.dtype)
        reals = unravel(u + jnp.matmul(factor, noise, precision="highest"))
        proposed, found = self.run_again(key_filter, reals, num_steps)
        before = number_or_zero(self.prior(sample.reals)) + sample.log_evidence
        accepted = accepts(key_accept, found.log_density - before)
        return chosen(accepted, proposed, sample), accepted, found.invalid


class Extended(NamedTuple):
    """The samples after one more observation."""

    samples: ParticleMixture
    increment: Float[Array, ""]
    """the log of their mean likelihood; -inf where none has any."""
    effective_sample_size: Float[Array, ""]
    invalid: Int[Array, ""]
    """how many θs were dropped, since their likelihood was NaN or +inf."""


class Rejuvenated(NamedTuple):
    """Samples of equal weight."""

    samples: ParticleMixture
    acceptance_rate: Float[Array, ""]
    invalid: dict[str, Int[Array, ""]]


@jit_on_wide_vectors
def started(sampler, keys, reals):
    """The samples as particles of equal weight, in one component."""
    return single_component(jax.vmap(sampler.start)(keys, reals))


@jit_on_wide_vectors
def extended(sampler, key, samples, t):
    """All samples after one more observation, weighted by it.

    A θ whose likelihood is no number gets the weight zero, and keeps it.
    """
    keys = jax.random.split(key, sampler.num_samples)
    particles, increments = jax.vmap(sampler.extend, in_axes=(0, 0, None))(
        keys, samples.particles, t
    )
    alive = samples.log_weights > -jnp.inf
    increments = jnp.where(alive, increments, -jnp.inf)
    log_weights = samples.log_weights + number_or_zero(increments)
    total = log_sum_exp(log_weights)
    samples = samples.replace(particles=particles, log_weights=log_weights - total)
    invalid = jnp.sum(is_invalid(increments), dtype=jnp.int32)
    return Extended(samples, total, samples.effective_sample_size, invalid)


@jit_on_wide_vectors
def rejuvenated(sampler, key, samples, num_steps):
    """Samples of equal weight, from chains that start at resampled ones."""
    key_resample, key_moves = jax.random.split(key)
    points = jax.vmap(lambda reals: ravel_pytree(reals)[0])(samples.particles.reals)
    centred = points - samples.average(points)[None]
    factor = factor_of(samples.average(centred[:, :, None] * centred[:, None, :]))
    num_moves = sampler.num_moves
    num_chains = sampler.num_samples // (num_moves + 1)
    resampled = Resample(particles_per_component=num_chains)(key_resample, samples)
    starts = jax.tree.map(lambda leaf: leaf[:num_chains], resampled.particles)

    def chain(key: Key[Array, ""], sample: Sample) -> tuple[Sample, Any]:
        def advance(sample: Sample, key: Key[Array, ""]) -> tuple[Sample, Any]:
            sample, accepted, invalid = sampler.move(key, sample, factor, num_steps)
            return sample, (sample, accepted, invalid)

        return jax.lax.scan(advance, sample, jax.random.split(key, num_moves))

    _, (paths, accepted, invalid) = jax.vmap(chain)(jax.random.split(key_moves, num_chains), starts)
    everywhere = jax.tree.map(
        lambda start, path: jnp.concatenate([start, path.reshape(-1, *path.shape[2:])]),
        starts,
        paths,
    )
    rate = jnp.mean(accepted.astype(samples.log_weights.dtype))
    counts = jax.tree.map(lambda some: jnp.sum(some, dtype=jnp.int32), invalid)
    return Rejuvenated(single_component(everywhere), rate, counts)


@jit_on_wide_vectors
def exchanged(sampler, key, samples, num_steps):
    """The samples with filters of this sampler's number of particles, weighted by what they change.

    The exchange step by importance sampling of Chopin, Jacob and Papaspiliopoulos (2013, section
    3.6): each θ gets a new filter over all observations so far, and its weight is multiplied by the
    new Ẑ over the old one. Also the log of the mean of these ratios.
    """
    keys = jax.random.split(key, sampler.num_samples)
    particles, found = jax.vmap(sampler.run_again, in_axes=(0, 0, None))(
        keys, samples.particles.reals, num_steps
    )
    ratios = found.log_likelihood - samples.particles.log_evidence
    log_weights = jnp.where(samples.log_weights > -jnp.inf, samples.log_weights + ratios, -jnp.inf)
    total = log_sum_exp(log_weights)
    samples = samples.replace(particles=particles, log_weights=log_weights - total)
    invalid = jnp.sum(found.invalid["log_marginal_likelihood"], dtype=jnp.int32)
    return Extended(samples, total, samples.effective_sample_size, invalid)
