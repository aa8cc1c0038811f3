"""The posterior of parameters as observations come in, by SMC²."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int, Key, PyTree
from tqdm import tqdm

from mpfjax.checks import (
    check_callable,
    check_flag,
    check_key,
    check_share,
    check_type,
    check_whole,
    shown,
)
from mpfjax.filter import Filter, Start
from mpfjax.mixture import ParticleMixture, single_component
from mpfjax.moves.resampling import Resample
from mpfjax.observations import as_arrays, present_steps
from mpfjax.operations.logarithms import log_sum_exp
from mpfjax.operations.matrices import cholesky
from mpfjax.tuning.chains import BROKEN, Prior, checked_prior, constrained
from mpfjax.tuning.problem import Parameters, Problem, Reals, pose_filter
from mpfjax.tuning.transforms import AbstractTransform


@dataclass(frozen=True)
class SequentialPosterior:
    """The weighted samples of `smc2` after the last observation, and how it came to them."""

    parameters: dict[str, np.ndarray]
    """by name, on their own scale: shape (samples, ...)."""
    log_weights: Float[np.ndarray, " samples"]
    """normalised: their exponentials sum to one."""
    log_likelihood_increments: Float[np.ndarray, " t"]
    """log p(y_s | y_1..y_{s-1}), estimated, over the posterior of the parameters."""
    effective_sample_sizes: Float[np.ndarray, " t"]
    """of the samples after each observation, before any rejuvenation."""
    acceptance_rates: Float[np.ndarray, " t"]
    """of the moves after each observation, NaN where none were needed."""

    @property
    def log_marginal_likelihood(self) -> float:
        """log p(y_1..y_t) of the model with its prior, estimated."""
        return float(self.log_likelihood_increments.sum())

    @property
    def weights(self) -> Float[np.ndarray, " samples"]:
        """Of the samples; they sum to one."""
        return np.exp(self.log_weights)

    def mean(self, name: str) -> np.ndarray:
        """E[θ | y_1..y_t] of one parameter, estimated."""
        return np.asarray(np.einsum("n,n...->...", self.weights, self.parameters[name]))


def smc2(
    key: Key[Array, ""],
    filter: Filter,
    observations: PyTree,
    num_samples: int,
    *,
    sample_prior: Callable[[Key[Array, ""]], dict[str, Array]],
    log_prior: Callable[[dict[str, Array]], Float[Array, ""]],
    ess_threshold: float = 0.5,
    num_moves: int = 5,
    waste_free: bool = True,
    parameters: Parameters = None,
    transforms: Mapping[str, AbstractTransform] | None = None,
    missing: str = "error",
    progress: bool = True,
) -> SequentialPosterior:
    """Sample p(θ | y_1..y_s) for s = 1, ..., t: particles of θ, each with a filter of its own.

    SMC² (Chopin, Jacob and Papaspiliopoulos 2013). All filters take one observation at a time,
    under one vmap, and every θ is weighted by its filter's increment of Ẑ. Where the effective
    sample size of the θs falls below a share of their number, they are resampled together with
    their filters. Then each makes steps of particle marginal Metropolis-Hastings: a Gaussian step
    in unconstrained numbers u, a new filter over all observations so far, accepted by the ratio of
    prior times Ẑ. The covariance of these steps is that of the weighted θs times 2.38² / d. Since Ẑ
    is unbiased, the weighted θs are samples of the posterior as `num_samples` grows, for any number
    of particles in the filters. The evidence of the model, with θ integrated out, comes with it.

    - `num_samples`: how many θs there are. Memory is that of as many filters.
    - `sample_prior`: a function of a key that draws one θ, the parameters by name on their own
      scale. `log_prior`: its density, up to a constant, as for `metropolis_hastings`.
    - `ess_threshold`: the share below which the θs are resampled and moved.
    - `num_moves`: Metropolis steps in each rejuvenation.
    - `waste_free`: resample num_samples / (num_moves + 1) of the θs, and keep all states of their
      chains (Dau and Chopin 2022), which costs less for the same number of samples and is usually
      better. Otherwise all θs are resampled and only the ends of their chains kept.
    - `observations`: one sequence. `parameters`, `transforms`, `missing`: as for `fit`.

    Raises `ValueError` for a filter that is `approximate`, numbers below one, a threshold outside
    [0, 1], `num_samples` that `num_moves` + 1 does not divide where `waste_free`, draws of the
    prior of other names, shapes or domains than the parameters or where its density is not
    finite, a list of sequences, and what `fit` does; `RuntimeError` for a NaN, or where no θ has
    any likelihood. Use it to follow a posterior in time, for posteriors with several modes, and
    to compare models; `metropolis_hastings` is simpler where only the last posterior is wanted.
    """
    check_key(key)
    check_type(Filter, "a filter", filter=filter)
    check_whole(num_samples=num_samples, num_moves=num_moves)
    check_share(ess_threshold=ess_threshold)
    check_flag(waste_free=waste_free, progress=progress)
    check_callable("a function of a key", sample_prior=sample_prior)
    if filter.approximate:
        raise ValueError("filter: an approximate one has no unbiased likelihood, and no exact SMC²")
    if waste_free and num_samples % (num_moves + 1):
        raise ValueError(
            f"num_samples: {num_samples} is no multiple of num_moves + 1, {num_moves + 1}, as"
            " waste_free needs"
        )
    if isinstance(observations, list):
        raise ValueError(
            "observations: a list is several sequences, and this takes one;"
            " jnp.asarray(observations) is one of numbers"
        )
    present = present_steps(observations, missing, filter.model)
    observations = as_arrays(observations)
    length = jax.tree.leaves(observations)[0].shape[0]
    run = _FilterOf(observations, present)
    problem = pose_filter(filter, run, parameters, transforms)
    key_prior, key_filters, key_steps = jax.random.split(key, 3)
    reals = _drawn(key_prior, problem, sample_prior, num_samples)
    first = jax.tree.map(lambda u: u[0], reals)
    prior = checked_prior(log_prior, problem, first, "at a draw of sample_prior")
    sampler = _Sampler(problem, run, prior, int(num_moves), bool(waste_free), int(num_samples))
    samples = _starts(sampler, jax.random.split(key_filters, num_samples), reals)
    increments, sizes, rates = [], [], []
    for t in tqdm(range(length), disable=not progress, unit="step"):
        key_extend, key_move = jax.random.split(jax.random.fold_in(key_steps, t))
        samples, increment, size = _extend(sampler, key_extend, samples, jnp.asarray(t, jnp.int32))
        if not increment < np.inf:
            raise RuntimeError(f"smc2: {BROKEN} at step {t}")
        if increment == -np.inf:
            raise RuntimeError(f"smc2: no sample has any likelihood at step {t}")
        rate = np.nan
        if size < ess_threshold * num_samples:
            so_far = jnp.asarray(t + 1, jnp.int32)
            samples, rate = _rejuvenate(sampler, key_move, samples, so_far)
        increments.append(float(increment))
        sizes.append(float(size))
        rates.append(float(rate))
    return SequentialPosterior(
        parameters=constrained(problem, jax.tree.map(np.asarray, samples.particles.reals)),
        log_weights=np.asarray(samples.log_weights),
        log_likelihood_increments=np.array(increments),
        effective_sample_sizes=np.array(sizes),
        acceptance_rates=np.array(rates),
    )


class _Sample(eqx.Module):
    """A θ with its filter, as far as that has come."""

    reals: Reals
    mixture: ParticleMixture
    log_evidence: Float[Array, "*n"]


class _FilterOf(eqx.Module):
    """Runs of a filter over the first observations, with one compiled program for any number."""

    observations: PyTree
    present: Bool[Array, " t"] | None

    def start(self, key: Key[Array, ""], filter: Filter) -> ParticleMixture:
        return filter._init(Start(key))

    def step(
        self, key: Key[Array, ""], filter: Filter, mixture: ParticleMixture, t: Int[Array, ""]
    ) -> tuple[ParticleMixture, Float[Array, ""]]:
        """The mixture after one more observation, and the increment of log Ẑ."""
        observation = jax.tree.map(lambda leaf: jnp.asarray(leaf)[t], self.observations)
        if self.present is None:
            mixture, info = filter._step(key, mixture, observation)
        else:
            mixture, info = jax.lax.cond(
                self.present[t],
                lambda: filter._step(key, mixture, observation),
                lambda: filter._predict(key, mixture),
            )
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


class _Sampler(eqx.Module):
    """What the samples are of, and how they move."""

    problem: Problem
    run: _FilterOf
    prior: Prior
    num_moves: int = eqx.field(static=True)
    waste_free: bool = eqx.field(static=True)
    num_samples: int = eqx.field(static=True)

    def start(self, key: Key[Array, ""], reals: Reals) -> _Sample:
        """A θ with the mixture of x_0."""
        mixture = self.run.start(key, self.problem.at(reals))
        return _Sample(reals, mixture, jnp.zeros((), mixture.log_weights.dtype))

    def extend(
        self, key: Key[Array, ""], sample: _Sample, t: Int[Array, ""]
    ) -> tuple[_Sample, Float[Array, ""]]:
        """The sample after one more observation, and its increment."""
        filter = self.problem.at(sample.reals)
        mixture, increment = self.run.step(key, filter, sample.mixture, t)
        return _Sample(sample.reals, mixture, sample.log_evidence + increment), increment

    def move(
        self,
        key: Key[Array, ""],
        sample: _Sample,
        factor: Float[Array, "d d"],
        num_steps: Int[Array, ""],
    ) -> tuple[_Sample, Bool[Array, ""]]:
        """One step of particle marginal Metropolis-Hastings, and whether it moved."""
        key_walk, key_filter, key_accept = jax.random.split(key, 3)
        u, unravel = ravel_pytree(sample.reals)
        reals = unravel(u + factor @ jax.random.normal(key_walk, u.shape, u.dtype))
        log_prior = self.prior(reals)
        mixture, log_evidence = self.run(key_filter, self.problem.at(reals), num_steps)
        # Where the prior is zero, the likelihood may not even be defined.
        log_evidence = jnp.where(log_prior == -jnp.inf, -jnp.inf, log_evidence)
        gain = (log_prior + log_evidence) - (self.prior(sample.reals) + sample.log_evidence)
        gain = eqx.error_if(gain, ~(gain < jnp.inf), f"smc2: {BROKEN} in a move")
        accepted = jnp.log(jax.random.uniform(key_accept, (), gain.dtype)) < gain
        proposed = _Sample(reals, mixture, log_evidence)
        return jax.tree.map(
            lambda new, old: jnp.where(accepted, new, old), proposed, sample
        ), accepted


def _drawn(
    key: Key[Array, ""], problem: Problem, sample_prior: Callable[..., Any], num_samples: int
) -> Reals:
    """Draws of the prior in unconstrained numbers, leaves (samples, ...)."""
    start = problem.start()
    keys = jax.random.split(key, num_samples)
    one = sample_prior(keys[0])
    if not isinstance(one, Mapping) or set(one) != set(start):
        names = sorted(one) if isinstance(one, Mapping) else shown(one)
        raise ValueError(f"sample_prior: it gave {names}, no values by the names {sorted(start)}")
    draws, reals = jax.vmap(sample_prior)(keys), {}
    for name, transform in problem.transforms.items():
        present = transform.constrain(start[name])
        values = jnp.asarray(draws[name])
        if values.shape[1:] != present.shape:
            raise ValueError(
                f"sample_prior: {name} of shape {values.shape[1:]}, where the parameter's is"
                f" {present.shape}"
            )
        if not transform.contains(np.asarray(values)):
            kind = type(transform).__name__
            raise ValueError(f"sample_prior: a draw of {name} is outside {kind}'s domain")
        reals[name] = jax.vmap(transform.unconstrain)(values.astype(present.dtype))
    return reals


@eqx.filter_jit
def _starts(sampler: _Sampler, keys: Key[Array, " n"], reals: Reals) -> ParticleMixture:
    """The samples as particles of equal weight, in one component."""
    samples = jax.vmap(sampler.start)(keys, reals)
    return single_component(samples)


@eqx.filter_jit
def _extend(
    sampler: _Sampler, key: Key[Array, ""], samples: ParticleMixture, t: Int[Array, ""]
) -> tuple[ParticleMixture, Float[Array, ""], Float[Array, ""]]:
    """All samples after one more observation, weighted by it; the log of their mean, their ESS."""
    keys = jax.random.split(key, sampler.num_samples)
    extended, increments = jax.vmap(sampler.extend, in_axes=(0, 0, None))(
        keys, samples.particles, t
    )
    log_weights = samples.log_weights + increments
    total = log_sum_exp(log_weights)
    samples = samples.replace(particles=extended, log_weights=log_weights - total)
    return samples, total, samples.effective_sample_size


@eqx.filter_jit
def _rejuvenate(
    sampler: _Sampler, key: Key[Array, ""], samples: ParticleMixture, num_steps: Int[Array, ""]
) -> tuple[ParticleMixture, Float[Array, ""]]:
    """Samples of equal weight, from chains that start at resampled ones, and how many moved."""
    key_resample, key_moves = jax.random.split(key)
    points = jax.vmap(lambda reals: ravel_pytree(reals)[0])(samples.particles.reals)
    centred = points - samples.average(points)[None]
    covariance = samples.average(centred[:, :, None] * centred[:, None, :])
    factor = cholesky(covariance[None])[0] * (2.38 / math.sqrt(points.shape[1]))
    num_chains, num_moves = sampler.num_samples, sampler.num_moves
    if sampler.waste_free:
        num_chains //= num_moves + 1
    resampled = Resample(particles_per_component=num_chains)(key_resample, samples)
    starts = jax.tree.map(lambda leaf: leaf[:num_chains], resampled.particles)

    def chain(key: Key[Array, ""], sample: _Sample) -> tuple[_Sample, _Sample, Array]:
        def advance(sample: _Sample, key: Key[Array, ""]) -> tuple[_Sample, tuple[_Sample, Array]]:
            sample, accepted = sampler.move(key, sample, factor, num_steps)
            return sample, (sample, accepted)

        end, (path, accepted) = jax.lax.scan(advance, sample, jax.random.split(key, num_moves))
        return end, path, accepted

    ends, paths, accepted = jax.vmap(chain)(jax.random.split(key_moves, num_chains), starts)
    if sampler.waste_free:
        ends = jax.tree.map(
            lambda start, path: jnp.concatenate([start, path.reshape(-1, *path.shape[2:])]),
            starts,
            paths,
        )
    rate = jnp.mean(accepted.astype(samples.log_weights.dtype))
    return single_component(ends), rate
