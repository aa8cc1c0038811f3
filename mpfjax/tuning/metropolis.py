"""The posterior of a filter's parameters, by particle marginal Metropolis-Hastings."""

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key, PyTree

from mpfjax.checks import check_callable, check_flag, check_key, check_type, check_whole, given
from mpfjax.filter import Filter
from mpfjax.running.storage.checkpoints import check_checkpoint
from mpfjax.running.storage.descriptions import fingerprint
from mpfjax.tuning.chains import (
    AbstractKernel,
    Plan,
    Run,
    Step,
    as_checkpoint,
    chosen,
)
from mpfjax.tuning.densities import LogDensity, LogPrior, check_exact
from mpfjax.tuning.problem import Parameters, Reals, pose_evidence
from mpfjax.tuning.starts import SamplePrior, Starts, constrained
from mpfjax.tuning.transforms import AbstractTransform
from mpfjax.tuning.walks import RandomWalk, accepts, checked_deviations


@dataclass(frozen=True)
class Posterior:
    """The chains of `metropolis_hastings`, after their burn-in."""

    parameters: dict[str, np.ndarray]
    """by name, on their own scale: shape (chains, draws, ...)."""
    log_marginal_likelihoods: Float[np.ndarray, "chains draws"]
    """log Ẑ of every draw, summed over sequences."""
    accepted: Bool[np.ndarray, "chains draws"]
    """which of these steps moved."""
    stopped: str | None = None
    """why they ended before `num_steps`, or None."""
    num_invalid: dict[str, np.ndarray] = field(default_factory=dict)
    """how often in each chain a proposal's `log_prior` or `log_marginal_likelihood` was NaN or
    +inf, in all its steps."""
    proposal_covariance: Float[np.ndarray, "d d"] | None = None
    """of the random walk after burn-in, in unconstrained numbers, in the order of their names."""

    @property
    def acceptance_rate(self) -> float:
        """The share of steps that moved."""
        return float(self.accepted.mean())


def metropolis_hastings(
    key: Key[Array, ""],
    filter: Filter,
    observations: PyTree,
    num_steps: int,
    *,
    log_prior: LogPrior,
    sample_prior: SamplePrior | None = None,
    proposal_deviations: float | Mapping[str, Any] = 0.1,
    burn_in: int = 0,
    adapt: bool = True,
    thinning: int = 1,
    parameters: Parameters = None,
    transforms: Mapping[str, AbstractTransform] | None = None,
    num_chains: int = 1,
    inputs: PyTree = None,
    missing: str = "error",
    checkpoint: str | os.PathLike[str] | None = None,
    checkpoint_every: int = 1000,
    checkpoint_name: str | None = None,
    progress: bool = True,
) -> Posterior:
    """Sample p(θ | y_1..y_t) with the filter's estimate Ẑ(θ) in place of the likelihood.

    Particle marginal Metropolis-Hastings (Andrieu, Doucet and Holenstein 2010, section 2.4.2) on
    pairs (u, key). u is θ in unconstrained numbers. A Gaussian random walk proposes u, and the key
    is always new. The log density of a pair,

        log p(θ) + log |∂θ/∂u| + log Ẑ(θ; key),

    is a function of the pair, and Ẑ is unbiased. So θ has exactly the posterior distribution,
    whatever the number of particles. With too few particles, chains stay at one state for long.
    Aim at a standard deviation of log Ẑ of about one (Doucet et al. 2015), and an acceptance of 10
    to 40%. No derivative is taken, so `gradient` does not matter. Use it where a point and its
    standard errors are not enough: with few observations, or posteriors that are skewed or have
    several modes.

    - `log_prior`: a function of the parameters by name, on their own scale, up to a constant; -inf
      where the prior is zero.
    - `sample_prior`: where the chains start: a function of a key that draws one θ, the parameters
      by name on their own scale. R-hat means something only for chains that start further apart
      than the posterior is wide. None starts all at the filter's own parameters. A draw without
      likelihood is drawn again.
    - `proposal_deviations`: of the random walk at first, in unconstrained numbers: one for all, or
      by name, each a number or of the parameter's unconstrained shape. 2.4 / sqrt(d) standard
      errors is a good start.
    - `num_steps`: after burn-in, of each chain. `num_chains` run under one vmap.
    - `burn_in`: steps before these, of which none is kept. In them the random walk learns the
      posterior's covariance from all chains (Haario, Saksman and Tamminen 2001; with `adapt=False`
      it does not). Then it no longer changes, and the chains are Markov chains.
    - `thinning`: k keeps every k-th step, for chains that are too long for memory.
    - `checkpoint`: a .npz file, without pickles. It is written every `checkpoint_every` steps, and
      when the chains end or are interrupted. If the file exists, the chains go on from it, the same
      to the bit as without the interruption; with a larger `num_steps`, further. All other
      arguments must be the same; functions are compared by their names and by what they hold, or
      by `checkpoint_name`, as in `fit`.
    - `observations`, `parameters`, `transforms`, `inputs`, `missing`: as for `fit`.

    A proposal with a prior or likelihood that is NaN or +inf is rejected, and counted in
    `num_invalid`, with a warning. Ctrl-C returns the draws so far with a warning, if there are any.
    Calls with the same functions, number of chains and shapes share one compiled program, so define
    `log_prior` once.

    Raises `ValueError` for numbers below one, deviations that are not positive or of unknown
    parameters, a filter that is `approximate`, a prior that is no number, a start or a draw of the
    prior without one, a checkpoint of other chains, and what `fit` does; `RuntimeError` where the
    start, or a hundred draws of the prior, have no likelihood.
    """
    check_key(key)
    check_type(Filter, "a filter", filter=filter)
    check_whole(1, num_chains=num_chains)
    plan = Plan(num_steps, burn_in, thinning, adapt)
    check_callable("a function of the parameters by name", log_prior=log_prior)
    check_callable("a function of a key", **given(sample_prior=sample_prior))
    check_flag(progress=progress)
    check_checkpoint(checkpoint, checkpoint_every, checkpoint_name)
    check_exact(filter, "chain")
    problem = pose_evidence(filter, observations, parameters, transforms, missing, inputs)
    deviations = checked_deviations(proposal_deviations, problem.start())
    key_start, key_steps = jax.random.split(key)
    starts = Starts(key_start, problem, num_chains, sample_prior, deviations)
    kernel = _Kernel(LogDensity(problem, starts.checked(log_prior)))
    settings = {"observations": fingerprint(problem.objective), "missing": missing, "key": key}
    settings |= starts.settings | plan.settings
    code = {"log_prior": log_prior, "sample_prior": sample_prior}
    file = as_checkpoint(checkpoint, "metropolis_hastings", checkpoint_name, settings, code)
    run = Run("metropolis_hastings", kernel, starts, key_steps, plan, file)
    outcome = run.sample(checkpoint_every, progress)
    reals, log_marginal_likelihoods, accepted = outcome.draws
    return Posterior(
        parameters=constrained(problem, reals),
        log_marginal_likelihoods=log_marginal_likelihoods,
        accepted=accepted,
        num_invalid=outcome.num_invalid,
        proposal_covariance=outcome.proposal_covariance,
        stopped=outcome.stopped,
    )


class _Point(eqx.Module):
    """The present state of a chain, and the log density there."""

    reals: Reals
    log_prior: Float[Array, "*chains"]
    log_marginal_likelihood: Float[Array, "*chains"]


class _Kernel(AbstractKernel):
    """Random-walk Metropolis-Hastings on pairs of unconstrained numbers and a key."""

    density: LogDensity

    @property
    def learns_scale(self) -> bool:
        """False: noise in log Ẑ rejects steps of any length, whatever the scale."""
        return False

    def start(self, key: Key[Array, ""], reals: Reals) -> tuple[_Point, Bool[Array, ""]]:
        """The pair, and whether its density is positive."""
        found = self.density.evaluated(reals, key)
        point = _Point(reals, found.log_prior, found.log_marginal_likelihood)
        return point, found.log_density > -jnp.inf

    def step(self, key: Key[Array, ""], state: _Point, walk: RandomWalk) -> Step:
        """A Gaussian step in u with a fresh key, accepted or not."""
        key_propose, key_accept = jax.random.split(key)
        key_walk, key_fresh = jax.random.split(key_propose)
        reals = walk.propose(key_walk, state.reals)
        found = self.density.evaluated(reals, key_fresh)
        proposed = _Point(reals, found.log_prior, found.log_marginal_likelihood)
        before = state.log_prior + state.log_marginal_likelihood
        accepted = accepts(key_accept, found.log_density - before)
        state = chosen(accepted, proposed, state)
        report = (state.reals, state.log_marginal_likelihood, accepted)
        return Step(state, report, accepted.astype(before.dtype), found.invalid)
