"""Colour and detections together: what a detector says of a box, as a likelihood."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key, UInt8

from mpfjax.models.base import AbstractStateSpaceModel, require_positive
from mpfjax.vision.boxes import centred
from mpfjax.vision.colour_model import BoxState, ColourModel
from mpfjax.vision.histograms import IntegralHistogram


class Detections(eqx.Module):
    """The boxes that a detector found in one frame, padded to a fixed number.

    - `boxes`: (d, 4), centre and size in pixels.
    - `valid`: (d,), which rows are detections.
    """

    boxes: Float[Array, "d 4"]
    valid: Bool[Array, " d"]

    @classmethod
    def from_boxes(cls, boxes: Float[np.ndarray, "k 4"], max_detections: int) -> "Detections":
        """Boxes (x, y, w, h), top-left corner first; of too many, the largest are kept."""
        boxes = np.asarray(boxes, np.float32).reshape(-1, 4)
        if max_detections < 1:
            raise ValueError(f"max_detections: {max_detections} is less than 1")
        if not (np.isfinite(boxes).all() and (boxes[:, 2:] > 0).all()):
            raise ValueError("boxes: a detection without area, or not finite")
        largest = np.argsort(-boxes[:, 2] * boxes[:, 3], kind="stable")[:max_detections]
        kept = centred(boxes[largest])
        padded = np.ones((max_detections, 4), np.float32)
        padded[: len(kept)] = kept
        return cls(jnp.asarray(padded), jnp.arange(max_detections) < len(kept))


class DetectedFrame(eqx.Module):
    """A frame and what was detected in it: the observation of a `DetectedColourModel`."""

    frame: IntegralHistogram | UInt8[Array, "h w 3"]
    detections: Detections


class DetectedColourModel(AbstractStateSpaceModel):
    """A `ColourModel` whose boxes are seen by a detector as well.

    L(y | x) = L_colour(y | x) (miss + Σ_d exp(-½ |(x - d) / deviations|²)), with the box x and the
    detections d as (centre, log size), the centre in units of the box: two cues that are taken
    for independent, as by Pérez, Vermaak and Blake (2004), the second a Gaussian about each
    detection over a floor for what the detector misses or lumps together.

    - `colour`: the model of the boxes' motion and colours.
    - `deviations`: of a detection from the box that it sees, (x, y, log w, log h).
    - `miss`: the floor, against 1 at the middle of a detection.

    Raises `ValueError` for a deviation or a floor that is not positive. Use it where the camera
    stands still and a detector tells where something is, but not who.
    """

    colour: ColourModel
    deviations: Float[Array, "4"] = eqx.field(
        converter=jnp.asarray, default_factory=lambda: jnp.array([0.2, 0.1, 0.2, 0.15])
    )
    miss: Float[Array, ""] = eqx.field(converter=jnp.asarray, default=0.02)

    def __check_init__(self) -> None:
        require_positive(deviations=self.deviations, miss=self.miss)

    def sample_initial(self, key: Key[Array, ""], num_particles: int) -> BoxState:
        """x_0 of the colour model."""
        return self.colour.sample_initial(key, num_particles)

    def sample_transition(self, key: Key[Array, ""], states: BoxState) -> BoxState:
        """x_t of the colour model."""
        return self.colour.sample_transition(key, states)

    def log_transition(self, states: BoxState, previous_states: BoxState) -> Float[Array, " n"]:
        """log D of the colour model."""
        return self.colour.log_transition(states, previous_states)

    def log_likelihood(self, observation: DetectedFrame, states: BoxState) -> Float[Array, " n"]:
        """log L_colour + log(miss + Σ_d ...)."""
        log_colour = self.colour.log_likelihood(observation.frame, states)
        return log_colour + self._log_detected(observation.detections, self.colour.boxes(states))

    def _log_detected(
        self, detections: Detections, boxes: Float[Array, "n 4"]
    ) -> Float[Array, " n"]:
        # A box that shrank to nothing is seen by no detector, and must not become a NaN.
        size = jnp.maximum(boxes[:, None, 2:], 1e-3)
        offset = (detections.boxes[None, :, :2] - boxes[:, None, :2]) / size
        growth = jnp.log(jnp.maximum(detections.boxes[None, :, 2:], 1e-3) / size)
        gaps = jnp.concatenate([offset, growth], axis=2) / self.deviations[None, None]
        nearness = jnp.exp(-0.5 * jnp.sum(gaps**2, axis=2))
        return jnp.log(self.miss + jnp.sum(nearness * detections.valid[None], axis=1))
