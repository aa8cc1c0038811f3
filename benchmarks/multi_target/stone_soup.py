"""Joint probabilistic data association by Stone Soup, with its initiator of several plots.

It is told what the other filters are: motion, noise, p_D, clutter and births. A track is confirmed
once clutter alone confirms fewer than there are new objects, and ends once misses in a row are
rarer than deaths.
"""

import datetime
from collections.abc import Iterator

import numpy as np

from benchmarks.multi_target.scenes import PLACE, STEP, SURVIVAL, Scene

_GATE = 3.0  # deviations within which a track takes a plot


def applies(scene: Scene) -> bool:
    """Whether all is linear, and objects appear anywhere, where nobody is told more."""
    return len(scene.sensors) == 1 and scene.sensors[0].origin is None and scene.spots is None


def followed(scene: Scene, scans: tuple[np.ndarray, ...]) -> Iterator[tuple[np.ndarray, float]]:
    """The positions of the tracks after each scan of one linear sensor, and how many there are."""
    from stonesoup.dataassociator.neighbour import GNNWith2DAssignment
    from stonesoup.dataassociator.probability import JPDAwithLBP
    from stonesoup.deleter.time import UpdateTimeStepsDeleter
    from stonesoup.hypothesiser.distance import DistanceHypothesiser
    from stonesoup.hypothesiser.probability import PDAHypothesiser
    from stonesoup.initiator.simple import MultiMeasurementInitiator
    from stonesoup.measures import Mahalanobis
    from stonesoup.models.measurement.linear import LinearGaussian
    from stonesoup.models.transition.linear import LinearGaussianTimeInvariantTransitionModel
    from stonesoup.predictor.kalman import KalmanPredictor
    from stonesoup.tracker.simple import MultiTargetMixtureTracker
    from stonesoup.types.detection import Detection
    from stonesoup.types.state import GaussianState
    from stonesoup.updater.kalman import KalmanUpdater

    (sensor,), (plots,) = scene.sensors, scans
    R, Q = np.diag(np.square(sensor.deviations)), scene.root @ scene.root.T
    predictor = KalmanPredictor(
        LinearGaussianTimeInvariantTransitionModel(transition_matrix=STEP, covariance_matrix=Q)
    )
    measures = LinearGaussian(ndim_state=4, mapping=PLACE, noise_covar=R)
    updater = KalmanUpdater(measures)
    gate = 1 - np.exp(-(_GATE**2) / 2)  # the probability of a plot of two numbers within it
    misses = int(np.ceil(np.log(1 - SURVIVAL) / np.log(1 - gate * sensor.p_d)))
    deleter = UpdateTimeStepsDeleter(misses)
    near = DistanceHypothesiser(predictor, updater, Mahalanobis(), missed_distance=_GATE)
    start = datetime.datetime(2020, 1, 1)
    prior = GaussianState(np.zeros(4), np.diag(np.square(scene.deviations)), timestamp=start)
    initiator = MultiMeasurementInitiator(
        prior_state=prior, measurement_model=measures, deleter=deleter, updater=updater,
        data_associator=GNNWith2DAssignment(near), min_points=_points_to_confirm(scene),
    )  # fmt: skip
    hypotheses = PDAHypothesiser(
        predictor, updater, clutter_spatial_density=sensor.density, prob_detect=sensor.p_d,
        prob_gate=gate,
    )  # fmt: skip
    detections = []
    for t, scan in enumerate(plots):
        now = {"timestamp": start + datetime.timedelta(seconds=t)}
        found = {Detection(z, measurement_model=measures, **now) for z in scan if z[0] == z[0]}
        detections.append((now["timestamp"], found))
    tracker = MultiTargetMixtureTracker(
        initiator, deleter, detections, JPDAwithLBP(hypotheses), updater
    )
    for _, tracks in tracker:
        means = [np.ravel(track.state_vector)[PLACE] for track in tracks]
        yield np.array(means, float).reshape(-1, 2), float(len(means))


def _points_to_confirm(scene: Scene) -> int:
    """After how many plots in a row clutter confirms fewer tracks a scan than there are births."""
    (sensor,), R = scene.sensors, np.diag(np.square(scene.sensors[0].deviations))
    false, points, P = sensor.clutter, 1, np.diag(np.square(scene.deviations))
    P[np.ix_(PLACE, PLACE)] = R
    while false >= scene.rate:
        P = STEP @ P @ STEP.T + scene.root @ scene.root.T
        cross, S = P[:, PLACE], P[np.ix_(PLACE, PLACE)] + R
        P = P - cross @ np.linalg.inv(S) @ cross.T
        within = np.pi * _GATE**2 * np.sqrt(np.linalg.det(S)) * sensor.density
        false, points = false * within, points + 1
    return points
