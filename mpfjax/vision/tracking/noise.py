"""The detector's errors and the noises of the motion, learned from the recording itself."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from mpfjax.checks import check_positive, check_whole
from mpfjax.mixture import ParticleMixture
from mpfjax.moves.base import AbstractMove
from mpfjax.operations.indexing import take
from mpfjax.vision.tracking.memory import (
    ASSIGNED,
    CAMERA,
    LIVES,
    NOISES,
    RIVALS,
    SCORES,
    Lives,
    remember,
)
from mpfjax.vision.tracking.model import (
    DetectedObjectModel,
    Gaussian,
    Noises,
    places_of,
    units,
)
from mpfjax.vision.tracking.observation import TrackedFrame

# Candidate deviations of detections, places and velocities, in boxes, wider than real ones.
_ERRORS = (0.01, 0.02, 0.04, 0.08, 0.16)
_PLACES = (0.005, 0.015, 0.045)
_VELOCITIES = (0.001, 0.005, 0.025, 0.1)
_GRID = np.array([(r, q, v) for r in _ERRORS for q in _PLACES for v in _VELOCITIES]).T
# Standard deviations of the log-normal priors.
_DOUBTS = (0.7, 0.7, 0.9)
# The prior of newborn speeds counts as so many objects; of so many later ones, one is forgotten.
_NEWBORN, _LATEST = 4.0, 50.0


class Rivals(NamedTuple):
    """Memory of `LearnNoise`: the moments of each object under each candidate, and its evidence.

    - `owners`: the identities of the objects; `moments`: (m, L, 4) each.
    - `evidence`: (L, 4), discounted log-likelihoods of all objects together.
    - `squares`, `newborn`: sum of squared velocities of newborn objects, in boxes; their number.
    """

    owners: Int[Array, " m"]
    moments: Gaussian
    evidence: Float[Array, "rivals 4"]
    squares: Float[Array, "4"]
    newborn: Float[Array, ""]


class LearnNoise(AbstractMove):
    """Fit the detector's errors and the objects' noises to the innovations of all objects.

    There are L candidate triples (σ_d, σ_x, σ_v) for each coordinate. Under each candidate, a
    Kalman filter follows each object. The predictive density of the innovation of the object's next
    detection adds to the evidence for the candidate, which is forgotten within `memory` frames.
    Innovations have heavy tails, so that the density is Student's with `freedom` degrees of
    freedom. `Assign`, `PropagateObjects` and `Births` take the noises exp E[log σ] under the
    posterior of the candidates, whose prior is log-normal about the model's noises. The speed of
    newborn objects is the scale of Student's distribution of the velocities after `first` strong
    detections. This is the multiple-model filter of Magill (1965), with one model for all objects.
    Only strong detections of objects that share them with no other count, and only after the
    object's `first` strong detections.

    The particles do not change. Memory: `Noises` and `Rivals`. The model changes with the data
    (`approximate` is true). Raises `ValueError` for numbers that are not positive.
    """

    model: DetectedObjectModel
    memory: float = eqx.field(static=True, default=20.0)
    freedom: float = eqx.field(static=True, default=4.0)
    first: int = eqx.field(static=True, default=3)

    def __check_init__(self) -> None:
        check_positive(memory=self.memory, freedom=self.freedom)
        check_whole(first=self.first)

    @property
    def reads(self) -> frozenset[str]:
        """The memory that it needs of other moves."""
        return frozenset({ASSIGNED, LIVES, SCORES})

    @property
    def approximate(self) -> bool:
        """True: the noises are learned from the same data that they explain."""
        return True

    def initial_memory(self, num_components: int) -> dict[str, Noises | Rivals]:
        """The model's noises, and no object."""
        m, rivals = num_components, _GRID.shape[1]
        zero = jnp.zeros((m, rivals, 4))
        moments = Gaussian(zero, zero, zero, zero, zero)
        none = jnp.zeros(m, jnp.int32)
        return {
            NOISES: self.model.noises,
            RIVALS: Rivals(none, moments, jnp.zeros((rivals, 4)), jnp.zeros(4), jnp.zeros(())),
        }

    def __call__(
        self, key: Key[Array, ""], mixture: ParticleMixture, observation: TrackedFrame
    ) -> ParticleMixture:
        """Filter every object under every candidate, and update the evidence."""
        del key
        lives: Lives = mixture.memory[LIVES]
        source, found = mixture.memory[ASSIGNED], observation.detections
        detected = lives.alive & (source >= 0)
        rows = jnp.maximum(source, 0)
        places = places_of(take(found.boxes, rows))
        rivals: Rivals = mixture.memory[RIVALS]
        known = rivals.owners == lives.identities
        strong = take(found.scores, rows) >= mixture.memory[SCORES].strong
        followed = detected & known
        teaches = followed & strong & lives.confirmed & (lives.seen >= self.first)

        errors, place_noise, velocity_noise = self._rivals(places.dtype)
        moments = rivals.moments
        if CAMERA in mixture.memory and observation.motion is not None:
            moments = observation.motion.carried(moments)
        if CAMERA in mixture.memory:
            shift = jnp.pad(mixture.memory[CAMERA].shift, (0, 2))
            moments = moments._replace(place=moments.place + shift[None, None])
        unit = units(moments.place)
        moments = moments.predicted(unit * place_noise, unit * velocity_noise)
        unit = units(moments.place)
        seen = jnp.broadcast_to(places[:, None], moments.place.shape)
        posterior, gap, variance = moments.updated(seen, unit * errors)
        evidence = self._log_density(gap, variance, unit)
        evidence = jnp.sum(jnp.where(teaches[:, None, None], evidence, 0.0), axis=0)
        kept = jnp.exp(jnp.asarray(-1 / self.memory, evidence.dtype))
        # Successive innovations of an object are correlated, unlike under the model.
        evidence = kept * rivals.evidence + 0.5 * evidence

        moments = _where(followed[:, None, None], posterior, moments)
        start: Noises = mixture.memory[NOISES]
        started = self._started(places, start.start_velocity)
        moments = _where((detected & ~known)[:, None, None], started, moments)
        owners = jnp.where(detected | known, lives.identities, 0)
        grown = followed & strong & (lives.seen == self.first)
        squares, newborn = self._speeds(mixture, rivals, grown)
        speeds = jnp.sqrt(
            (_NEWBORN * self.model.start_velocity**2 + squares) / (_NEWBORN + newborn)
        )
        errors, place, velocity = self._noises(evidence)
        noises = Noises(errors, place, velocity, speeds)
        rivals = Rivals(owners, moments, evidence, squares, newborn)
        return remember(mixture, noises=noises, rivals=rivals)

    def _speeds(
        self, mixture: ParticleMixture, rivals: Rivals, grown: Bool[Array, " m"]
    ) -> tuple[Float[Array, "4"], Float[Array, ""]]:
        """The sum of squared velocities of newborn objects and their number, with this frame's.

        The sum is weighted by a step of expectation maximisation for the scale of Student's
        distribution. One in `_LATEST` is forgotten.
        """
        scale = mixture.memory[NOISES].start_velocity[None]
        moments = mixture.particles.gaussian
        unit = units(mixture.component_averages(moments.place))
        squares = mixture.component_averages(moments.velocity**2 + moments.var_velocity) / unit**2
        trust = (self.freedom + 1) / (self.freedom + squares / scale**2)
        number = jnp.sum(grown).astype(scale.dtype)
        kept = (1 - 1 / _LATEST) ** number
        squares = jnp.sum(jnp.where(grown[:, None], trust * squares, 0.0), axis=0)
        return kept * rivals.squares + squares, kept * rivals.newborn + number

    def _log_density(
        self,
        gap: Float[Array, "m rivals 4"],
        variance: Float[Array, "m rivals 4"],
        unit: Float[Array, "m rivals 4"],
    ) -> Float[Array, "m rivals 4"]:
        """Student's log density, up to a constant, of innovations in boxes."""
        power = 0.5 * (self.freedom + 1)
        tails = power * jnp.log1p(gap**2 / variance / self.freedom)
        return -tails - 0.5 * jnp.log(variance / unit**2)

    def _rivals(self, dtype: jnp.dtype) -> Float[Array, "3 1 rivals 4"]:
        rivals = jnp.asarray(_GRID, dtype)[:, None, :, None]
        return jnp.broadcast_to(rivals, (3, 1, _GRID.shape[1], 4))

    def _started(self, places: Float[Array, "m 4"], speeds: Float[Array, "4"]) -> Gaussian:
        """The moments of an object at its first detection, under every candidate."""
        errors = self._rivals(places.dtype)[0]
        shape = (len(places), errors.shape[1], 4)
        unit = units(places)[:, None]
        still = jnp.zeros(shape, places.dtype)
        speeds = jnp.broadcast_to((unit * speeds[None, None]) ** 2, shape)
        place = jnp.broadcast_to(places[:, None], shape)
        return Gaussian(place, still, (unit * errors) ** 2, still, speeds)

    def _noises(self, evidence: Float[Array, "rivals 4"]) -> Float[Array, "3 4"]:
        """The geometric mean of each noise under the posterior of the candidates."""
        grid = jnp.log(self._rivals(evidence.dtype)[:, 0])
        prior = jnp.log(jnp.stack(self.model.noises[:3])).astype(evidence.dtype)
        doubts = jnp.asarray(_DOUBTS, evidence.dtype)[:, None, None]
        log_prior = -0.5 * jnp.sum(((grid - prior[:, None]) / doubts) ** 2, axis=0)
        weights = jax.nn.softmax(evidence + log_prior, axis=0)
        return jnp.exp(jnp.sum(weights[None] * grid, axis=1))


def _where(chosen: Bool[Array, "m 1 1"], a: Gaussian, b: Gaussian) -> Gaussian:
    return Gaussian(*(jnp.where(chosen, x, y) for x, y in zip(a, b, strict=True)))
