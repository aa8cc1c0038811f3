"""A Gaussian mixture PHD filter (Vo and Ma 2006), of which the other filter is to be better."""

from collections.abc import Iterator

import numpy as np

from benchmarks.multi_target.scenes import (
    BIRTHS,
    HALF_WIDTH,
    P0,
    SPOTS,
    SURVIVAL,
    A,
    H,
    Q,
    R,
    Scene,
)

_LEAST, _NEAR, _MOST = 1e-5, 4.0, 100  # pruned below, merged within, and at most so many


def followed(scene: Scene, plots: np.ndarray) -> Iterator[tuple[np.ndarray, float]]:
    """The positions of the objects after each scan, and how many to expect.

    Objects that may appear anywhere are born at the plots of the scan before, with the velocity
    unknown, as filters with births from measurements have it.
    """
    mixture = np.zeros(0), np.zeros((0, 4)), np.zeros((0, 4, 4))
    born = SPOTS if scene.known else np.zeros((0, 2))
    for scan in plots:
        z = scan[~np.isnan(scan[:, 0])]
        mixture = _merged(*_updated(scene, *mixture, born, z))
        weights, means, _ = mixture
        yield np.repeat(means @ H.T, np.round(weights).astype(int), axis=0), float(weights.sum())
        born = SPOTS if scene.known else z


Mixture = tuple[np.ndarray, np.ndarray, np.ndarray]  # weights, means and covariances


def _updated(
    scene: Scene, w: np.ndarray, m: np.ndarray, P: np.ndarray, born: np.ndarray, z: np.ndarray
) -> Mixture:
    """The intensity after a scan: table I of the paper."""
    density = scene.clutter / (2 * HALF_WIDTH) ** 2
    rate = np.full(len(born), BIRTHS / max(len(born), 1))
    w = np.concatenate([SURVIVAL * w, rate])
    m = np.concatenate([m @ A.T, born @ H])
    P = np.concatenate([A @ P @ A.T + Q, np.broadcast_to(P0, (len(born), 4, 4))])
    S = H @ P @ H.T + R
    gains = P @ H.T @ np.linalg.inv(S)
    updated = (np.eye(4) - gains @ H) @ P
    gaps = z[:, None] - m @ H.T
    squares = np.einsum("kni,nij,knj->kn", gaps, np.linalg.inv(S), gaps)
    likely = np.exp(-0.5 * squares) / (2 * np.pi * np.sqrt(np.linalg.det(S)))
    shares = scene.p_d * w * likely
    shares /= density + shares.sum(axis=1, keepdims=True)
    moved = m + np.einsum("nij,knj->kni", gains, gaps)
    return (
        np.concatenate([(1 - scene.p_d) * w, shares.ravel()]),
        np.concatenate([m, moved.reshape(-1, 4)]),
        np.concatenate([P, np.tile(updated, (len(z), 1, 1))]),
    )


def _merged(w: np.ndarray, m: np.ndarray, P: np.ndarray) -> Mixture:
    """Fewer components of the same intensity: table II of the paper."""
    chosen = w > _LEAST
    w, m, P = w[chosen], m[chosen], P[chosen]
    parts = []
    while len(w) and len(parts) < _MOST:
        top = w.argmax()
        gaps = m - m[top]
        near = np.einsum("ni,nij,nj->n", gaps, np.linalg.inv(P), gaps) <= _NEAR
        total = w[near].sum()
        mean = w[near] @ m[near] / total
        off = m[near] - mean
        spread = P[near] + off[:, :, None] * off[:, None, :]
        parts.append((total, mean, np.einsum("n,nij->ij", w[near], spread) / total))
        w, m, P = w[~near], m[~near], P[~near]
    if not parts:
        return np.zeros(0), np.zeros((0, 4)), np.zeros((0, 4, 4))
    weights, means, covariances = map(np.array, zip(*parts, strict=True))
    return weights, means, covariances
