"""The posterior of a filter's parameters by particle MCMC: Metropolis-Hastings, and Gibbs."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from mpfjax.checks import Count, CountOrZero, checked
from mpfjax.filter import Filter
from mpfjax.models.base import require
from mpfjax.operations.stored import select_rows
from mpfjax.running.long_runs import Checkpoint
from mpfjax.running.scan import scan
from mpfjax.smoothing.conditional import check_conditional, possible_times, renew
from mpfjax.smoothing.trajectories import draw_trajectory
from mpfjax.tuning import densities
from mpfjax.tuning.chains import AbstractKernel, PosteriorOfChains, Sampling, Step
from mpfjax.tuning.evidence import LogJoint, UnbiasedFilter, one_sequence, pose_evidence
from mpfjax.tuning.problem import Parameters, Problem, Reals, Transforms, pose

_NUM_METROPOLIS_STEPS = 5  # for one new trajectory; they cost little


@dataclass(frozen=True, kw_only=True, repr=False)
class Posterior(PosteriorOfChains):
    """The chains of `metropolis_hastings`, after their burn-in."""

    log_marginal_likelihoods: Float[np.ndarray, "chains draws"]
    """log Ẑ of every draw, summed over sequences."""
    key_data: PyTree = field(repr=False)
    """of the key with which the filter ran for each log Ẑ."""


@checked
def metropolis_hastings(
    key: Key[Array, ""],
    filter: UnbiasedFilter,
    observations: PyTree,
    num_steps: Count,
    *,
    log_prior: densities.LogPrior,
    proposal_deviations: float | Mapping[str, Any] = 0.1,
    parameters: Parameters = None,
    transforms: Transforms = None,
    num_chains: Count = 1,
    sample_prior: densities.SamplePrior | None = None,
    burn_in: CountOrZero = 0,
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
    - `checkpoint`: a `Checkpoint`, from whose file the same call continues, also to a larger
      `num_steps`.

    A proposal with a prior or likelihood that is NaN or +inf is rejected, and counted in
    `num_invalid`, with a warning. Ctrl-C returns the draws so far with a warning, if there are any.
    Calls with the same functions, number of chains and shapes share one compiled program, so define
    `log_prior` once.

    Raises `ValueError` for numbers below one, deviations that are not positive or of unknown
    parameters, a filter that is `approximate`, a prior that is not a number, initial values or
    draws of the prior with a zero prior density, and as `fit` does;
    `RuntimeError` if the initial values, or a hundred draws of the prior, have zero likelihood.
    """
    problem = pose_evidence(filter, observations, parameters, transforms)
    deviations = densities.checked_deviations(proposal_deviations, problem.start())
    sampling = Sampling(
        "metropolis_hastings", key, problem, deviations, num_steps, num_chains, sample_prior,
        burn_in, checkpoint, progress,
    )  # fmt: skip
    prior = densities.checked_prior(log_prior, problem, key, sample_prior)
    density = densities.LogDensity(problem, prior)
    (values, key_data), fields = sampling.run(_MetropolisHastings(density))
    return Posterior(log_marginal_likelihoods=values, key_data=key_data, **fields)


class _MetropolisHastings(AbstractKernel):
    """Random-walk Metropolis-Hastings on pairs of unconstrained numbers and a key.

    It learns no scale: noise in log Ẑ rejects steps of any length.
    """

    density: densities.LogDensity

    def start(self, key: Key[Array, ""], reals: Reals) -> densities.Evaluated:
        """The pair, and whether its density is positive."""
        point, _ = self.density.evaluated(key, reals)
        return point, point.log_density > -jnp.inf

    def step(self, key: Key[Array, ""], state: densities.Point, walk: densities.RandomWalk) -> Step:
        """A Gaussian step in u with a fresh key, accepted or not."""
        evaluate = self.density.evaluated
        point, accepted, invalid = densities.metropolis_step(key, walk.factor, state, evaluate)
        report = (point.reals, point.log_likelihood, accepted, point.key_data)
        acceptance = accepted.astype(point.log_prior.dtype)
        return Step(point, report, acceptance, invalid.astype(jnp.int32))


@dataclass(frozen=True, kw_only=True, repr=False)
class GibbsPosterior(PosteriorOfChains):
    """The chains of `particle_gibbs`, after their burn-in."""

    trajectories: PyTree
    """x_0, ..., x_t of every draw, leaves (chains, draws, t + 1, ...)."""
    renewed: Bool[np.ndarray, "chains draws times"]
    """which states of the trajectory changed in these steps."""

    @property
    def renewal_rates(self) -> Float[np.ndarray, " times"]:
        """For each time, the fraction of steps in which the state changed."""
        return self.renewed.mean(axis=(0, 1))


@checked
def particle_gibbs(
    key: Key[Array, ""],
    filter: Filter,
    observations: PyTree,
    num_steps: Count,
    *,
    log_prior: densities.LogPrior,
    proposal_deviations: float | Mapping[str, Any] = 0.1,
    parameters: Parameters = None,
    transforms: Transforms = None,
    num_chains: Count = 1,
    sample_prior: densities.SamplePrior | None = None,
    burn_in: CountOrZero = 0,
    checkpoint: Checkpoint | None = None,
    progress: bool = True,
) -> GibbsPosterior:
    """Sample p(θ, x_0, ..., x_t | y_1..y_t), parameters and trajectory in turn.

    Particle Gibbs (Andrieu, Doucet and Holenstein 2010, section 2.4.3). Given θ, a
    `conditional_filter` renews the trajectory by backward sampling: it leaves p(x | y, θ) invariant
    for every N, also if moves regroup. Given the trajectory, θ is moved by Metropolis steps on

        log p(θ) + log |∂θ/∂u| + log p(x_0 | θ) + Σ_t log D(x_t | x_{t-1}; θ) L(y_t | x_t; θ).

    So the pair has exactly the posterior distribution, for any number of particles. The model needs
    `log_transition` and `log_initial`.

    - `log_prior`: as for `metropolis_hastings`.
    - `proposal_deviations`: of the Metropolis steps' random walk, as for `metropolis_hastings`;
      there are five steps for each new trajectory.
    - `observations`: one sequence, arrays or a `Series`. `parameters`, `transforms`: as for `fit`.
      Parameters are usually the model's; parameters of a proposal have no posterior.
    - `num_chains`, `sample_prior`, `burn_in`, `checkpoint`: as for `metropolis_hastings`. A chain
      starts at a trajectory of its own. During the burn-in the random walk also adapts its scale,
      because the density given a trajectory has no noise: it aims at accepting 44% of the
      Metropolis steps for one coordinate, 23% for several.

    A proposal whose density is NaN or +inf is rejected. If the conditional filter meets such a
    density, the whole step is rejected. `num_invalid` counts both, with a warning. Ctrl-C returns
    the draws so far with a warning, if there are any. Raises `ValueError` for a list of sequences,
    and as `conditional_filter` and `fit` do; `RuntimeError` if the initial values, or a hundred
    draws of the prior, have zero likelihood.

    Use it if long sequences make `metropolis_hastings` reject nearly all proposals. If θ and the
    trajectory determine each other, as with a small noise of the dynamics, steps are short and
    `metropolis_hastings` is better. For draws of θ from p(θ | x, y) itself, alternate them with
    `conditional_filter`.
    """
    check_conditional(filter, "particle_gibbs")
    require(filter.model, "log_initial", "particle_gibbs")
    joint = LogJoint(one_sequence(observations, filter.model))
    problem = pose(filter, joint, parameters, transforms)
    deviations = densities.checked_deviations(proposal_deviations, problem.start())
    sampling = Sampling(
        "particle_gibbs", key, problem, deviations, num_steps, num_chains, sample_prior, burn_in,
        checkpoint, progress,
    )  # fmt: skip
    kernel = _Gibbs(problem, densities.checked_prior(log_prior, problem, key, sample_prior))
    (paths, renewed), fields = sampling.run(kernel)
    return GibbsPosterior(trajectories=paths, renewed=renewed, **fields)


class _Pair(eqx.Module):
    """The present state of a chain."""

    reals: Reals
    trajectory: PyTree


class _Gibbs(AbstractKernel):
    """One step of a chain: the parameters, then the trajectory; the objective is a `LogJoint`.

    It learns the scale: the density given a trajectory has no noise.
    """

    problem: Problem
    prior: densities.Prior

    learns_scale = True

    def start(self, key: Key[Array, ""], reals: Reals) -> tuple[_Pair, Bool[Array, ""]]:
        """A trajectory of an ordinary run, and whether there is one."""
        key_run, key_back = jax.random.split(key)
        filter, series = self.problem.at(reals), self.problem.objective.series
        run = scan(key_run, filter, series, None)
        path = draw_trajectory(key_back, filter.model, run, series.inputs)
        fine = jnp.all(jnp.isfinite(run.log_likelihood_increments))
        fine &= jnp.isfinite(self.prior(reals))
        fine &= jnp.all(possible_times(filter.model, path, series.inputs))
        return _Pair(reals, path), fine

    def step(self, key: Key[Array, ""], state: _Pair, walk: densities.RandomWalk) -> Step:
        """The next pair."""
        key_parameters, key_trajectory = jax.random.split(key)
        reals, accepted, num_invalid = self._metropolis(key_parameters, state, walk)
        filter, series = self.problem.at(reals), self.problem.objective.series
        result = renew(key_trajectory, filter, series, state.trajectory)
        possible = possible_times(filter.model, result.trajectory, series.inputs)
        broken = jnp.any(densities.is_invalid(result.run.log_likelihood_increments))
        broken |= ~jnp.all(result.possible & possible)
        pair = select_rows(~broken, _Pair(reals, result.trajectory), state)

        def changed(new: Array, old: Array) -> Bool[Array, " times"]:
            return jnp.any((new != old).reshape(new.shape[0], -1), axis=1)

        changes = jax.tree.leaves(jax.tree.map(changed, pair.trajectory, state.trajectory))
        report = (pair.reals, pair.trajectory, accepted, jnp.any(jnp.stack(changes), axis=0))
        return Step(pair, report, accepted, num_invalid + broken.astype(jnp.int32))

    def _metropolis(
        self, key: Key[Array, ""], state: _Pair, walk: densities.RandomWalk
    ) -> tuple[Reals, Float[Array, ""], Int[Array, ""]]:
        """Steps of the random walk on the parameters given the trajectory.

        Also the share that is accepted, and how often a density was no number.
        """

        def evaluate(key: Key[Array, ""], reals: Reals) -> densities.Evaluated:
            log_joint = self.problem.objective(state.trajectory, self.problem.at(reals))
            return densities.evaluated(reals, self.prior(reals), log_joint)

        def move(point: densities.Point, key: Key[Array, ""]) -> tuple[densities.Point, Any]:
            point, *report = densities.metropolis_step(key, walk.factor, point, evaluate)
            return point, report

        keys = jax.random.split(key, _NUM_METROPOLIS_STEPS)
        point, (accepted, invalid) = jax.lax.scan(move, evaluate(key, state.reals)[0], keys)
        rate = jnp.mean(accepted.astype(jnp.result_type(float)))
        return point.reals, rate, jnp.sum(invalid, dtype=jnp.int32)
