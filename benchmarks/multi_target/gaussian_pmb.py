"""A Gaussian Poisson multi-Bernoulli filter (Williams 2015), extended where a scene is not linear.

The same filter as `bernoulli_filter` in closed form: each object's density is one Gaussian, and
the marginal probabilities of associations are those of belief propagation.
"""

from collections.abc import Iterator

import numpy as np

from benchmarks.multi_target.gm_phd import Mixture, around_spots, at_plot, corrected, predicted
from benchmarks.multi_target.scenes import PLACE, SURVIVAL, Scene, Sensor
from mpfjax.moves.objects.association import iterate_replies

_LEAST = 1e-4  # of the existence of a track, and of a part of the intensity


def followed(scene: Scene, scans: tuple[np.ndarray, ...]) -> Iterator[tuple[np.ndarray, float]]:
    """The positions of the objects after each scan, and the median of how many there are."""
    d, born = len(scene.root), around_spots(scene, scene.rate)
    tracks: Mixture = (np.zeros(0), np.zeros((0, d)), np.zeros((0, d, d)))
    unseen = around_spots(scene, scene.first)
    for t, plots in enumerate(zip(*scans, strict=True)):
        tracks, unseen = ((SURVIVAL * r, *predicted(scene, m, P)) for r, m, P in (tracks, unseen))
        unseen = _joined(unseen, born)
        for number, (sensor, z) in enumerate(zip(scene.sensors, plots, strict=True)):
            z = z[~np.isnan(z[:, 0])]
            if scene.spots is None:
                starts = _anywhere(scene, number, z, t)
            else:
                starts, unseen = _from_spots(sensor, unseen, z)
            tracks = _updated(sensor, tracks, starts, z)
        r, m, _ = tracks
        shares = np.ones(1)
        for each in r:
            shares = np.convolve(shares, [1 - each, each])
        yield m[r > 0.5][:, PLACE], float((shares.cumsum() < 0.5).sum())


def _updated(sensor: Sensor, tracks: Mixture, starts: Mixture, z: np.ndarray) -> Mixture:
    """The tracks after a scan, each with its moments over all associations, and the new ones."""
    r, m, P = tracks
    odds, new_m, new_P = starts
    p, (likely, means, covariances) = sensor.detection(m), corrected(sensor, m, P, z)
    pairs = (r * p * likely / sensor.density).T
    replies = iterate_replies(pairs, 1 - r * p, 1 + odds)
    sums = 1 - r * p + (pairs * replies).sum(axis=1)
    shares = np.concatenate([(r * (1 - p) / sums)[:, None], pairs * replies / sums[:, None]], 1)
    every = np.concatenate([m[:, None], means.swapaxes(0, 1)], axis=1)
    spreads = np.concatenate([P[:, None], np.repeat(covariances[:, None], len(z), 1)], axis=1)
    old = _moments(shares, every, spreads)
    others = pairs * replies
    claims = pairs / (sums[:, None] - others)
    new = odds / (1 + odds + claims.sum(axis=0))
    r, m, P = _joined(old, (new, new_m, new_P))
    chosen = r >= _LEAST
    return r[chosen], m[chosen], P[chosen]


def _from_spots(sensor: Sensor, unseen: Mixture, z: np.ndarray) -> tuple[Mixture, Mixture]:
    """New tracks at each plot, over clutter, and the objects that remain undetected."""
    w, m, P = unseen
    p, (likely, means, covariances) = sensor.detection(m), corrected(sensor, m, P, z)
    spreads = np.broadcast_to(covariances, (len(z), *covariances.shape))
    starts = _moments(p * w * likely / sensor.density, means, spreads)
    w, chosen = (1 - p) * w, (1 - p) * w >= _LEAST
    return starts, (w[chosen], m[chosen], P[chosen])


def _anywhere(scene: Scene, number: int, z: np.ndarray, t: int) -> Mixture:
    """New tracks at plots where the intensity of objects not yet detected is a geometric series.

    Its ratio at a place is the chance to survive a step and be missed by all sensors there.
    """
    sensor = scene.sensors[number]
    m, P = at_plot(scene, sensor, z)
    seen = [1 - other.detection(m) for other in scene.sensors]
    ratio = SURVIVAL * np.prod(seen, axis=0)
    intensity = scene.rate * (1 - ratio ** (t + 1)) / (1 - ratio)
    intensity += SURVIVAL * scene.first * ratio**t
    low, high = scene.region
    inside = np.all((m[:, PLACE] >= low) & (m[:, PLACE] <= high), axis=1)
    intensity *= inside * sensor.detection(m) * np.prod(seen[:number], axis=0)
    stretch = 1.0 if sensor.origin is None else z[:, 0]  # of a range and bearing, in places
    return intensity * stretch / np.prod(np.subtract(high, low)) / sensor.density, m, P


def _moments(w: np.ndarray, m: np.ndarray, P: np.ndarray) -> Mixture:
    """The weight, mean and covariance of each row's Gaussians."""
    total = w.sum(axis=1)
    shares = w / np.maximum(total, 1e-300)[:, None]
    mean = np.einsum("kn,kni->ki", shares, m)
    off = m - mean[:, None]
    return total, mean, np.einsum("kn,knij->kij", shares, P + off[..., None] * off[:, :, None])


def _joined(*mixtures: Mixture) -> Mixture:
    w, m, P = map(np.concatenate, zip(*mixtures, strict=True))
    return w, m, P
