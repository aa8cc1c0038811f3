"""The measures of section 3.1 over the runs of a scene, and their means over scenes."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy import stats

from benchmarks.harness import Z_95, wilson
from benchmarks.tracking_quality import (
    precision,
    recall,
    recovery_rate,
    success_rate,
    track_state,
)

# Recovered is who is tracked in each of the last frames: one alone may be a brush in passing.
NUM_LAST = 3
RATES = ("success", "recovery", "precision", "recall")
Outcomes = dict[str, np.ndarray]


def measure(estimates: np.ndarray, truth: np.ndarray) -> Outcomes:
    """What each run came to, from boxes (runs, t, objects, 4) and (t, objects, 4).

    Success and recovery are of each object; precision and recall are sums over the frames in which
    an object is tracked, `count` of them.
    """
    truth = np.asarray(truth, estimates.dtype)
    return jax.tree.map(np.asarray, _measure(jnp.asarray(estimates), jnp.asarray(truth)))


@jax.jit
def _measure(estimates, truth) -> dict:
    present = jnp.all(jnp.isfinite(truth), axis=-1)
    states = track_state(estimates, truth[None])
    one = states[:, None]
    return {
        "success": jax.vmap(lambda run: success_rate(run, present))(one) > 0.5,
        "recovery": jax.vmap(lambda run: recovery_rate(run, present, num_last=NUM_LAST))(one) > 0.5,
        "precision": jnp.sum(precision(estimates, truth[None]), axis=(1, 2)),
        "recall": jnp.sum(recall(estimates, truth[None]), axis=(1, 2)),
        "count": jnp.sum(states, axis=(1, 2)),
    }


def shares_of(*outcomes: Outcomes) -> dict[str, Any]:
    """Shares in [0, 1] over all runs of these filters, each with a 95% interval.

    Success and recovery have Wilson's, with as many trials as runs: the objects of one run share
    its particles, and are no trials of their own. Precision and recall, which are ratios of sums
    over runs, have the normal one.
    """
    joint = {name: np.concatenate([one[name] for one in outcomes]) for name in outcomes[0]}
    counts = joint["count"]
    rates: dict[str, Any] = {"runs": len(counts)}
    for name in ("success", "recovery"):
        rates[name] = float(joint[name].mean())
        rates[f"{name}_interval"] = wilson(rates[name], len(counts))
    for name in ("precision", "recall"):
        total, num = max(float(counts.sum()), 1.0), len(counts)
        value = float(joint[name].sum()) / total
        spread = ((joint[name] - value * counts) ** 2).sum() * num / max(num - 1, 1)
        reach = Z_95 * float(np.sqrt(spread)) / total if num > 1 and counts.any() else 1.0
        rates[name], rates[f"{name}_interval"] = value, _within(value, reach)
    return rates


def over_scenes(entries: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The mean of one filter's entries of several scenes, beside their spread.

    Intervals are Student's, over scenes, cut off at 0 and 1; those of a single scene are its own.
    """
    mean: dict[str, Any] = {"scenes": len(entries), "runs": sum(e["runs"] for e in entries)}
    if len(entries) == 1:
        names = [name + end for name in RATES for end in ("", "_interval")]
        return mean | {name: entries[0][name] for name in names}
    for name in RATES:
        shares = np.array([entry[name] for entry in entries])
        value, deviation = float(shares.mean()), float(shares.std(ddof=1))
        reach = float(stats.t.ppf(0.975, len(shares) - 1)) * deviation / len(shares) ** 0.5
        mean[name], mean[f"{name}_sd"] = value, deviation
        mean[f"{name}_interval"] = _within(value, reach)
    return mean


def _within(value: float, reach: float) -> list[float]:
    return [max(value - reach, 0.0), min(value + reach, 1.0)]


def how_far_apart(shares: np.ndarray, num_runs: int) -> dict[str, float]:
    """The least and the greatest mean of the orders, and whether chance alone may part them.

    `shares` is (scenes, orders). `p` is the probability of totals at least as uneven, if in each
    scene all orders recover alike: a χ² test of the orders' sums over scenes.
    """
    means, of_each = shares.mean(axis=0), shares.mean(axis=1)
    variance, totals = (of_each * (1 - of_each)).sum() / num_runs, shares.sum(axis=0)
    statistic = ((totals - totals.mean()) ** 2).sum() / max(variance, 1e-12)
    return {
        "num_orders": shares.shape[1], "runs": num_runs, "mean": means.mean(),
        "least": means.min(), "greatest": means.max(),
        "p": float(stats.chi2.sf(statistic, shares.shape[1] - 1)),
    }  # fmt: skip
