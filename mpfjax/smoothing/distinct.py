"""How many of the trajectories from backward sampling are distinct at each time."""

import warnings
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, PyTree

# Below this share estimates of the past are poor, whatever the number of trajectories.
SMALL_SHARE = 0.1


def warn_of_few(
    trajectories: PyTree, particles: PyTree, log_weights: Float[Array, "t n"], caller: str
) -> None:
    """A RuntimeWarning where few trajectories are distinct because backward weights degenerate.

    The share at a time is the number of distinct states over the largest possible number: that of
    the trajectories, or of the distinct particles of positive weight where these are fewer. The
    share may be small at a time where few particles fit, although each of these has many pasts. It
    therefore counts only where trajectories that share a state nearly always share the state before
    as well. If there are more trajectories than particles, the first ones are used. States are
    compared by their floating point numbers; for a state without any, and within the caller's own
    jit, there is no warning.
    """
    leaves = jax.tree.leaves((trajectories, particles, log_weights))
    if any(isinstance(leaf, Tracer) or not leaf.is_fully_addressable for leaf in leaves):
        return
    most = log_weights.shape[1]
    drawn = _fingerprints(jax.tree.map(lambda leaf: np.asarray(leaf)[:most], trajectories))
    if drawn is None or drawn.shape[1] < 2:
        return
    before, after = drawn[:, :-1].T, drawn[:, 1:].T
    num_drawn, counts = drawn.shape[0], _num_distinct(before)
    few = np.flatnonzero(counts < SMALL_SHARE * num_drawn)
    if few.size == 0 or _share_of_own_pasts(before, after) > SMALL_SHARE:
        return
    there = _fingerprints(jax.tree.map(lambda leaf: np.asarray(leaf)[few], particles))
    possible = _num_distinct(there, np.asarray(log_weights)[few])
    shares = counts[few] / np.minimum(num_drawn, possible)
    worst = int(np.argmin(shares))
    if shares[worst] < SMALL_SHARE:
        warnings.warn(
            f"{caller}: at index {few[worst]} of the times {counts[few[worst]]} of the"
            f" {num_drawn} trajectories are distinct, a share of {shares[worst]:.2g}. The backward"
            " weights degenerate: log_transition leaves a state next to no particle to have come"
            " from but one. docs/smoothing.md says what to do",
            RuntimeWarning,
            stacklevel=3,
        )


def _share_of_own_pasts(before: np.ndarray, after: np.ndarray) -> float:
    """Of the trajectories that share a state, the share with a distinct past; (t, k) both."""
    num_after = _num_distinct(after)
    both = _num_distinct(before * np.uint64(0x9E3779B97F4A7C15) + after)
    num_sharing = (after.shape[1] - num_after).sum()
    return (both - num_after).sum() / max(num_sharing, 1)


def _fingerprints(states: PyTree) -> Any:
    """A whole number for each state, leaves (n, m, ...), that equal states share; or None."""
    leaves = [leaf for leaf in jax.tree.leaves(states) if jnp.issubdtype(leaf.dtype, jnp.floating)]
    if not leaves:
        return None
    numbers = np.concatenate(
        [np.asarray(leaf, float).reshape(*leaf.shape[:2], -1) for leaf in leaves], axis=2
    )
    # Random weights modulo 2^64 give distinct rows distinct sums, almost surely; -0 equals 0.
    bits = (numbers + 0.0).view(np.uint64)
    weights = np.random.default_rng(0).integers(2**63, size=bits.shape[2], dtype=np.uint64)
    return (bits * (2 * weights + np.uint64(1))).sum(axis=2)


def _num_distinct(fingerprints: np.ndarray, log_weights: np.ndarray | None = None) -> np.ndarray:
    """How many of each row differ, of those with weight."""
    if log_weights is not None:
        likeliest = np.argmax(log_weights, axis=1)[:, None]
        stand_in = np.take_along_axis(fingerprints, likeliest, axis=1)
        fingerprints = np.where(log_weights > -np.inf, fingerprints, stand_in)
    rows = np.sort(fingerprints, axis=1)
    return 1 + np.count_nonzero(rows[:, 1:] != rows[:, :-1], axis=1)
