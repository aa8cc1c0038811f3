"""A Gaussian mixture PHD filter (Vo and Ma 2006), extended where motion or sensor is not linear."""

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from benchmarks.multi_target.scenes import PLACE, SURVIVAL, Scene, Sensor, moved

_LEAST, _NEAR, _MOST = 1e-5, 4.0, 100  # pruned below, merged within, and at most so many
Mixture = tuple[np.ndarray, np.ndarray, np.ndarray]  # weights, means and covariances


def followed(scene: Scene, scans: tuple[np.ndarray, ...]) -> Iterator[tuple[np.ndarray, float]]:
    """The positions of the objects after each scan, and how many there are.

    Objects that may appear anywhere are born at all sensors' plots of the scan before, with the
    velocity unknown, as filters with births from measurements have it. Several sensors
    correct in turn.
    """
    born = around_spots(scene, scene.rate)
    w, m, P = around_spots(scene, scene.first)
    for plots in zip(*scans, strict=True):
        seen = [each[~np.isnan(each[:, 0])] for each in plots]
        w, (m, P) = SURVIVAL * w, predicted(scene, m, P)
        w, m, P = (np.concatenate(pair) for pair in zip((w, m, P), born, strict=True))
        for sensor, z in zip(scene.sensors, seen, strict=True):
            w, m, P = _merged(*updated(sensor, w, m, P, z))
        number = np.round(w).astype(int)
        yield np.repeat(m[:, PLACE], number, axis=0), float(np.round(w.sum()))
        if scene.spots is None:
            born = at_plots(scene, seen)


def around_spots(scene: Scene, number: float) -> Mixture:
    """So many objects around the spots, if there are any."""
    size = len(scene.root)
    spots = np.zeros((0, size)) if scene.spots is None else scene.spots
    P = np.diag(np.square(scene.deviations))
    rate = np.full(len(spots), number / max(len(spots), 1))
    return rate, spots, np.broadcast_to(P, (len(spots), size, size))


def predicted(scene: Scene, m: np.ndarray, P: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Means and covariances a second later."""
    F = _slopes(moved, m)
    return moved(m), F @ P @ F.swapaxes(1, 2) + scene.root @ scene.root.T


def at_plots(scene: Scene, scans: Sequence[np.ndarray]) -> Mixture:
    """New objects at the plots of all sensors, which share the rate evenly."""
    each = [at_plot(scene, *pair) for pair in zip(scene.sensors, scans, strict=True)]
    means, covariances = map(np.concatenate, zip(*each, strict=True))
    return np.full(len(means), scene.rate / max(len(means), 1)), means, covariances


def at_plot(scene: Scene, sensor: Sensor, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Means and covariances of new objects at each of a sensor's plots."""
    places, R = z, np.diag(np.square(sensor.deviations))
    P = np.zeros((len(z), 4, 4)) + np.diag(np.square(scene.deviations))
    P[:, 0::2, 0::2] = R
    if sensor.origin is not None:
        r, angle = z.T
        c, s = np.cos(angle), np.sin(angle)
        places = np.stack([r * c, r * s], axis=1) + sensor.origin
        turn = np.stack([np.stack([c, -r * s], 1), np.stack([s, r * c], 1)], axis=1)
        P[:, 0::2, 0::2] = turn @ R @ turn.swapaxes(1, 2)
    return places @ np.eye(4)[PLACE], P


def _slopes(function: Callable, x: np.ndarray) -> np.ndarray:
    """Derivatives of each row's values, by differences."""
    steps = 1e-4 * np.eye(x.shape[1])
    return np.stack([(function(x + h) - function(x - h)) / 2e-4 for h in steps], axis=-1)


def corrected(sensor: Sensor, m: np.ndarray, P: np.ndarray, z: np.ndarray) -> Mixture:
    """Densities of the plots (k, n), means (k, n, d) and covariances (n, d, d) of each pair."""
    H = _slopes(lambda x: sensor.seen(x).T, m)
    S = H @ P @ H.swapaxes(1, 2) + np.diag(np.square(sensor.deviations))
    inverse = np.linalg.inv(S)
    gains = P @ H.swapaxes(1, 2) @ inverse
    gaps = np.moveaxis(sensor.gaps(z.T[:, :, None], sensor.seen(m)[:, None]), 0, -1)
    squares = np.einsum("kni,nij,knj->kn", gaps, inverse, gaps)
    likely = np.exp(-0.5 * squares) / (2 * np.pi * np.sqrt(np.linalg.det(S)))
    return likely, m + np.einsum("nij,knj->kni", gains, gaps), P - gains @ H @ P


def updated(sensor: Sensor, w: np.ndarray, m: np.ndarray, P: np.ndarray, z: np.ndarray) -> Mixture:
    """The intensity after a scan: table I of the paper."""
    p, (likely, means, covariances) = sensor.detection(m), corrected(sensor, m, P, z)
    shares = p * w * likely
    shares /= sensor.density + shares.sum(axis=1, keepdims=True)
    return (
        np.concatenate([(1 - p) * w, shares.ravel()]),
        np.concatenate([m, means.reshape(-1, m.shape[1])]),
        np.concatenate([P, np.tile(covariances, (len(z), 1, 1))]),
    )


def _merged(w: np.ndarray, m: np.ndarray, P: np.ndarray) -> Mixture:
    """Fewer components of the same intensity: table II of the paper."""
    size, chosen = m.shape[1], w > _LEAST
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
        return np.zeros(0), np.zeros((0, size)), np.zeros((0, size, size))
    weights, means, covariances = map(np.array, zip(*parts, strict=True))
    return weights, means, covariances
