"""The posterior of parameters as observations come in, by SMC²."""

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import jax
import numpy as np
from jaxtyping import Array, Float, Int, Key, PyTree

from mpfjax.checks import (
    check_callable,
    check_flag,
    check_key,
    check_share,
    check_type,
    check_whole,
    given,
)
from mpfjax.filter import Filter
from mpfjax.running.storage.checkpoints import check_checkpoint, identity_of
from mpfjax.tuning.densities import LogPrior, check_exact, checked_prior
from mpfjax.tuning.parameter_particles import Sampler
from mpfjax.tuning.problem import Parameters, pose_filter
from mpfjax.tuning.smc2_run import Doubling, Observed, SamplesFile, Smc2Run, State
from mpfjax.tuning.starts import SamplePrior, constrained, drawn
from mpfjax.tuning.transforms import AbstractTransform


@dataclass(frozen=True)
class SequentialPosterior:
    """The weighted samples of `smc2` after the last observation, and their history."""

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
    num_particles: Int[np.ndarray, " t"]
    """N of the filters after each observation."""
    num_invalid: dict[str, int]
    """how often `log_prior` or `log_marginal_likelihood` was NaN or +inf: of θs that were dropped,
    and of proposals that were rejected."""
    stopped: str | None = None
    """why it ended before the last observation, or None."""
    _goes_on: tuple[Smc2Run, State] | None = field(default=None, repr=False, compare=False)
    """what `extend` starts from."""

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

    def extend(
        self, observations: PyTree, *, inputs: PyTree = None, progress: bool = True
    ) -> "SequentialPosterior":
        """The posterior after further observations: the one of all observations at once.

        - `observations`: those that come next, with a leading axis t. Of a posterior that was
          stopped, those after its last increment.
        - `inputs`: theirs.

        This posterior stays as it is. Raises `ValueError` for observations of other shapes or
        types, and what `smc2` does. Use it as observations come in.
        """
        check_flag(progress=progress)
        if self._goes_on is None:
            raise ValueError("extend: this posterior has no filters to go on with; smc2 gives them")
        run, state = self._goes_on
        return _posterior(run.with_observations(state.step, observations, inputs), state, progress)


def smc2(
    key: Key[Array, ""],
    filter: Filter,
    observations: PyTree,
    num_samples: int,
    *,
    sample_prior: SamplePrior,
    log_prior: LogPrior,
    ess_threshold: float = 0.5,
    num_moves: int = 5,
    waste_free: bool = True,
    max_particles: int | None = None,
    acceptance_threshold: float = 0.2,
    parameters: Parameters = None,
    transforms: Mapping[str, AbstractTransform] | None = None,
    inputs: PyTree = None,
    missing: str = "error",
    checkpoint: str | os.PathLike[str] | None = None,
    checkpoint_every: int = 10,
    checkpoint_name: str | None = None,
    progress: bool = True,
) -> SequentialPosterior:
    """Sample p(θ | y_1..y_s) for s = 1, ..., t: particles of θ, each with a filter of its own.

    SMC² (Chopin, Jacob and Papaspiliopoulos 2013). All filters take one observation at a time,
    under one vmap, and every θ is weighted by its filter's increment of Ẑ. If the effective sample
    size of the θs falls below a share of their number, they are resampled together with their
    filters. Then each makes steps of particle marginal Metropolis-Hastings: a Gaussian step in
    unconstrained numbers u, a new filter over all observations so far, accepted by the ratio of
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
    - `max_particles`: where given, N is doubled after moves that accept less than
      `acceptance_threshold`, as long as it stays below this: each θ gets a filter of 2N particles,
      and the weight Ẑ_2N / Ẑ_N (section 3.6 there, the exchange step by importance sampling).
      Longer sequences need larger N. Each N compiles its own programs.
    - `checkpoint`: a .npz file, without pickles. It is written every `checkpoint_every`
      observations, and at the end or an interruption. If the file exists, the samples go on from
      it, the same to the bit; also to more observations than those that it has seen.
      `checkpoint_name`: as for `metropolis_hastings`.
    - `observations`: one sequence; `SequentialPosterior.extend` takes those that come later.
      `parameters`, `transforms`, `inputs`, `missing`: as for `fit`.

    A θ whose likelihood is NaN or +inf gets the weight zero, a proposal with such a prior or
    likelihood is rejected, and `num_invalid` counts them, with a warning. Ctrl-C, and an
    observation for which no θ has any likelihood, end it with a warning and the posterior before
    that.

    Raises `ValueError` for a filter that is `approximate`, numbers below one, a threshold outside
    [0, 1], `num_samples` that `num_moves` + 1 does not divide where `waste_free`, draws of the
    prior of other names, shapes or domains than the parameters or where its density is not
    finite, a list of sequences, a checkpoint of other samples, and what `fit` does; `RuntimeError`
    where no θ has any likelihood at the first observation. Use it to follow a posterior in time,
    for posteriors with several modes, and to compare models; `metropolis_hastings` is simpler where
    only the last posterior is wanted.
    """
    check_key(key)
    check_type(Filter, "a filter", filter=filter)
    check_whole(num_samples=num_samples, num_moves=num_moves)
    check_whole(1, **given(max_particles=max_particles))
    check_share(ess_threshold=ess_threshold, acceptance_threshold=acceptance_threshold)
    check_flag(waste_free=waste_free, progress=progress)
    check_callable("a function of a key", sample_prior=sample_prior)
    check_checkpoint(checkpoint, checkpoint_every, checkpoint_name)
    check_exact(filter, "SMC²")
    if waste_free and num_samples % (num_moves + 1):
        raise ValueError(
            f"num_samples: {num_samples} is no multiple of num_moves + 1, {num_moves + 1}, as"
            " waste_free needs"
        )
    observed = Observed.checked(observations, inputs, missing, filter.model)
    run = observed.filter_of(observed.length)
    problem = pose_filter(filter, run, parameters, transforms)
    key_prior, key_filters, key_steps = jax.random.split(key, 3)
    reals = drawn(key_prior, problem, sample_prior, num_samples)
    first = jax.tree.map(lambda u: u[0], reals)
    prior = checked_prior(log_prior, problem, first, "at a draw of sample_prior")
    sampler = Sampler(problem, run, prior, int(num_moves), bool(waste_free), int(num_samples))
    settings = {
        "filter": problem.tree, "parameters": str(problem.tuned), "transforms": problem.transforms,
        "key": key, "missing": missing, "num_samples": int(num_samples),
        "ess_threshold": float(ess_threshold), "num_moves": int(num_moves),
        "waste_free": bool(waste_free), "max_particles": str(max_particles),
        "acceptance_threshold": float(acceptance_threshold),
    }  # fmt: skip
    code = {"log_prior": log_prior, "sample_prior": sample_prior}
    file = None
    if checkpoint is not None:
        identity = identity_of(checkpoint_name, settings, code)
        file = SamplesFile(Path(checkpoint), int(checkpoint_every), identity)
    doubling = Doubling(max_particles, float(acceptance_threshold))
    run = Smc2Run(sampler, observed, key_steps, float(ess_threshold), doubling, file)
    keys = jax.random.split(key_filters, num_samples)
    return _posterior(run, run.loaded(keys, reals) or run.started(keys, reals), progress)


def _posterior(run: Smc2Run, state: State, progress: bool) -> SequentialPosterior:
    """The posterior after all observations, from where the state is."""
    state, stopped = run.go(state, progress)
    reals = jax.tree.map(np.asarray, state.samples.particles.reals)
    return SequentialPosterior(
        parameters=constrained(run.sampler.problem, reals),
        log_weights=np.asarray(state.samples.log_weights),
        log_likelihood_increments=state.rows.increments,
        effective_sample_sizes=state.rows.sizes,
        acceptance_rates=state.rows.rates,
        num_particles=state.rows.num_particles,
        num_invalid=state.num_invalid,
        stopped=stopped,
        _goes_on=(run, state),
    )
