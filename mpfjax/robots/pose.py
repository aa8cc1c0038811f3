"""The pose of a robot: the heaviest hypothesis, the others, and the probability of being lost."""

from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from mpfjax.checks import Positive, checked
from mpfjax.filter import Filter
from mpfjax.mixture import ParticleMixture
from mpfjax.operations.random import split
from mpfjax.robots.localisation import wrap

_MOST_ODDS = 10.0  # in logarithms: twice the alarm's, so that doubt ends as soon as it may
_LEAST_WEIGHT = 1e-3  # of a hypothesis that is reported
_LOG_CARRIED = np.log(1e-3)  # of the probability that a robot is carried away between two scans


class PoseEstimate(NamedTuple):
    """The pose of a robot after a scan, as reported by `follow`.

    - `pose`: (x, y, heading) of the heaviest hypothesis: the mean of all particles within the
      radius of its component's mean.
    - `covariance`: (3, 3), of the same particles.
    - `localised`: its probability, given that some hypothesis is correct; see `localised`.
    - `lost`: the probability that the robot is not there; see `lost`.
    - `other_poses`, `other_weights`: the means of the components beyond that radius and their
      mixture weights, the heaviest first, (k, 3) and (k,).
    - `mixture`: the whole mixture.
    """

    pose: Float[np.ndarray, "3"]
    covariance: Float[np.ndarray, "3 3"]
    localised: float
    lost: float
    other_poses: Float[np.ndarray, "k 3"]
    other_weights: Float[np.ndarray, " k"]
    mixture: ParticleMixture


@checked
def localised(mixture: ParticleMixture, radius: Positive = 1.0) -> Float[Array, ""]:
    """The probability of the region within `radius` metres of the heaviest component's mean.

    States are poses. It measures how far the hypotheses agree, and not whether any is correct;
    `lost` accounts for both. Use it as the `collect` of a run.
    """
    return jnp.sum(jnp.where(_near(mixture, radius), mixture.weights, 0.0))


def _near(mixture: ParticleMixture, radius: Any) -> Array:
    means, heaviest = mixture.component_means(), jnp.argmax(mixture.mixture_weights)
    away = mixture.particles[:, :2] - means[heaviest, None, :2]
    return jnp.hypot(away[:, 0], away[:, 1]) < radius


def lost(localised: Any, log_evidence_against_start: Any) -> Float[np.ndarray, "*runs t"]:
    """The probability that the robot is not at the heaviest hypothesis, at each step.

        lost_t = 1 - localised_t (1 - q_t),   q_t / (1 - q_t) = o_t,
        o_t = (o_{t-1} + p) p(y_t | x ~ p_0) / p(y_t | y_1..y_{t-1}),   o_0 = p = .001

    q is the probability that all hypotheses are wrong, from the evidence that the alarm evaluates,
    for a change at an unknown time (Shiryaev 1963), where a robot is carried away between two scans
    with probability p; its odds are at most e^10.

    - `localised`: the probability at the heaviest hypothesis, (t,) or (runs, t), see `localised`.
    - `log_evidence_against_start`: from the run, or from the report of each step, of a filter with
      an alarm or restarts, of the same shape.

    Use it to stop a robot, or to let it explore: below .5 the pose is probably correct. Raises
    `ValueError` for arrays of different shapes.
    """
    shares, evidences = np.asarray(localised, float), np.asarray(log_evidence_against_start, float)
    if not shares.ndim or shares.shape != evidences.shape:
        shapes = f"{shares.shape} and {evidences.shape}"
        raise ValueError(f"localised, log_evidence_against_start: {shapes} are not (t,) both")
    log_odds, doubts = np.full(shares.shape[:-1], _LOG_CARRIED), []
    for evidence in np.moveaxis(evidences, -1, 0):
        log_odds = _next_log_odds(log_odds, evidence)
        doubts.append(log_odds)
    return 1 - np.minimum(shares, 1.0) / (1 + np.exp(np.stack(doubts, axis=-1)))


def _next_log_odds(log_odds: Any, evidence: Any) -> Any:
    log_odds = np.logaddexp(log_odds, _LOG_CARRIED) + np.where(np.isnan(evidence), 0.0, evidence)
    return np.clip(log_odds, _LOG_CARRIED - _MOST_ODDS, _MOST_ODDS)


@eqx.filter_jit
def _summary(mixture: ParticleMixture, radius: Array) -> tuple[Array, ...]:
    """Pose, covariance, the mass near the heaviest mean, and the components, which of them far."""
    mass = jnp.where(_near(mixture, radius), mixture.weights, 0.0)
    share = jnp.sum(mass)
    x, y, heading = mixture.particles.T
    sums = [jnp.sum(mass * each) for each in (x, y, jnp.cos(heading), jnp.sin(heading))]
    pose = jnp.stack([sums[0] / share, sums[1] / share, jnp.arctan2(sums[3], sums[2])])
    away = mixture.particles - pose[None]
    away = away.at[:, 2].set(wrap(away[:, 2]))
    covariance = (mass[:, None] * away).T @ away / share
    means = mixture.component_means()
    far = jnp.hypot(*(means[:, :2] - pose[None, :2]).T) >= radius
    return pose, covariance, share, means, jnp.where(far, mixture.mixture_weights, 0.0)


@checked
def follow(
    key: Key[Array, ""], filter: Filter, scans: Iterable[tuple[Any, Any]], *, radius: Positive = 1.0
) -> Iterator[PoseEstimate]:
    """The pose of the robot after each scan, as the scans arrive.

        for estimate in robots.follow(key, filter, pairs):
            print(estimate.pose, estimate.lost)

    - `filter`: of a `RobotModel`, with an alarm: `with_restarts` or `with_alarm`.
    - `scans`: pairs (step, scan) in order, of any length: the odometry since the previous pair, and
      y_t. They are read one by one.
    - `radius`: of what counts as the same position, metres; see `localised`.

    Raises `ValueError` at the first scan for a filter without an alarm. Use it in a robot: the
    program is compiled in the first steps, and all later ones take the same time, except for
    restarts.
    """
    mixture, log_odds = None, _LOG_CARRIED
    for step, scan in scans:
        key, key_init, key_step = split(key, 3)
        if mixture is None:
            mixture = filter.init(key_init, scan, inputs=step)
        mixture, info = filter.step(key_step, mixture, scan, inputs=step)
        evidence = info.log_evidence_against_start
        if evidence is None:
            raise ValueError("filter: it has no alarm; write with_alarm(filter)")
        log_odds = _next_log_odds(log_odds, float(evidence))
        summary = _summary(mixture, jnp.asarray(radius))
        pose, covariance, share, means, weights = map(np.asarray, summary)
        order = np.argsort(-weights)[: np.sum(weights > _LEAST_WEIGHT)]
        share = min(float(share), 1.0)
        yield PoseEstimate(
            pose, covariance, share, float(1 - share / (1 + np.exp(log_odds))),
            means[order], weights[order], mixture,
        )  # fmt: skip
