"""What is measured: whether a library gives mpfjax's answer, then its times, in turns."""

import argparse
import sys
from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy import stats

from benchmarks.peers.worker import Worker

LEVEL = 1e-5  # of each test: a hundred of them refuse one that is right once in a thousand runs
ROUNDING = 1e-4  # of float32 against float64, relative
MOST_SPREAD = 1.0  # nats; log-likelihoods that spread more are not close enough to normal
SLOW_SECONDS, FEWEST_REPEATS = 20.0, 3


def drop(workers: dict[str, Worker], name: str, reason: str) -> None:
    """Go on without a library that failed; not without mpfjax."""
    workers.pop(name).stop()
    if name == "mpfjax":
        raise ValueError(f"mpfjax: {reason}")
    print(f"{name} failed and is left out from here on: {reason}", file=sys.stderr)


def time_cell(
    workers: dict[str, Worker], num_particles: int, exact: float, options: argparse.Namespace
) -> list[dict[str, Any]]:
    """One entry for each library, at one number of particles.

    The first run of each is checked and counts as its start; then they take turns in random
    order. One that is slow is timed less often.
    """
    request = {"particles": num_particles, "seeds": options.seeds}
    first: dict[str, dict[str, Any]] = {}
    for name in list(workers):
        found = workers[name].run(options.time_limit, **request, seed=0)
        if "error" in found:
            drop(workers, name, found["error"])
        else:
            first[name] = found
    reasons = {name: disagreement(found, first["mpfjax"], exact) for name, found in first.items()}
    for name, reason in reasons.items():
        if reason is not None:
            print(f"N = {num_particles}: {name} is not timed: {reason}", file=sys.stderr)
    elapsed = {name: [] for name, reason in reasons.items() if reason is None}
    memory = {name: found["memory"] for name, found in first.items()}
    order = np.random.default_rng(0)
    for repeat in range(options.repeats):
        for name in order.permutation(list(elapsed)).tolist():
            slow = sum(elapsed[name]) > SLOW_SECONDS and len(elapsed[name]) >= FEWEST_REPEATS
            if slow or name not in workers:
                continue
            found = workers[name].run(options.time_limit, **request, seed=1 + repeat)
            if "error" in found:
                drop(workers, name, found["error"])
                continue
            elapsed[name].append(found["seconds"])
            memory[name] = max(memory[name], found["memory"])
    baseline = np.median(elapsed["mpfjax"]) if elapsed.get("mpfjax") else None
    return [
        summarise(name, first[name], elapsed.get(name, []), memory[name], reasons[name], baseline)
        for name in first
    ]


def disagreement(
    found: Mapping[str, Any], reference: Mapping[str, Any], exact: float
) -> str | None:
    """Why these are not results of the same filter, or None.

    Welch's test of log-likelihoods and of effective sample sizes against the reference's. And, as
    E[Ẑ] = Z, log Ẑ + s²/2 against the exact log Z, where log Ẑ spreads little enough to be close
    to normal.
    """
    for what in ("log_likelihoods", "effective_sample_sizes"):
        ours, others = np.array(found[what]), np.array(reference[what])
        if not np.isfinite(ours).all():
            return f"{what.replace('_', ' ')} that are not finite"
        gap = abs(ours.mean() - others.mean())
        if gap <= ROUNDING * max(1.0, abs(others.mean())):
            continue
        test: Any = stats.ttest_ind(ours, others, equal_var=False)
        if test.pvalue < LEVEL:
            return f"mean {what.replace('_', ' ')} {ours.mean():.6g}, not {others.mean():.6g}"
    estimates = np.array(found["log_likelihoods"])
    number, variance = len(estimates), estimates.var(ddof=1)
    if variance > MOST_SPREAD**2:
        return None
    gap = abs(estimates.mean() + variance / 2 - exact)
    error = np.sqrt(variance / number + variance**2 / (2 * (number - 1)))
    limit = stats.t.isf(LEVEL / 2, number - 1) * error + ROUNDING * max(1.0, abs(exact))
    return f"log-likelihood {estimates.mean():.6g}, exactly {exact:.6g}" if gap > limit else None


def summarise(
    name: str,
    first: Mapping[str, Any],
    seconds: list[float],
    memory: int,
    refused: str | None,
    baseline: float | None,
) -> dict[str, Any]:
    """One entry of the results; times in seconds, memory in bytes above the imports'."""
    median = float(np.median(seconds)) if seconds else None
    return {
        "library": name,
        "refused": refused,
        "seconds": seconds,
        "median": median,
        "ratio": None if median is None or baseline is None else float(median / baseline),
        "start": None if median is None else max(first["seconds"] - median, 0.0),
        # What particles' other processes take is not seen from the first.
        "memory": None if name == "particles_2" else memory,
        "log_likelihood_mean": float(np.mean(first["log_likelihoods"])),
        "log_likelihood_std": float(np.std(first["log_likelihoods"])),
        "effective_sample_size": float(np.mean(first["effective_sample_sizes"])),
    }
