"""A Kalman filter for each object, told when it is there and which plots are its own.

What remains is the error of the plots: no filter that has to find this out is expected below it. It
draws plots of its own, by the same law.
"""

from collections.abc import Iterator

import numpy as np
from numpy.random import Generator

from benchmarks.multi_target.gm_phd import at_plot, predicted, updated
from benchmarks.multi_target.scenes import PLACE, Scene, drawn

Track = tuple[np.ndarray, np.ndarray]  # mean and covariance, (1, d) and (1, d, d)


def followed(scene: Scene, seed: int, steps: int) -> Iterator[tuple[np.ndarray, float]]:
    """The positions of the objects after each scan, from the first plot on, and their number."""
    truth, _ = drawn(scene, seed, steps)
    rng, tracks = np.random.default_rng((seed, 1)), [None] * truth.shape[1]
    for states in truth:
        for k, state in enumerate(states):
            tracks[k] = None if np.isnan(state[0]) else _advanced(scene, rng, state, tracks[k])
        places = [track[0][0, PLACE] for track in tracks if track is not None]
        yield np.array(places).reshape(-1, 2), float(len(places))


def _advanced(scene: Scene, rng: Generator, state: np.ndarray, track: Track | None) -> Track | None:
    if track is not None:
        track = predicted(scene, *track)
    elif scene.spots is not None:
        near = np.linalg.norm((scene.spots - state)[:, PLACE], axis=1).argmin()
        track = scene.spots[[near]], np.diag(np.square(scene.deviations))[None]
    for sensor in scene.sensors:
        if rng.random() < sensor.detection(state[None])[0]:
            plot = sensor.seen(state[None]).T + sensor.deviations * rng.normal(size=(1, 2))
            if track is None:
                track = at_plot(scene, sensor, plot)
            else:
                _, means, covariances = updated(sensor, np.ones(1), *track, plot)
                track = means[1:], covariances[1:]
    return track
