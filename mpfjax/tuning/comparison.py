"""Comparison of models by their evidence, with the error of its estimate."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mpfjax.checks import shown
from mpfjax.running.results import format_table
from mpfjax.tuning.sequential import SequentialPosterior

Runs = SequentialPosterior | Sequence[SequentialPosterior | float] | np.ndarray


@dataclass(frozen=True, repr=False)
class Comparison:
    """The evidence of several models, by name, the most probable model first."""

    log_marginal_likelihoods: dict[str, float]
    """log p(y_1..y_t) of each, estimated."""
    errors: dict[str, float]
    """its standard error."""

    @property
    def differences(self) -> dict[str, float]:
        """The log evidence of the first model minus that of each: the log of their Bayes factor."""
        best = max(self.log_marginal_likelihoods.values())
        return {name: best - value for name, value in self.log_marginal_likelihoods.items()}

    @property
    def difference_errors(self) -> dict[str, float]:
        """The standard errors of the differences."""
        first, *others = self.errors
        best = self.errors[first]
        return {first: 0.0} | {name: float(np.hypot(best, self.errors[name])) for name in others}

    @property
    def probabilities(self) -> dict[str, float]:
        """The posterior probabilities of the models, if all are equally probable a priori."""
        weights = np.exp([-difference for difference in self.differences.values()])
        return dict(zip(self.errors, (weights / weights.sum()).tolist(), strict=True))

    def __repr__(self) -> str:
        lines = [
            [name, f"{value:.2f} ± {self.errors[name]:.2f}",
             f"{self.differences[name]:.2f} ± {self.difference_errors[name]:.2f}",
             f"{self.probabilities[name]:.3f}"]
            for name, value in self.log_marginal_likelihoods.items()
        ]  # fmt: skip
        return format_table(["", "log evidence", "below the first", "probability"], lines)


def compare_evidence(models: Mapping[str, Runs]) -> Comparison:
    """Compare models by their evidence p(y_1..y_t), with the standard error of each difference.

    - `models`: by name, each a posterior of `smc2`, a list of posteriors of independent runs, or
      several estimates of log p(y_1..y_t), such as `monte_carlo(...).log_marginal_likelihood` of a
      model without unknown parameters. All must be of the same observations, with separate keys.

    For several runs the evidence is the mean of their estimates, because each is unbiased, and its
    error follows from their spread; for one posterior the error is `log_marginal_likelihood_error`.
    Differences of independent estimates add their variances. Twice the standard error covers about
    95% if it is below one half; use more samples or more runs until it is.

    Raises `ValueError` for fewer than two models, a single estimate without an error, estimates
    that are not finite, and posteriors of different numbers of observations.
    """
    if not isinstance(models, Mapping) or len(models) < 2:
        raise ValueError(f"models: {shown(models)} are not two models or more, by name")
    lengths, evidence = set(), {}
    for name, runs in models.items():
        runs = [runs] if isinstance(runs, SequentialPosterior) else runs
        posteriors = [run for run in runs if isinstance(run, SequentialPosterior)]
        lengths |= {len(run.log_likelihood_increments) for run in posteriors}
        if len(runs) == len(posteriors) == 1:
            (run,) = posteriors
            evidence[name] = run.log_marginal_likelihood, run.log_marginal_likelihood_error
            if not np.isfinite(evidence[name]).all():
                how = "a larger num_samples, or several runs"
                raise ValueError(f"models: the run of {name} has no standard error; use {how}")
            continue
        evidence[name] = _pool(name, [
            run.log_marginal_likelihood if isinstance(run, SequentialPosterior) else float(run)
            for run in runs
        ])  # fmt: skip
    if len(lengths) > 1:
        raise ValueError(f"models: of {sorted(lengths)} observations, not of the same")
    order = sorted(evidence, key=lambda name: -evidence[name][0])
    values, errors = ({name: evidence[name][k] for name in order} for k in (0, 1))
    return Comparison(values, errors)


def _pool(name: str, estimates: Sequence[float]) -> tuple[float, float]:
    """The logarithm of the mean of unbiased estimates, given by theirs, and its standard error."""
    values = np.asarray(estimates, float)
    if values.ndim != 1 or len(values) < 2 or not np.isfinite(values).all():
        raise ValueError(f"models: {name} has {shown(estimates)}, not two finite estimates or more")
    largest = values.max()
    weights = np.exp(values - largest)
    variance = weights.var(ddof=1) / len(values) / weights.mean() ** 2
    return float(np.log(weights.mean()) + largest), float(np.sqrt(np.log1p(variance)))
