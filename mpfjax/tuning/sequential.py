"""The posterior of parameters as observations come in, by SMC²."""

from dataclasses import dataclass, field, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key, PyTree

from mpfjax.checks import Count, checked, kinds
from mpfjax.mixture import ParticleMixture
from mpfjax.models.series import Series
from mpfjax.running.long_runs import Broken, Checkpoint, LongRun, State
from mpfjax.tuning.chains import warn_of_invalid
from mpfjax.tuning.densities import LogPrior, SamplePrior, checked_prior, drawn, require_same_prior
from mpfjax.tuning.evidence import UnbiasedFilter, one_sequence, pose_evidence, with_present
from mpfjax.tuning.parameter_particles import Sampler, extend, rejuvenate, start
from mpfjax.tuning.problem import Parameters, Problem, Transforms
from mpfjax.tuning.summaries import numbers_of, row_of, table

# The share of their number below which the effective sample size of the θs leads to moves.
_ESS_THRESHOLD = 0.5
_FEWEST_FAMILIES = 10


@dataclass(frozen=True, repr=False)
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
    num_invalid: int
    """how often a prior or likelihood was NaN or +inf: of θs that were dropped, and of proposals
    that were rejected."""
    stopped: str | None
    """why it ended before the last observation, or None."""
    _end: "tuple[_Run, State]" = field(compare=False)
    """what `extend` starts from."""

    @property
    def problem(self) -> Problem:
        """What was sampled: the filter and its parameters."""
        return self._end[0].sampler.problem

    @property
    def log_marginal_likelihood(self) -> float:
        """log p(y_1..y_t) of the model with its prior, estimated."""
        return float(self.log_likelihood_increments.sum())

    @property
    def log_marginal_likelihood_error(self) -> float:
        """Its standard error, from this one run; NaN if too few families are left for one.

        Samples that descend from one draw of the prior are a family. From the families' weights S_e
        the relative variance of the evidence is (Lee and Whiteley 2018, equation 8)

            1 - n / (n - 1) (m / (m - 1))^k (1 - Σ_e S_e²),

        for n samples that were resampled k times to m chains; it is converted to an error of the
        logarithm as if the evidence were lognormal. With f families, the error itself has an
        uncertainty of about 1 / sqrt(2 f). If fewer than ten are left, use more samples, or several
        runs in `compare_evidence`.
        """
        run, state = self._end
        shares = np.bincount(state.carry[1], self.weights.astype(float))
        num, num_moves = len(self.weights), run.sampler.num_moves
        num_chains = num // (num_moves + 1)
        if np.count_nonzero(shares) < _FEWEST_FAMILIES:
            return np.nan
        num_resampled = np.isfinite(self.acceptance_rates).sum()
        factor = num / (num - 1) * (num_chains / (num_chains - 1)) ** num_resampled
        variance = 1 - factor * (1 - (shares**2).sum())
        return float(np.sqrt(np.log1p(variance))) if variance > 0 else np.nan

    @property
    def weights(self) -> Float[np.ndarray, " samples"]:
        """The weights of the samples; they sum to one."""
        return np.exp(self.log_weights)

    def mean(self, name: str) -> np.ndarray:
        """E[θ | y_1..y_t] of one parameter, estimated."""
        return np.asarray(np.einsum("n,n...->...", self.weights, self.parameters[name]))

    @property
    def filters(self) -> tuple[Series, ParticleMixture, Float[np.ndarray, " samples"]]:
        """The observations so far, and the mixture and log Ẑ of each sample's filter."""
        run, state = self._end
        points = state.carry[0].particles
        series = jax.tree.map(lambda leaf: leaf[: state.step], run.series)
        return series, points.mixture, np.asarray(points.log_likelihood)

    def resampled(self, rows: PyTree) -> PyTree:
        """The rows of as many samples of equal weight (systematic), as of one chain: (1, n, ...).

        Their order is meaningless: in their original order, copies would look like a chain that
        sticks.
        """
        num, cumulative = len(self.weights), np.cumsum(self.weights, dtype=float)
        quantiles = (np.arange(num) + 0.5) / num * cumulative[-1]
        draws = np.minimum(np.searchsorted(cumulative, quantiles, side="right"), num - 1)
        draws = np.random.default_rng(0).permutation(draws)
        return jax.tree.map(lambda leaf: leaf[draws][None], rows)

    def summary(self) -> dict[str, dict[str, float]]:
        """By parameter, or component of one: mean, standard deviation and quantiles.

        It prints as a table.
        """
        numbers = numbers_of(self.parameters, 1)
        return {name: row_of(draws, self.weights) for name, draws in numbers.items()}

    def __repr__(self) -> str:
        size = 1 / (self.weights.astype(float) ** 2).sum()
        error = self.log_marginal_likelihood_error
        spread = "without a standard error" if np.isnan(error) else f"± {error:.2f}"
        heading = (
            f"{len(self.weights)} samples ({size:.0f} effective) after"
            f" {len(self.log_likelihood_increments)} observations; log evidence"
            f" {self.log_marginal_likelihood:.2f} {spread}"
        )
        return table(heading + (f"; {self.stopped}" if self.stopped else ""), self.summary())

    def extend(self, observations: PyTree, *, progress: bool = True) -> "SequentialPosterior":
        """The posterior after further observations, equal to one run on all observations at once.

        - `observations`: the next ones, arrays or a `Series`, with a leading axis t. For a
          posterior that was stopped, those after its last increment.

        This posterior does not change. Raises `ValueError` for observations of other shapes or
        types, and as `smc2` does. Use it as observations arrive.
        """
        run, state = self._end
        return run.followed_by(state.step, observations, progress).posterior(state)


@checked
def smc2(
    key: Key[Array, ""],
    filter: UnbiasedFilter,
    observations: PyTree,
    num_samples: Count,
    *,
    sample_prior: SamplePrior,
    log_prior: LogPrior,
    num_moves: Count = 5,
    parameters: Parameters = None,
    transforms: Transforms = None,
    checkpoint: Checkpoint | None = None,
    progress: bool = True,
) -> SequentialPosterior:
    """Sample p(θ | y_1..y_s) for s = 1, ..., t: particles of θ, each with its own filter.

    SMC² (Chopin, Jacob and Papaspiliopoulos 2013). All filters process one observation at a time,
    under one vmap, and every θ is weighted by its filter's increment of Ẑ. If the effective sample
    size of the θs falls below half of their number, they are resampled together with their filters.
    Then each makes steps of particle marginal Metropolis-Hastings: a Gaussian step in unconstrained
    coordinates u, a new filter over all observations so far, accepted by the ratio of prior times
    Ẑ. The covariance of these steps is that of the weighted θs times 2.38² / d. Because Ẑ is
    unbiased, the weighted θs are samples of the posterior as `num_samples` grows, for any number of
    particles in the filters. The evidence of the model, with θ integrated out, is estimated too.

    - `num_samples`: the number of θs. Memory is that of as many filters.
    - `sample_prior`: a function of a key that draws one θ, the parameters by name on their own
      scale. `log_prior`: its density, up to a constant, as for `metropolis_hastings`.
    - `num_moves`: Metropolis steps in each rejuvenation. Of the θs, num_samples / (num_moves + 1)
      are resampled, and all states of their chains are retained (waste-free, Dau and Chopin 2022),
      which takes less time for the same number of samples than retaining only the ends of the
      chains.
    - `checkpoint`: a `Checkpoint`, from whose file the samples continue, also to more observations
      than so far. Everything else must be the same.
    - `observations`: one sequence, arrays or a `Series`; `SequentialPosterior.extend` processes
      later ones. `parameters`, `transforms`: as for `fit`.

    A θ whose likelihood is NaN or +inf receives weight zero, a proposal with such a prior or
    likelihood is rejected, and `num_invalid` counts them, with a warning. Ctrl-C, and an
    observation for which every θ has zero likelihood, end it with a warning and the posterior
    before that.

    Raises `ValueError` for a filter that is `approximate`, numbers below one, `num_samples` that
    `num_moves` + 1 does not divide, draws of the prior of other names, shapes or domains than the
    parameters, a `log_prior` that is not their log density up to a constant, a list of sequences,
    and as `fit` does; `RuntimeError` if every θ has zero likelihood at the first observation. Use
    it to follow a posterior in time, for posteriors with several modes, and to compare models;
    `metropolis_hastings` is simpler if only the last posterior is needed.
    """
    size = num_moves + 1
    if num_samples % size:
        low = max(num_samples - num_samples % size, size)
        raise ValueError(
            f"num_samples: {num_samples} is not a multiple of num_moves + 1 = {size}; use {low} or"
            f" {low + size}"
        )
    series = jax.tree.map(np.asarray, one_sequence(observations, filter.model))
    problem = pose_evidence(filter, series, parameters, transforms)
    key_prior, key_filters, key_steps = jax.random.split(key, 3)
    reals = drawn(key_prior, problem, sample_prior, num_samples)
    prior = checked_prior(log_prior, problem, key_prior, sample_prior)
    require_same_prior(jax.random.fold_in(key_prior, 1), problem, prior, sample_prior)
    sampler = Sampler(problem, _pad(series, series.length), prior, int(num_moves))
    sizes = {"num_samples": int(num_samples), "num_moves": int(num_moves)}
    settings = problem.settings | {"key": key} | sizes
    run = _Run(sampler, series, key_steps, checkpoint, progress, settings)
    samples = start(jax.random.split(key_filters, num_samples), sampler, reals)
    rows = np.empty(0), np.empty(0), np.empty(0)
    return run.posterior(State(0, (samples, np.arange(num_samples), 0), rows))


@dataclass(frozen=True)
class _Run:
    """SMC² over some observations.

    It carries the samples, their families and the number of invalid densities. Its rows are the
    increment, the effective sample size and the acceptance rate of each step.
    """

    sampler: Sampler
    series: Series
    """the data of the filters, in arrays of numpy."""
    key: Key[Array, ""]
    checkpoint: Checkpoint | None
    progress: bool
    settings: dict[str, Any]
    """all that has to be the same for a file to fit, beside the observations."""

    def followed_by(self, step: int, observations: PyTree, progress: bool) -> "_Run":
        """The run with the observations that come after a step, and no others."""
        before = jax.tree.map(lambda leaf: leaf[:step], self.series)
        model = self.sampler.problem.tree.model
        after = jax.tree.map(np.asarray, one_sequence(observations, model))
        if (before.present is None) != (after.present is None):
            before, after = with_present(before), with_present(after)
        there, here = map(kinds, jax.tree.map(lambda leaf: leaf[-1], [before, after]))
        if there != here:
            raise ValueError(f"observations: {here} is not like those before, {there}")
        series = jax.tree.map(lambda *leaves: np.concatenate(leaves), before, after)
        capacity = self.sampler.series.length
        # With room for as many more, so that observations that come one by one share a program.
        if series.length > capacity:
            capacity = max(series.length, 2 * capacity)
        sampler = replace(self.sampler, series=_pad(series, capacity))
        return replace(self, sampler=sampler, series=series, progress=progress)

    def posterior(self, start: State) -> SequentialPosterior:
        """The posterior after all observations, from a state on."""

        def settings(step: int) -> dict[str, Any]:
            before = jax.tree.map(lambda leaf: leaf[:step], self.series)
            return self.settings | {"observations": with_present(before)}

        run = LongRun("smc2", self.series.length, self.checkpoint, self.progress, settings)
        state, stopped = run.go(start, self._advance)
        samples, _, num_invalid = state.carry
        warn_of_invalid("smc2", num_invalid - start.carry[-1])
        parameters = self.sampler.problem.constrained_rows(samples.particles.reals)
        return SequentialPosterior(
            parameters, np.asarray(samples.log_weights), *state.rows,
            num_invalid=num_invalid, stopped=stopped, _end=(self, state),
        )  # fmt: skip

    def _advance(self, step: int, last: int, carry: PyTree) -> tuple[int, PyTree, PyTree]:
        """The samples after one more observation."""
        samples, families, num_invalid = carry
        keys = jax.random.split(jax.random.fold_in(self.key, step))
        samples, *numbers = extend(keys[0], self.sampler, samples, jnp.asarray(step, jnp.int32))
        increment, size, num_dropped = map(float, numbers)
        num_invalid, rate = num_invalid + int(num_dropped), np.nan
        if increment == -np.inf:
            broken = f", NaN or +inf in {num_dropped:g}," if num_dropped else ""
            raise Broken(f"no sample has any likelihood{broken}")
        if size < _ESS_THRESHOLD * samples.num_particles:
            so_far = jnp.asarray(step + 1, jnp.int32)
            samples, ancestors, rate, invalid = rejuvenate(keys[1], self.sampler, samples, so_far)
            families, rate = families[np.asarray(ancestors)], float(rate)
            num_invalid += int(invalid)
        row = (np.array([number]) for number in (increment, size, rate))
        return step + 1, (samples, families, num_invalid), tuple(row)


def _pad(series: Series, capacity: int) -> Series:
    """The data in arrays of JAX with room for this many steps."""
    padded = jax.tree.map(lambda leaf: np.resize(leaf, (capacity, *leaf.shape[1:])), series)
    return jax.tree.map(jnp.asarray, padded)
