"""The detector's errors and the noises of the motion, learned from the recording itself."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mpfjax.vision.tracking.gaussian import Gaussian, units, zeros

# Candidate deviations of detections, places and velocities, in boxes, wider than real ones.
_ERRORS = (0.01, 0.02, 0.04, 0.08, 0.16)
_PLACES = (0.005, 0.015, 0.045)
_VELOCITIES = (0.001, 0.005, 0.025, 0.1)
_GRID = np.array([(r, q, v) for r in _ERRORS for q in _PLACES for v in _VELOCITIES], np.float32)
_RIVALS = _GRID.T[:, None, :, None]  # for all objects and coordinates
# Means of the log-normal priors along (x, y, log w, log h), and their standard deviations.
_PRIOR = np.array(
    [(0.03, 0.03, 0.04, 0.04), (0.02, 0.015, 0.03, 0.02), (0.01, 0.006, 0.003, 0.003)], np.float32
)
_LOG_GRID, _LOG_PRIOR = np.log(_RIVALS[:, 0]), np.log(_PRIOR)[:, None]
_DOUBTS = np.array([0.7, 0.7, 0.9], np.float32)
# The deviation of a newborn object's velocity at 25 frames a second, and at most times as large.
_SPEED, _MOST = np.array([0.1, 0.05, 0.05, 0.03], np.float32), 2.5
# The prior of newborn speeds counts as so many objects; of so many later ones, one is forgotten.
_NEWBORN, _LATEST = 4.0, 50.0
_MEMORY = 20.0  # frames after which evidence is forgotten
_FREEDOM = 4.0  # degrees, of Student's distribution of innovations


class Noises(NamedTuple):
    """Standard deviations along (x, y, log w, log h), lengths in boxes.

    - `errors`: of a strong detection.
    - `place`, `velocity`: of the noise added to an object's place and velocity in a frame.
    - `speed`: of an object's velocity at its first detection.
    """

    errors: Float[Array, "4"]
    place: Float[Array, "4"]
    velocity: Float[Array, "4"]
    speed: Float[Array, "4"]


class NoiseState(NamedTuple):
    """What is known of the noises: L candidates (errors, place, velocity) for each coordinate.

    - `moments`: (m, L, 4) each, every object under every candidate.
    - `evidence`: (L, 4), discounted log-likelihoods of all objects together.
    - `squares`, `newborn`: sum of squared velocities of newborn objects, in boxes; their number.
    - `start`: the prior deviation of a newborn object's velocity.
    - `noises`: what is believed.
    """

    moments: Gaussian
    evidence: Float[Array, "l 4"]
    squares: Float[Array, "4"]
    newborn: Float[Array, ""]
    start: Float[Array, "4"]
    noises: Noises

    @classmethod
    def initial(cls, num_objects: int, frames_per_second: float) -> "NoiseState":
        """Before any frame: the means of the priors. New objects move further at a lower rate."""
        start: Any = np.float32(min(25 / frames_per_second, _MOST)) * _SPEED
        errors, place, velocity = (zeros(4) + row for row in _PRIOR)
        noises = Noises(errors, place, velocity, start)
        moments, evidence = Gaussian.nowhere(num_objects, len(_GRID)), zeros(len(_GRID), 4)
        return cls(moments, evidence, zeros(4), zeros(), start, noises)

    def after(
        self,
        places: Float[Array, "m 4"],
        detected: Bool[Array, " m"],
        teaches: Bool[Array, " m"],
        born: Bool[Array, " m"],
        grown: Bool[Array, " m"],
        objects: Gaussian,
    ) -> "NoiseState":
        """Filter every object under every candidate, and update the evidence.

        Under each candidate a Kalman filter follows each object. The predictive density of the
        object's next detection, Student's since innovations have heavy tails, adds to the evidence
        for the candidate, which is forgotten in a second. The noises are exp E[log σ] under the
        posterior of the candidates, whose prior is log-normal. It is the multiple-model filter of
        Magill (1965), with one model for all objects. The speed of newborn objects is the scale of
        Student's distribution of the velocities of those that have `grown`.

        `places` are those of the objects' detections. `self.moments` have moved with the camera.
        """
        errors, place_noise, velocity_noise = jnp.asarray(_RIVALS)
        moments = self.moments.predicted(place_noise, velocity_noise)
        unit = moments.unit
        posterior, gap, variance = moments.updated(places[:, None], unit * errors)
        tails = 0.5 * (_FREEDOM + 1) * jnp.log1p(gap**2 / variance / _FREEDOM)
        density = -tails - 0.5 * jnp.log(variance / unit**2)
        density = jnp.sum(jnp.where(teaches[:, None, None], density, 0.0), axis=0)
        # Successive innovations of an object are correlated, unlike under the model.
        evidence = np.float32(np.exp(-1 / _MEMORY)) * self.evidence + 0.5 * density
        unit = units(places)[:, None]
        begun = Gaussian.begun(places[:, None], unit * errors, unit * self.noises.speed[None, None])
        moments = begun.where(born, posterior.where(detected, moments))
        squares, newborn = self._speeds(grown, objects)
        speed = jnp.sqrt((_NEWBORN * self.start**2 + squares) / (_NEWBORN + newborn))
        log_prior = -0.5 * np.sum(((_LOG_GRID - _LOG_PRIOR) / _DOUBTS[:, None, None]) ** 2, axis=0)
        believed = jax.nn.softmax(evidence + log_prior, axis=0)
        errors, place, velocity = jnp.exp(jnp.sum(believed[None] * _LOG_GRID, axis=1))
        noises = Noises(errors, place, velocity, speed)
        return NoiseState(moments, evidence, squares, newborn, self.start, noises)

    def _speeds(
        self, grown: Bool[Array, " m"], objects: Gaussian
    ) -> tuple[Float[Array, "4"], Float[Array, ""]]:
        """The sum of squared velocities of newborn objects and their number, with this frame's.

        The sum is weighted by a step of expectation maximisation for Student's scale.
        """
        squares = (objects.velocity**2 + objects.var_velocity) / objects.unit**2
        trust = (_FREEDOM + 1) / (_FREEDOM + squares / self.noises.speed[None] ** 2)
        number = jnp.sum(grown, dtype=squares.dtype)
        kept = (1 - 1 / _LATEST) ** number
        total = jnp.sum(jnp.where(grown[:, None], trust * squares, 0.0), axis=0)
        return kept * self.squares + total, kept * self.newborn + number
