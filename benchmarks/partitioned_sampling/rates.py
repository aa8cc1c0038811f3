"""The measures of section 3.1 over the runs of a scene, and their means over scenes."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy import stats

from benchmarks.harness import Z_95, wilson
from mpfjax.metrics.tracking_quality import (
    precision,
    recall,
    recovery_rate,
    success_rate,
    track_state,
)

# Recovered is who is tracked in each of the last frames: one alone may be a brush in passing.
NUM_LAST = 3
RATES = ("success", "recovery", "precision", "recall")


class Rates(NamedTuple):
    """What the runs of one filter, or of several, came to, for one or more objects."""

    success: np.ndarray  # (runs, objects), tracked in every frame
    recovered: np.ndarray  # (runs, objects), tracked in the last frames
    precision: np.ndarray  # (runs,), sums over the objects' frames with T = 1
    recall: np.ndarray  # (runs,)
    count: np.ndarray  # (runs,), how many such frames

    def as_dict(self) -> dict[str, Any]:
        """Shares in [0, 1], each with a 95% interval.

        Success and recovery have Wilson's, with as many trials as runs: the objects of one run
        share its particles, and are no trials of their own. Precision and recall, which are
        ratios of sums over runs, have the normal one.
        """
        rates: dict[str, Any] = {}
        intervals: dict[str, Any] = {}
        num_runs = len(self.count)
        for name, outcomes in (("success", self.success), ("recovery", self.recovered)):
            rates[name] = float(outcomes.mean())
            intervals[f"{name}_interval"] = wilson(rates[name], num_runs)
        for name, sums in (("precision", self.precision), ("recall", self.recall)):
            rates[name], intervals[f"{name}_interval"] = ratio(sums, self.count)
        return rates | {"runs": num_runs} | intervals


def measure(estimates: np.ndarray, truth: np.ndarray) -> Rates:
    """The measures of section 3.1 from boxes (runs, t, objects, 4) and (t, objects, 4)."""
    truth = np.asarray(truth, estimates.dtype)
    return Rates(*map(np.asarray, _measure(jnp.asarray(estimates), jnp.asarray(truth))))


@jax.jit
def _measure(estimates, truth) -> tuple:
    present = jnp.all(jnp.isfinite(truth), axis=-1)
    states = track_state(estimates, truth[None])

    def outcomes(states):
        recovery = recovery_rate(states[None], present, num_last=NUM_LAST)
        return success_rate(states[None], present) > 0.5, recovery > 0.5

    success, recovered = jax.vmap(outcomes)(states)
    inside, covered = (
        jnp.sum(share(estimates, truth[None]), axis=(1, 2)) for share in (precision, recall)
    )
    return success, recovered, inside, covered, jnp.sum(states, axis=(1, 2))


def pool(rates: Sequence[Rates]) -> Rates:
    """All runs of several filters."""
    return Rates(*(np.concatenate(parts) for parts in zip(*rates, strict=True)))


def ratio(sums: np.ndarray, counts: np.ndarray) -> tuple[float, list[float]]:
    """Σ s_r / Σ c_r over runs r and its 95% interval; 0, and all of [0, 1], for no counts."""
    num_runs, total = len(counts), counts.sum()
    if total == 0:
        return 0.0, [0.0, 1.0]
    value = float(sums.sum() / total)
    if num_runs == 1:
        return value, [0.0, 1.0]
    spread = ((sums - value * counts) ** 2).sum() * num_runs / (num_runs - 1)
    reach = Z_95 * float(np.sqrt(spread)) / float(total)
    return value, [max(value - reach, 0.0), min(value + reach, 1.0)]


def over_scenes(entries: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The mean of one filter's entries of several scenes, beside their spread.

    Intervals are Student's, over scenes, cut off at 0 and 1; those of a single scene are its own.
    """
    mean: dict[str, Any] = {"scenes": len(entries), "runs": sum(e["runs"] for e in entries)}
    if len(entries) == 1:
        kept = [name + end for name in RATES for end in ("", "_interval")]
        return mean | {name: entries[0][name] for name in kept}
    for name in RATES:
        shares = np.array([entry[name] for entry in entries])
        value, deviation = float(shares.mean()), float(shares.std(ddof=1))
        reach = float(stats.t.ppf(0.975, len(shares) - 1)) * deviation / len(shares) ** 0.5
        mean[name], mean[f"{name}_sd"] = value, deviation
        mean[f"{name}_interval"] = [max(value - reach, 0.0), min(value + reach, 1.0)]
    return mean


def least_and_greatest(
    probabilities: Sequence[float], num_runs: int, num_draws: int
) -> tuple[float, float]:
    """The least and the greatest share expected of several draws that differ by chance alone.

    Each draw adds `num_runs` trials of each probability, one for every scene.
    """
    mass = np.ones(1)
    for probability in probabilities:
        mass = np.convolve(mass, stats.binom.pmf(np.arange(num_runs + 1), num_runs, probability))
    below = np.cumsum(mass).clip(0, 1)
    total = num_runs * len(probabilities)
    # E[K] = Σ_k P(K > k) of a count K.
    least = ((1 - below) ** num_draws).sum()
    greatest = (1 - below**num_draws).sum()
    return float(least / total), float(greatest / total)
