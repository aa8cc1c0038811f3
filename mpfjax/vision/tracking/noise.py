"""The detector's errors and the noises of the motion, learned from the recording itself."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import softmax

from mpfjax.vision.tracking.gaussian import Gaussian, units
from mpfjax.vision.tracking.pairs import Flags, Integers

# Candidate deviations of detections, places and velocities, in boxes, wider than real ones. They
# and the priors are for 25 frames a second.
_ERRORS = (0.01, 0.02, 0.04, 0.08, 0.16)
_PLACES = (0.005, 0.015, 0.045)
_VELOCITIES = (0.001, 0.005, 0.025, 0.1)
_GRID = np.array([(r, q, v) for r in _ERRORS for q in _PLACES for v in _VELOCITIES])
# Means of the log-normal priors along (x, y, log w, log h), and their standard deviations.
_PRIOR = np.array(
    [(0.03, 0.03, 0.04, 0.04), (0.02, 0.015, 0.03, 0.02), (0.01, 0.006, 0.003, 0.003)]
)
_DOUBTS = np.array([0.7, 0.7, 0.9])
# The deviation of a newborn object's velocity; how many times longer a frame may count as.
_SPEED, _MOST = np.array([0.1, 0.05, 0.05, 0.03]), 2.5
# Errors are the same at any rate. The noises are those of a random walk of places, and of one of
# velocities, which are by frames.
_POWERS = np.array([0.0, 0.5, 1.5])
# Of points, in deviations of their errors, which are given: what moves steadily has nearly no noise
# of its place, and what walks at random much.
_POINT_PLACES, _POINT_VELOCITIES = (0.01, 0.1, 0.4, 1.6), (0.003, 0.03, 0.15, 0.8, 4.0)
_POINT_GRID = np.array([(1.0, q, v) for q in _POINT_PLACES for v in _POINT_VELOCITIES])
_POINT_PRIOR, _POINT_DOUBTS = np.array([(1.0,) * 2, (0.2,) * 2, (0.2,) * 2]), np.full(3, 1.5)
_POINT_SPEED = np.full(2, 3.0)
# The prior of newborn speeds counts as so many objects; of so many later ones, one is forgotten.
_NEWBORN, _LATEST = 4.0, 50.0
_MEMORY = 20.0  # frames after which evidence is forgotten
_FREEDOM = 4.0  # degrees, of Student's distribution of innovations
_FOLLOWED = 128  # objects at a time tell the noises as well as more would


# By the number of coordinates, for all objects.
_RIVALS = {4: _GRID.T[:, None, :, None], 2: _POINT_GRID.T[:, None, :, None]}
_BEFORE = {4: (_PRIOR, _DOUBTS, _SPEED), 2: (_POINT_PRIOR, _POINT_DOUBTS, _POINT_SPEED)}


class Noises(NamedTuple):
    """Standard deviations along each coordinate, lengths in boxes or errors of points.

    - `errors`: of a strong detection.
    - `place`, `velocity`: of the noise added to an object's place and velocity in a frame.
    - `speed`: of an object's velocity at its first detection.
    """

    errors: Float[np.ndarray, " k"]
    place: Float[np.ndarray, " k"]
    velocity: Float[np.ndarray, " k"]
    speed: Float[np.ndarray, " k"]


class NoiseState(NamedTuple):
    """What is known of the noises: L candidates (errors, place, velocity) for each coordinate.

    - `followed`: (m,), the objects that tell the noises, at most 128.
    - `moments`: (n, L, k) each, every object that is followed under every candidate.
    - `evidence`: (L, k), discounted log-likelihoods of all objects together.
    - `squares`, `newborn`: sum of squared velocities of newborn objects, in boxes; their number.
    - `start`: the prior deviation of a newborn object's velocity.
    - `scale`: (3,), of the candidates, at this frame rate.
    - `noises`: what is believed.
    """

    followed: Bool[np.ndarray, " m"]
    moments: Gaussian
    evidence: Float[np.ndarray, "l k"]
    squares: Float[np.ndarray, " k"]
    newborn: float
    start: Float[np.ndarray, " k"]
    scale: Float[np.ndarray, "3"]
    noises: Noises

    @classmethod
    def initial(cls, frames_per_second: float, coordinates: int) -> "NoiseState":
        """Before any frame: the means of the priors. Boxes move less evenly at a lower rate."""
        prior, _, speed = _BEFORE[coordinates]
        longer = min(25 / frames_per_second, _MOST)
        start, scale = longer * speed, longer ** (_POWERS if coordinates == 4 else 0 * _POWERS)
        noises = Noises(*(scale[:, None] * prior), speed=start)
        none = np.zeros((_RIVALS[coordinates].shape[2], coordinates))
        moments = Gaussian.none(*none.shape)
        return cls(np.zeros(0, bool), moments, none, 0.0 * start, 0.0, start, scale, noises)

    def predict(self, frames: float) -> "NoiseState":
        """Every object that is followed, later, under every candidate in units of its own."""
        scale = self.scale[:, None, None, None]
        _, place, velocity = scale * _RIVALS[self.evidence.shape[1]]
        moments = self.moments.predict(place, velocity, self.moments.unit, frames)
        return self._replace(moments=moments)

    def after(
        self, columns: Integers, places: Float[np.ndarray, "d k"], teaches: Flags, grown: Gaussian
    ) -> "NoiseState":
        """Update the objects by the detections in these columns, -1 for none, and the evidence.

        Under each candidate a Kalman filter follows each object. The predictive density of the
        object's next detection, Student's since innovations have heavy tails, adds to the evidence
        for the candidate, which is forgotten in a second. The noises are exp E[log σ] under the
        posterior of the candidates, whose prior is log-normal. It is the multiple-model filter of
        Magill (1965), with one model for all objects. The speed of newborn objects is the scale of
        Student's distribution of the velocities of those that have `grown`.

        `self.moments` are predicted, have moved with the camera, and are written to.
        """
        columns, teaches = columns[self.followed], teaches[self.followed]
        rows = columns >= 0
        predicted, places, teaches = self.moments.at(rows), places[columns[rows]], teaches[rows]
        unit = predicted.unit
        posterior, gap, variance = predicted.update(
            places[:, None], unit * _RIVALS[self.evidence.shape[1]][0]
        )
        self.moments.put(rows, posterior)
        gap, variance, unit = gap[teaches], variance[teaches], unit[teaches]
        tails = 0.5 * (_FREEDOM + 1) * np.log1p(gap**2 / variance / _FREEDOM)
        density = np.sum(-tails - 0.5 * np.log(variance / unit**2), axis=0)
        # Successive innovations of an object are correlated, unlike under the model.
        evidence = np.exp(-1 / _MEMORY) * self.evidence + 0.5 * density
        squares, newborn = self._speeds(grown)
        speed = np.sqrt((_NEWBORN * self.start**2 + squares) / (_NEWBORN + newborn))
        prior, doubts, _ = _BEFORE[evidence.shape[1]]
        logs = np.log(_RIVALS[evidence.shape[1]][:, 0])
        away = (logs - np.log(prior)[:, None]) / doubts[:, None, None]
        weights = softmax(evidence - 0.5 * np.sum(away**2, axis=0), axis=0)
        means = self.scale[:, None] * np.exp(np.sum(weights[None] * logs, axis=1))
        noises = Noises(*means, speed=speed)
        return self._replace(evidence=evidence, squares=squares, newborn=newborn, noises=noises)

    def renew(
        self, stays: Flags, places: Float[np.ndarray, "n k"], speed: Float[np.ndarray, " k"]
    ) -> "NoiseState":
        """Without the objects that end, and with new ones at these places while there is room."""
        moments, followed = self.moments.at(stays[self.followed]), self.followed[stays]
        is_followed = np.arange(len(places)) < _FOLLOWED - len(moments.place)
        unit = units(places[is_followed])[:, None]
        errors = _RIVALS[self.evidence.shape[1]][0]
        newborns = Gaussian.initial(places[is_followed, None], unit * errors, unit * speed)
        followed = np.append(followed, is_followed)
        return self._replace(followed=followed, moments=moments.append(newborns))

    def _speeds(self, grown: Gaussian) -> tuple[Float[np.ndarray, " k"], float]:
        """The sum of squared velocities of newborn objects and their number, with this frame's.

        The sum is weighted by a step of expectation maximisation for Student's scale.
        """
        squares = (grown.velocity**2 + grown.var_velocity) / grown.unit**2
        trust = (_FREEDOM + 1) / (_FREEDOM + squares / self.noises.speed**2)
        decay, number = (1 - 1 / _LATEST) ** len(squares), len(squares)
        return decay * self.squares + np.sum(trust * squares, axis=0), decay * self.newborn + number
