"""Objects that move with inertia, observed by a detector and by their colours."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from mpfjax.checks import check_positive, check_positive_array, given, to_array
from mpfjax.models.base import AbstractStateSpaceModel
from mpfjax.operations.indexing import take
from mpfjax.operations.matrices import row_sums
from mpfjax.vision.colour.histograms import IntegralHistogram, bhattacharyya, normalise
from mpfjax.vision.colour.sampled_histograms import SampledBoxes, SampledHistogram
from mpfjax.vision.tracking.detections import Detections

# The share of a size's growth rate that is left after a frame.
_GROWTH_KEPT = 0.9

Pixels = IntegralHistogram | SampledHistogram | SampledBoxes


class Gaussian(NamedTuple):
    """Moments of place and velocity along each of the four coordinates, which are independent.

    - `place`, `velocity`: the means; (x, y) in pixels, (log w, log h), and their change in a frame.
    - `var_place`, `cov`, `var_velocity`: the entries of the covariance of place and velocity.
    """

    place: Float[Array, "*n 4"]
    velocity: Float[Array, "*n 4"]
    var_place: Float[Array, "*n 4"]
    cov: Float[Array, "*n 4"]
    var_velocity: Float[Array, "*n 4"]

    def predicted(
        self, place_noise: Float[Array, "*n 4"], velocity_noise: Float[Array, "*n 4"]
    ) -> "Gaussian":
        """The moments a frame later: x += v + noise, v += noise; growth rates of sizes decay."""
        kept = jnp.array([1.0, 1.0, _GROWTH_KEPT, _GROWTH_KEPT], self.place.dtype)
        kept = kept.reshape((1,) * (self.place.ndim - 1) + (4,))
        return Gaussian(
            self.place + self.velocity,
            kept * self.velocity,
            self.var_place + 2 * self.cov + self.var_velocity + place_noise**2,
            self.cov + self.var_velocity,
            self.var_velocity + velocity_noise**2,
        )

    def updated(
        self, detected: Float[Array, "*n 4"], errors: Float[Array, "*n 4"]
    ) -> tuple["Gaussian", Float[Array, "*n 4"], Float[Array, "*n 4"]]:
        """Kalman's update by a detection: the posterior, the innovations and their variances."""
        variance = self.var_place + errors**2
        gap = detected - self.place
        gain, gain_velocity = self.var_place / variance, self.cov / variance
        posterior = Gaussian(
            self.place + gain * gap,
            self.velocity + gain_velocity * gap,
            self.var_place * (1 - gain),
            self.cov * (1 - gain),
            jnp.maximum(self.var_velocity - gain_velocity * self.cov, 0.0),
        )
        return posterior, gap, variance

    def mixed_with(self, other: "Gaussian", share: Float[Array, "*n #4"]) -> "Gaussian":
        """The moments of a mixture of this Gaussian, with weight `share`, and the other."""
        away, away_velocity = self.place - other.place, self.velocity - other.velocity
        between = share * (1 - share)
        rest = 1 - share
        return Gaussian(
            share * self.place + rest * other.place,
            share * self.velocity + rest * other.velocity,
            share * self.var_place + rest * other.var_place + between * away**2,
            share * self.cov + rest * other.cov + between * away * away_velocity,
            share * self.var_velocity + rest * other.var_velocity + between * away_velocity**2,
        )


class ObjectState(eqx.Module):
    """A hypothesis of the place, size and velocity of an object, and of which object it is.

    Given the assignment of detections, the model is linear and Gaussian. A particle therefore
    carries the moments of place and velocity and not a draw of them (Rao-Blackwellisation, Doucet
    et al. 2000).

    - `place`: (x, y, log w, log h), the mean of centre and size in pixels.
    - `velocity`: the mean of their change in a frame.
    - `spread`: (n, 3, 4), var place, cov, and var velocity along each coordinate.
    - `label`: the object, by the index of its component.
    """

    place: Float[Array, "*n 4"]
    velocity: Float[Array, "*n 4"]
    spread: Float[Array, "*n 3 4"]
    label: Int[Array, "*n"]

    @classmethod
    def of(cls, gaussian: Gaussian, label: Int[Array, " n"]) -> "ObjectState":
        """The hypotheses with these moments."""
        spread = jnp.stack([gaussian.var_place, gaussian.cov, gaussian.var_velocity], axis=1)
        return cls(gaussian.place, gaussian.velocity, spread, label)

    @classmethod
    def nowhere(cls, num: int) -> "ObjectState":
        """Boxes of one pixel about the origin, to fill empty slots."""
        zero = jnp.zeros((num, 4))
        return cls(zero, zero, jnp.zeros((num, 3, 4)), jnp.zeros(num, jnp.int32))

    @property
    def gaussian(self) -> Gaussian:
        """The moments."""
        var_place, cov, var_velocity = jnp.moveaxis(self.spread, -2, 0)
        return Gaussian(self.place, self.velocity, var_place, cov, var_velocity)

    @property
    def boxes(self) -> Float[Array, "*n 4"]:
        """Centre and size in pixels."""
        return boxes_of(self.place)


class NoObjectYet(AbstractStateSpaceModel):
    """x_0 of a tracker, whose slots are all empty: detections start its components later."""

    handles_missing = True  # absent detections are no error

    def sample_initial(self, key: Key[Array, ""], num_particles: int) -> ObjectState:
        """States to fill empty slots."""
        del key
        return ObjectState.nowhere(num_particles)

    def sample_transition(self, key: Key[Array, ""], states: ObjectState) -> ObjectState:
        """The same states: `PropagateObjects` moves objects."""
        del key
        return states

    def log_likelihood(self, observation: Any, states: ObjectState) -> Float[Array, " n"]:
        """Zero: `PropagateObjects` weighs objects."""
        del observation
        return jnp.zeros(states.label.shape)


class Noises(NamedTuple):
    """Standard deviations along (x, y, log w, log h), lengths in boxes.

    - `errors`: of a strong detection.
    - `place`, `velocity`: of the noise added to an object's place and velocity in a frame.
    - `start_velocity`: of an object's velocity at its first detection.
    """

    errors: Float[Array, "4"]
    place: Float[Array, "4"]
    velocity: Float[Array, "4"]
    start_velocity: Float[Array, "4"]


class AssignedFrame(NamedTuple):
    """What is observed of each object in a frame: the observation of a `DetectedObjectModel`.

    - `detections`: a row for each object, its own detection, valid where it has one.
    - `weak`: (m,), which of them are weak.
    - `doubts`: (m,), the probability that an object's detection is not its own.
    - `pixels`: the colours of the frame; None where they are not used.
    - `references`: (m, parts, channels, bins), the reference histograms of each object, all zero
      where it has none; None where none are learned.
    """

    detections: Detections
    weak: Bool[Array, " m"]
    doubts: Float[Array, " m"]
    pixels: Pixels | None
    references: Float[Array, "m parts channels bins"] | None


class DetectedObjectModel(eqx.Module):
    """Boxes with inertia, observed by a detector and, where σ is given, by their colours.

    Along each of x, y, log w and log h,

        x_t = x_{t-1} + v_{t-1} + σ_x ε,  v_t = v_{t-1} + σ_v ε',  d_t = x_t + σ_d ε''

    where d_t is the detection, and the box (w, h) of the frame before is the unit of x and y. The
    velocities of log w and log h decay. Given the assignment, this is a linear Gaussian model. With
    σ the likelihood has the further factor exp(-B² / 2σ²), where B² is the mean squared
    Bhattacharyya distance of the box's bands from their references (Pérez, Vermaak and Blake 2004).

    The noises given here are priors: `LearnNoise` fits them to the recording.

    - `detection_deviations`, `place_noise`, `velocity_noise`: σ_d, σ_x and σ_v.
    - `weak_error`: times σ_d for a weak detection.
    - `start_velocity`: the standard deviation of an object's velocity when it is first detected.
    - `sigma`: σ, None where hypotheses are not weighed by colours.

    Raises `ValueError` for a number that is not positive. Use it in an `ObjectTracker`.
    """

    detection_deviations: Float[Array, "4"] = eqx.field(
        converter=to_array("detection_deviations"), default=(0.03, 0.03, 0.04, 0.04)
    )
    place_noise: Float[Array, "4"] = eqx.field(
        converter=to_array("place_noise"), default=(0.02, 0.015, 0.03, 0.02)
    )
    velocity_noise: Float[Array, "4"] = eqx.field(
        converter=to_array("velocity_noise"), default=(0.01, 0.006, 0.003, 0.003)
    )
    start_velocity: Float[Array, "4"] = eqx.field(
        converter=to_array("start_velocity"), default=(0.1, 0.05, 0.05, 0.03)
    )
    weak_error: float = eqx.field(static=True, default=1.35)
    sigma: float | None = eqx.field(static=True, default=None)

    def __check_init__(self) -> None:
        for name in ("detection_deviations", "place_noise", "velocity_noise", "start_velocity"):
            value = getattr(self, name)
            if value.shape != (4,):
                raise ValueError(f"{name}: {value} are not 4 numbers")
            check_positive_array(**{name: value})
        check_positive(weak_error=self.weak_error, **given(sigma=self.sigma))

    @property
    def noises(self) -> Noises:
        """The noises before anything is learned."""
        return Noises(
            self.detection_deviations, self.place_noise, self.velocity_noise, self.start_velocity
        )

    def predicted(self, states: ObjectState, noises: Noises) -> ObjectState:
        """The hypotheses a frame later."""
        unit = units(states.place)
        moved = states.gaussian.predicted(unit * noises.place[None], unit * noises.velocity[None])
        return ObjectState.of(moved, states.label)

    def detection_of(
        self, observation: AssignedFrame, states: ObjectState, noises: Noises
    ) -> tuple[Float[Array, "n 4"], Float[Array, "n 4"]]:
        """The place of each state's own detection, and the standard deviations of its error."""
        places = places_of(observation.detections.boxes)
        relative = jnp.where(observation.weak, self.weak_error, 1.0)[:, None]
        deviations = units(places) * noises.errors[None] * relative
        return take(places, states.label), take(deviations, states.label)

    def seen(
        self, key: Key[Array, ""], observation: AssignedFrame, states: ObjectState
    ) -> tuple[ObjectState, Float[Array, " n"]]:
        """Draw places, and return the log-likelihood -B² / 2σ² of the colours there.

        Velocities keep their distribution given the places that are drawn.
        """
        references = observation.references
        if observation.pixels is None or references is None or self.sigma is None:
            return states, jnp.zeros(states.label.shape, states.place.dtype)
        g = states.gaussian
        noise = jax.random.normal(key, g.place.shape, g.place.dtype)
        place = g.place + jnp.sqrt(g.var_place) * noise
        posterior, _, _ = g.updated(place, jnp.zeros_like(place) + 1e-6)
        drawn = ObjectState.of(posterior._replace(place=place), states.label)
        unlike = unlikeness(observation.pixels, drawn.boxes, take(references, states.label))
        return drawn, -0.5 * unlike / self.sigma**2


def log_normal(gaps: Float[Array, "n 4"], variances: Float[Array, "n 4"]) -> Float[Array, " n"]:
    """The log density of independent normals, up to a constant."""
    return row_sums(-0.5 * gaps**2 / variances - 0.5 * jnp.log(variances))


def boxes_of(places: Float[Array, "*m 4"]) -> Float[Array, "*m 4"]:
    """Centre and size in pixels, of places (x, y, log w, log h)."""
    return jnp.concatenate([places[..., :2], jnp.exp(places[..., 2:])], axis=-1)


def places_of(boxes: Float[Array, "*m 4"]) -> Float[Array, "*m 4"]:
    """(x, y, log w, log h) of boxes by centre and size."""
    return jnp.concatenate([boxes[..., :2], jnp.log(boxes[..., 2:])], axis=-1)


def units(places: Float[Array, "*m 4"]) -> Float[Array, "*m 4"]:
    """The units of length along each coordinate: (w, h, 1, 1)."""
    sizes = jnp.exp(places[..., 2:])
    return jnp.concatenate([sizes, jnp.ones_like(sizes)], axis=-1)


def unlikeness(
    pixels: Pixels, boxes: Float[Array, "n 4"], references: Float[Array, "n parts channels bins"]
) -> Float[Array, " n"]:
    """The mean B² of each box's bands from its reference; zero where the reference is empty."""
    if isinstance(pixels, SampledBoxes):
        raise ValueError("pixels: the colours of detections alone do not give those of particles")
    histograms = normalise(pixels.counts(boxes, references.shape[1]))
    distances = jnp.mean(jnp.sum(bhattacharyya(histograms, references), axis=2), axis=1)
    return jnp.where(jnp.any(references > 0, axis=(1, 2, 3)), distances, 0.0)
