"""The posterior of a filter's parameters, by particle marginal Metropolis-Hastings."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key, PyTree

from mpfjax.checks import Count, CountOrZero, checked
from mpfjax.running.long_runs import Checkpoint
from mpfjax.tuning.chains import AbstractKernel, PosteriorOfChains, Sampling, Step
from mpfjax.tuning.densities import LogDensity, LogPrior, Point, SamplePrior, checked_prior
from mpfjax.tuning.evidence import UnbiasedFilter, pose_evidence
from mpfjax.tuning.problem import Parameters, Reals, Transforms
from mpfjax.tuning.walks import RandomWalk, checked_deviations, metropolis_step


@dataclass(frozen=True, kw_only=True, repr=False)
class Posterior(PosteriorOfChains):
    """The chains of `metropolis_hastings`, after their burn-in.

    Values that are not finite are counted for a proposal's `log_prior` and
    `log_marginal_likelihood`.
    """

    log_marginal_likelihoods: Float[np.ndarray, "chains draws"]
    """log Ẑ of every draw, summed over sequences."""
    key_data: PyTree = field(default=None, repr=False)
    """of the key with which the filter ran for each log Ẑ."""


@checked
def metropolis_hastings(
    key: Key[Array, ""],
    filter: UnbiasedFilter,
    observations: PyTree,
    num_steps: Count,
    *,
    log_prior: LogPrior,
    proposal_deviations: float | Mapping[str, Any] = 0.1,
    parameters: Parameters = None,
    transforms: Transforms = None,
    num_chains: Count = 1,
    sample_prior: SamplePrior | None = None,
    burn_in: CountOrZero = 0,
    thinning: Count = 1,
    checkpoint: Checkpoint | None = None,
    progress: bool = True,
) -> Posterior:
    """Sample p(θ | y_1..y_t) with the filter's estimate Ẑ(θ) instead of the likelihood.

    Particle marginal Metropolis-Hastings (Andrieu, Doucet and Holenstein 2010, section 2.4.2) on
    pairs (u, key). u is θ in unconstrained coordinates. A Gaussian random walk proposes u, and the
    key is always new. The log density of a pair,

        log p(θ) + log |∂θ/∂u| + log Ẑ(θ; key),

    is a function of the pair, and Ẑ is unbiased. So θ has exactly the posterior distribution, for
    any number of particles. With too few particles, chains remain at one state for a long time. Aim
    at a standard deviation of log Ẑ of about one (Doucet et al. 2015), and an acceptance rate of 10
    to 40%. No derivative is computed, so `gradient` does not matter. Use it if a point and its
    standard errors are not enough: with few observations, or posteriors that are skewed or have
    several modes.

    - `observations`, `parameters`, `transforms`: as for `fit`.
    - `num_steps`: after burn-in, of each chain.
    - `log_prior`: a function of the parameters by name, on their own scale, up to a constant; -inf
      where the prior is zero.
    - `proposal_deviations`: initial standard deviations of the random walk, in unconstrained
      coordinates: one for all, or by name, each a number or of the parameter's unconstrained shape.
      2.4 / sqrt(d) standard errors is a good choice.
    - `num_chains`: 1 by default; they run under one vmap.
    - `sample_prior`: the initial values of the chains: a function of a key that draws one θ, the
      parameters by name on their own scale. R-hat is meaningful only for chains that start further
      apart than the posterior is wide. None starts all at the filter's own parameters. A draw with
      zero likelihood is drawn again.
    - `burn_in`: steps before the others, none of which is stored; 0 by default. In them the random
      walk adapts to the posterior's covariance, estimated from all chains (Haario, Saksman and
      Tamminen 2001). Then it no longer changes, and the chains are Markov chains.
    - `thinning`: k stores every k-th step, for chains that are too long for memory.
    - `checkpoint`: a `Checkpoint`, from whose file the same call continues, also to a larger
      `num_steps`. Everything else must be the same.

    A proposal with a prior or likelihood that is NaN or +inf is rejected, and counted in
    `num_invalid`, with a warning. Ctrl-C returns the draws so far with a warning, if there are any.
    Calls with the same functions, number of chains and shapes share one compiled program, so define
    `log_prior` once.

    Raises `ValueError` for numbers below one, deviations that are not positive or of unknown
    parameters, a filter that is `approximate`, a prior that is not a number, initial values or
    draws of the prior with a zero prior density, a checkpoint of other chains, and as `fit` does;
    `RuntimeError` if the initial values, or a hundred draws of the prior, have zero likelihood.
    """
    problem = pose_evidence(filter, observations, parameters, transforms)
    deviations = checked_deviations(proposal_deviations, problem.start())
    sampling = Sampling(
        "metropolis_hastings", key, problem, deviations, num_steps, num_chains, sample_prior,
        burn_in, thinning, checkpoint, progress,
    )  # fmt: skip
    prior = checked_prior(log_prior, problem, key, sample_prior)
    density = LogDensity(problem, prior)
    data = {"observations": problem.objective}
    (values, accepted, key_data), fields = sampling.run(_Kernel(density), data)
    return Posterior(
        log_marginal_likelihoods=values, accepted=accepted, key_data=key_data, **fields
    )


class _Kernel(AbstractKernel):
    """Random-walk Metropolis-Hastings on pairs of unconstrained numbers and a key.

    It learns no scale: noise in log Ẑ rejects steps of any length.
    """

    density: LogDensity

    def start(self, key: Key[Array, ""], reals: Reals) -> tuple[Point, Bool[Array, ""]]:
        """The pair, and whether its density is positive."""
        point, _ = self.density.evaluated(key, reals)
        return point, point.log_density > -jnp.inf

    def step(self, key: Key[Array, ""], state: Point, walk: RandomWalk) -> Step:
        """A Gaussian step in u with a fresh key, accepted or not."""
        evaluate = self.density.evaluated
        point, accepted, invalid = metropolis_step(key, walk.factor, state, evaluate)
        report = (point.reals, point.log_likelihood, accepted, point.key_data)
        return Step(point, report, accepted.astype(point.log_prior.dtype), invalid)
