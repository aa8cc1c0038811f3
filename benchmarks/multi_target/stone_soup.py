"""Joint probabilistic data association by Stone Soup: tracks from three plots on, as it advises."""

import datetime
from collections.abc import Iterator

import numpy as np

from benchmarks.multi_target.scenes import PLACE, STEP, Scene

_MISSED = 3.0  # deviations within which the initiator takes a plot
_LOST = 3  # a track ends once its place is as uncertain as after so many misses


def applies(scene: Scene) -> bool:
    """Whether it has one linear sensor that sees everywhere, and a linear motion."""
    return len(scene.sensors) == 1 and scene.sensors[0].origin is None


def followed(scene: Scene, scans: tuple[np.ndarray, ...]) -> Iterator[tuple[np.ndarray, float]]:
    """The positions of the tracks after each scan of one linear sensor, and how many there are."""
    from stonesoup.dataassociator.neighbour import GNNWith2DAssignment
    from stonesoup.dataassociator.probability import JPDAwithLBP
    from stonesoup.deleter.error import CovarianceBasedDeleter
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
    P = np.diag(np.square(scene.deviations))
    for _ in range(50):  # to where it settles
        P = STEP @ P @ STEP.T + Q
        cross = P[:, PLACE]
        P = P - cross @ np.linalg.inv(cross[PLACE] + R) @ cross.T
    for _ in range(_LOST):
        P = STEP @ P @ STEP.T + Q
    lost = P[PLACE, PLACE].sum()
    deleter = CovarianceBasedDeleter(covar_trace_thresh=lost, mapping=PLACE)
    near = DistanceHypothesiser(predictor, updater, Mahalanobis(), missed_distance=_MISSED)
    start = datetime.datetime(2020, 1, 1)
    prior = GaussianState(np.zeros(4), np.diag(np.square(scene.deviations)), timestamp=start)
    initiator = MultiMeasurementInitiator(
        prior_state=prior, measurement_model=measures, deleter=deleter, updater=updater,
        data_associator=GNNWith2DAssignment(near), min_points=3,
    )  # fmt: skip
    hypotheses = PDAHypothesiser(
        predictor, updater, clutter_spatial_density=sensor.density, prob_detect=sensor.p_d
    )
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
