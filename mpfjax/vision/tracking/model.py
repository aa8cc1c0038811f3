"""Objects that move with inertia, and are seen by a detector and by their colours."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from mpfjax.checks import check_positive, check_positive_array, check_shape, given, to_array
from mpfjax.models.base import AbstractStateSpaceModel
from mpfjax.operations.indexing import take
from mpfjax.operations.matrices import row_sums
from mpfjax.vision.detections import Detections
from mpfjax.vision.histograms import IntegralHistogram, bhattacharyya, normalise
from mpfjax.vision.sampled_histograms import SampledBoxes, SampledHistogram

# So many times the deviations of a size say nothing of it.
_NOTHING = 10.0

Pixels = IntegralHistogram | SampledHistogram | SampledBoxes


class ObjectState(eqx.Module):
    """Where an object is, how large, how fast, and which object it is.

    - `place`: (x, y, log w, log h), the centre and the size in pixels.
    - `velocity`: of the centre, in pixels a frame.
    - `label`: the object, by the number of its component.
    """

    place: Float[Array, "*n 4"]
    velocity: Float[Array, "*n 2"]
    label: Int[Array, "*n"]

    @property
    def boxes(self) -> Float[Array, "*n 4"]:
        """Centre and size in pixels."""
        return jnp.concatenate([self.place[..., :2], jnp.exp(self.place[..., 2:])], axis=-1)


class AssignedFrame(NamedTuple):
    """What is seen of each object in a frame: the observation of a `DetectedObjectModel`.

    - `detections`: a row for each object, its own detection, valid where it has one.
    - `weak`: (m,), which of them are weak ones; `merged`: which stand for others as well, whom the
      object hides; `borrowed`: which are those of another object, which hides this one.
    - `doubts`: (m,), the floor of each object's likelihood beside the model's own: what speaks for
      its detection being another's.
    - `pixels`: the colours of the frame; None where nobody looks at them.
    - `references`: (m, parts, channels, bins), the histograms that each object is known by, all
      zero where it has none; None where nobody learns any.
    """

    detections: Detections
    weak: Bool[Array, " m"]
    merged: Bool[Array, " m"]
    borrowed: Bool[Array, " m"]
    doubts: Float[Array, " m"]
    pixels: Pixels | None
    references: Float[Array, "m parts channels bins"] | None


class DetectedObjectModel(AbstractStateSpaceModel):
    """Boxes with inertia, seen by a detector, and by their colours where that is asked for.

    With the box (w, h) of the frame before as the unit of x and y, the centre moves by its velocity
    and an acceleration, x_t = x_{t-1} + v_t + w σ_x ε, v_t = v_{t-1} + w σ_v ε', and log w and
    log h diffuse. L(y | x) = (miss + exp(-½ |(d - x) / deviations|²)) exp(-B² / 2σ²): d is the
    object's own detection, whose size is the unit of the first two differences, `miss` the floor
    for a detection of something else, and B² the mean squared Bhattacharyya distance of the box's
    bands from their references. Where an object has no detection the first factor is one and where
    it has no reference the second; two cues, taken for independent, as by Pérez, Vermaak and Blake
    (2004).

    - `position_noise`, `velocity_noise`: σ_x and σ_v of x and y, in boxes a frame.
    - `size_noise`: of log w and log h in a frame.
    - `detection_deviations`: of (x, y, log w, log h); `weak_error` times as much for a weak one,
      `merged_error` times for one that stands for two, and `borrowed_error` times in the place for
      one of another object, which says nothing of the size.
    - `miss`: against 1 where detection and box agree; a frame's doubts come on top of it.
    - `sigma`: σ, None where the particles are not weighed by colours.

    Raises `ValueError` for a number that is not positive. Use it in an `ObjectTracker`.
    """

    position_noise: Float[Array, "2"] = eqx.field(converter=to_array("position_noise"))
    velocity_noise: Float[Array, "2"] = eqx.field(converter=to_array("velocity_noise"))
    size_noise: Float[Array, "2"] = eqx.field(converter=to_array("size_noise"))
    detection_deviations: Float[Array, "4"] = eqx.field(converter=to_array("detection_deviations"))
    weak_error: float = eqx.field(static=True, default=1.35)
    merged_error: float = eqx.field(static=True, default=2.0)
    borrowed_error: float = eqx.field(static=True, default=3.0)
    miss: float = eqx.field(static=True, default=1e-4)
    sigma: float | None = eqx.field(static=True, default=None)

    def __check_init__(self) -> None:
        lengths = {"position_noise": 2, "velocity_noise": 2, "size_noise": 2}
        for name, length in (lengths | {"detection_deviations": 4}).items():
            value = getattr(self, name)
            if value.shape != (length,):
                raise ValueError(f"{name}: {value} are not {length} numbers")
            check_positive_array(**{name: value})
        check_positive(
            miss=self.miss,
            weak_error=self.weak_error,
            merged_error=self.merged_error,
            borrowed_error=self.borrowed_error,
            **given(sigma=self.sigma),
        )

    def sample_initial(self, key: Key[Array, ""], num_particles: int) -> ObjectState:
        """Boxes of one pixel about the origin: objects are founded later, by detections."""
        del key
        return ObjectState(
            jnp.zeros((num_particles, 4)),
            jnp.zeros((num_particles, 2)),
            jnp.zeros(num_particles, jnp.int32),
        )

    def sample_transition(self, key: Key[Array, ""], states: ObjectState) -> ObjectState:
        """x_t: the place first, then the velocity that goes with it."""
        key_place, key_velocity = jax.random.split(key)
        n, dtype = states.place.shape[0], states.place.dtype
        place = jax.random.normal(key_place, (n, 4), dtype)
        velocity = jax.random.normal(key_velocity, (n, 2), dtype)
        return self.transition_from_noise(jnp.concatenate([place, velocity], axis=1), states)

    @property
    def noise_dimension(self) -> int:
        """Four numbers for the place, and two for the velocity."""
        return 6

    def transition_from_noise(self, noise: Float[Array, "n 6"], states: ObjectState) -> ObjectState:
        """The same, made of standard normal noise."""
        check_shape("n 6", noise=noise)
        mean, deviations = self.predicted(states)
        return self.with_velocity(noise[:, 4:], states, mean + deviations * noise[:, :4])

    def log_transition(
        self, states: ObjectState, previous_states: ObjectState
    ) -> Float[Array, " n"]:
        """log D of place and velocity."""
        mean, deviations = self.predicted(previous_states)
        log_place = log_normal(states.place, mean, deviations)
        return log_place + self.log_velocity(states, previous_states)

    def predicted(self, states: ObjectState) -> tuple[Float[Array, "n 4"], Float[Array, "n 4"]]:
        """Mean and deviations of the next place, given the state."""
        moved = states.place.at[:, :2].add(states.velocity)
        shocks = jnp.sqrt(self.position_noise**2 + self.velocity_noise**2)
        centre = jnp.exp(states.place[:, 2:]) * shocks[None]
        size = jnp.broadcast_to(self.size_noise[None], centre.shape)
        return moved, jnp.concatenate([centre, size], axis=1)

    def with_velocity(
        self, noise: Float[Array, "n 2"], previous: ObjectState, place: Float[Array, "n 4"]
    ) -> ObjectState:
        """The state in a new place, its velocity made of noise, given the place."""
        mean, deviations = self._velocity_given(previous, place)
        return ObjectState(place, mean + deviations * noise, previous.label)

    def log_velocity(self, states: ObjectState, previous: ObjectState) -> Float[Array, " n"]:
        """The log density of `with_velocity`."""
        mean, deviations = self._velocity_given(previous, states.place)
        return log_normal(states.velocity, mean, deviations)

    def _velocity_given(
        self, previous: ObjectState, place: Float[Array, "n 4"]
    ) -> tuple[Float[Array, "n 2"], Float[Array, "n 2"]]:
        """Moments of v_t given x_t: of two Gaussian shocks, one of which is in both."""
        shared, own = self.velocity_noise**2, self.position_noise**2
        shock = place[:, :2] - previous.place[:, :2] - previous.velocity
        mean = previous.velocity + (shared / (shared + own))[None] * shock
        unit = jnp.exp(previous.place[:, 2:])
        return mean, unit * jnp.sqrt(shared * own / (shared + own))[None]

    def detection_of(
        self, observation: AssignedFrame, states: ObjectState
    ) -> tuple[Float[Array, "n 4"], Float[Array, "n 4"]]:
        """The place of each state's own detection, and its deviations there; infinite for none."""
        found = observation.detections
        places = jnp.concatenate([found.boxes[:, :2], jnp.log(found.boxes[:, 2:])], axis=1)
        unit = jnp.concatenate([found.boxes[:, 2:], jnp.ones_like(found.boxes[:, 2:])], axis=1)
        unit = unit * self._errors(observation)
        deviations = jnp.where(
            found.valid[:, None], unit * self.detection_deviations[None], jnp.inf
        )
        return take(places, states.label), take(deviations, states.label)

    def _errors(self, observation: AssignedFrame) -> Float[Array, "m 4"]:
        """How many times the deviations of a sure detection each object's own has."""
        borrowed = jnp.array([self.borrowed_error, self.borrowed_error, _NOTHING, _NOTHING])
        errors = jnp.where(observation.weak, self.weak_error, 1.0)[:, None]
        errors = errors * jnp.where(observation.merged[:, None], self.merged_error, 1.0)
        return errors * jnp.where(observation.borrowed[:, None], borrowed[None], 1.0)

    def log_likelihood(self, observation: AssignedFrame, states: ObjectState) -> Float[Array, " n"]:
        """log (miss + exp(-½ ...)) where there is a detection, and -B² / 2σ²."""
        places, deviations = self.detection_of(observation, states)
        gaps = (places - states.place) / deviations
        floor = self.miss + take(observation.doubts, states.label)
        log_detected = jnp.log(floor + jnp.exp(-0.5 * jnp.sum(gaps**2, axis=1)))
        detected = take(observation.detections.valid, states.label)
        log_detected = jnp.where(detected, log_detected, 0.0)
        references = observation.references
        if observation.pixels is None or references is None or self.sigma is None:
            return log_detected
        references = take(references, states.label)
        unlike = unlikeness(observation.pixels, states.boxes, references)
        return log_detected - 0.5 * unlike / self.sigma**2


def unlikeness(
    pixels: Pixels, boxes: Float[Array, "n 4"], references: Float[Array, "n parts channels bins"]
) -> Float[Array, " n"]:
    """The mean B² of each box's bands from a reference of its own; zero where that is empty."""
    if isinstance(pixels, SampledBoxes):
        raise ValueError("pixels: those of detections alone do not show what particles cover")
    histograms = normalise(pixels.counts(boxes, references.shape[1]))
    distances = jnp.mean(jnp.sum(bhattacharyya(histograms, references), axis=2), axis=1)
    return jnp.where(jnp.any(references > 0, axis=(1, 2, 3)), distances, 0.0)


def log_normal(
    values: Float[Array, "n d"], mean: Float[Array, "n d"], deviations: Float[Array, "n d"]
) -> Float[Array, " n"]:
    """The log density of each row under independent normals."""
    gaps = (values - mean) / deviations
    return row_sums(-0.5 * gaps**2 - jnp.log(deviations) - 0.5 * jnp.log(2 * jnp.pi))
