"""Particles of parameters, each with a filter of its own: the step of `smc2`."""

import dataclasses
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int, Key

from mpfjax.filter import Filter
from mpfjax.mixture import ParticleMixture, single_component
from mpfjax.models.series import Series
from mpfjax.moves.resampling.resample import Resample
from mpfjax.operations.compiling import jit_on_wide_vectors
from mpfjax.operations.logarithms import log_sum_exp
from mpfjax.running.scan import first_mixture, step_or_predict
from mpfjax.tuning import densities
from mpfjax.tuning.problem import Problem, Reals


class Sampler(eqx.Module):
    """The problem that the samples belong to, and their moves; a sample is a θ with its filter."""

    problem: Problem
    # The data there are, and whatever comes after them up to a length that programs share.
    series: Series
    prior: densities.Prior
    num_moves: int = eqx.field(static=True)

    def run_again(
        self, key: Key[Array, ""], reals: Reals, num_steps: Int[Array, ""]
    ) -> densities.Evaluated:
        """A θ with a new filter over all observations so far, and whether a density was no number.

        One compiled program does for any number of them.
        """
        filter = self.problem.at(reals)
        key_start, key_steps = jax.random.split(key)

        def advance(t: Int[Array, ""], carry: tuple) -> tuple:
            mixture, log_evidence = carry
            mixture, increment = self.step(jax.random.fold_in(key_steps, t), filter, mixture, t)
            return mixture, log_evidence + increment

        start = first_mixture(key_start, filter, self.series)
        nothing = jnp.zeros((), start.log_weights.dtype)
        mixture, log_evidence = jax.lax.fori_loop(0, num_steps, advance, (start, nothing))
        point, invalid = densities.evaluated(reals, self.prior(reals), log_evidence)
        return dataclasses.replace(point, mixture=mixture), invalid

    def step(
        self, key: Key[Array, ""], filter: Filter, mixture: ParticleMixture, t: Int[Array, ""]
    ) -> tuple[ParticleMixture, Float[Array, ""]]:
        """The mixture after one more observation, and the increment of log Ẑ."""
        now = jax.tree.map(lambda leaf: jnp.asarray(leaf)[t], self.series)
        mixture, info = step_or_predict(filter, key, mixture, now)
        return mixture, info.log_likelihood_increment


@jit_on_wide_vectors
def start(keys, sampler, reals):
    """Each θ with the mixture of x_0, as particles of equal weight in one component."""

    def one(key: Key[Array, ""], reals: Reals) -> densities.Point:
        mixture = first_mixture(key, sampler.problem.at(reals), sampler.series)
        nothing = jnp.zeros((), mixture.log_weights.dtype)
        log_prior = densities.number_or_zero(sampler.prior(reals))
        return densities.Point(reals, log_prior, nothing, mixture)

    return single_component(jax.vmap(one)(keys, reals))


@jit_on_wide_vectors
def extend(key, sampler, samples, t):
    """All samples after one more observation, weighted by it.

    A θ whose likelihood is no number gets the weight zero, and keeps it. Also the log of the mean
    increment (-inf where all are zero), the effective sample size, and how many were dropped.
    """

    def one(
        key: Key[Array, ""], sample: densities.Point
    ) -> tuple[ParticleMixture, Float[Array, ""]]:
        return sampler.step(key, sampler.problem.at(sample.reals), sample.mixture, t)

    points, alive = samples.particles, samples.log_weights > -jnp.inf
    mixtures, increments = jax.vmap(one)(jax.random.split(key, samples.num_particles), points)
    num_invalid = jnp.sum(alive & densities.is_invalid(increments), dtype=jnp.int32)
    increments = densities.number_or_zero(increments)
    log_likelihood = points.log_likelihood + increments
    points = dataclasses.replace(points, mixture=mixtures, log_likelihood=log_likelihood)
    log_weights = jnp.where(alive, samples.log_weights + increments, -jnp.inf)
    total = log_sum_exp(log_weights)
    samples = samples.replace(particles=points, log_weights=log_weights - total)
    return samples, total, samples.effective_sample_size, num_invalid


@jit_on_wide_vectors
def rejuvenate(key, sampler, samples, num_steps):
    """Samples of equal weight, from chains that start at resampled ones.

    Also from which sample each comes, the share of accepted steps, and how often a density was no
    number.
    """
    key_resample, key_moves = jax.random.split(key)
    points = jax.vmap(lambda reals: ravel_pytree(reals)[0])(samples.particles.reals)
    centred = points - samples.expectation(points)[None]
    factor = densities.factor_of(samples.expectation(centred[:, :, None] * centred[:, None, :]))
    num_moves = sampler.num_moves
    num_chains = samples.num_particles // (num_moves + 1)
    # Multinomial, whose families say how large the error of the evidence is.
    resample = Resample(scheme="multinomial", particles_per_component=num_chains)
    resampled = resample.resample(key_resample, samples)
    starts = jax.tree.map(lambda leaf: leaf[:num_chains], resampled.particles)

    evaluate = partial(sampler.run_again, num_steps=num_steps)

    def chain(key: Key[Array, ""], sample: densities.Point) -> tuple[densities.Point, Any]:
        def advance(sample: densities.Point, key: Key[Array, ""]) -> tuple[densities.Point, Any]:
            moved = densities.metropolis_step(key, factor, sample, evaluate)
            return moved[0], moved

        return jax.lax.scan(advance, sample, jax.random.split(key, num_moves))

    _, (paths, accepted, invalid) = jax.vmap(chain)(jax.random.split(key_moves, num_chains), starts)

    def end_to_end(start: Array, path: Array) -> Array:
        return jnp.concatenate([start, path.reshape(-1, *path.shape[2:])])

    everywhere = jax.tree.map(end_to_end, starts, paths)
    rate = jnp.mean(accepted.astype(samples.log_weights.dtype))
    ancestors = resampled.ancestor_indices[:num_chains]
    ancestors = jnp.concatenate([ancestors, jnp.repeat(ancestors, num_moves)])
    return single_component(everywhere), ancestors, rate, jnp.sum(invalid, dtype=jnp.int32)
