"""Colour and detections together: what a detector says of a box, as a likelihood."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key, UInt8

from mpfjax.checks import (
    check_positive_array,
    check_share,
    check_type,
    check_whole,
    shown,
    to_array,
    to_rows,
)
from mpfjax.models.base import AbstractStateSpaceModel
from mpfjax.operations.generator import fast_key
from mpfjax.operations.indexing import take
from mpfjax.proposals import AbstractProposal
from mpfjax.vision.boxes import centred
from mpfjax.vision.colour_model import BoxState, ColourModel
from mpfjax.vision.histograms import IntegralHistogram


class Detections(eqx.Module):
    """The boxes that a detector found in one frame, padded to a fixed number.

    - `boxes`: (d, 4), centre and size in pixels.
    - `valid`: (d,), which rows are detections.
    - `scores`: (d,), how sure the detector was of each, on any scale, higher for surer.
    """

    boxes: Float[Array, "d 4"]
    valid: Bool[Array, " d"]
    scores: Float[Array, " d"]

    @classmethod
    def from_boxes(
        cls,
        boxes: Float[np.ndarray, "k 4"],
        max_detections: int,
        scores: Float[np.ndarray, " k"] | None = None,
    ) -> "Detections":
        """Boxes (x, y, w, h), top-left corner first, and a score for each, all equal where None.

        Of too many, the strongest are kept, and of equally strong ones the largest. They may leave
        the frame in part or as a whole. Raises `ValueError` for boxes that are not four finite
        numbers each, or without area, for scores that are not one finite number for each box, and
        for room for less than one.
        """
        check_whole(max_detections=max_detections)
        rows = to_rows(4, "boxes", boxes).astype(np.float32)
        # One box alone is more likely a slip than meant.
        if len(rows) > 0 and np.ndim(boxes) != 2:
            raise ValueError(f"boxes: shape {np.shape(boxes)} is not (k, 4), of boxes x,y,w,h")
        boxes = rows
        for box in boxes:
            if not (np.isfinite(box).all() and (box[2:] > 0).all()):
                raise ValueError(f"boxes: {box.tolist()} has no area, or is not finite")
        strengths = _checked_scores(scores, len(boxes))
        strongest = np.lexsort((-boxes[:, 2] * boxes[:, 3], -strengths))[:max_detections]
        padded = np.ones((max_detections, 4), np.float32)
        padded[: len(strongest)] = centred(boxes[strongest])
        padded_scores = np.zeros(max_detections, np.float32)
        padded_scores[: len(strongest)] = strengths[strongest]
        valid = np.arange(max_detections) < len(strongest)
        return cls(jnp.asarray(padded), jnp.asarray(valid), jnp.asarray(padded_scores))


class DetectedFrame(eqx.Module):
    """A frame and what was detected in it: the observation of a `DetectedColourModel`.

    `detections` has a row for each of the model's references: the detection that is taken for it.
    Where `frame` is None there are no pixels, and the detections speak alone.
    """

    frame: IntegralHistogram | UInt8[Array, "h w 3"] | None
    detections: Detections


class DetectedColourModel(AbstractStateSpaceModel):
    """A `ColourModel` whose boxes are seen by a detector as well.

    L(y | x) = L_colour(y | x) (miss + exp(-½ |(d_r - x) / deviations|²)), with d_r the detection
    that is taken for the box's reference r, and differences in (x, y, log w, log h), the first
    two in units of the box: two cues that are taken for independent, as by Pérez, Vermaak and
    Blake (2004), the second a Gaussian over a floor, for a detection of something else. Where
    there is no d_r, colour alone speaks.

    - `colour`: the model of the boxes' motion and colours.
    - `deviations`: of a detection from the box that it sees, (x, y, log w, log h).
    - `miss`: the floor, against 1 where detection and box agree.

    Raises `ValueError` for a deviation or a floor that is not positive. Use it where a detector
    tells where something is, but not who.
    """

    colour: ColourModel
    deviations: Float[Array, "4"] = eqx.field(
        converter=to_array("deviations"), default_factory=lambda: jnp.array([0.2, 0.1, 0.25, 0.15])
    )
    miss: Float[Array, ""] = eqx.field(converter=to_array("miss"), default=0.02)

    def __check_init__(self) -> None:
        check_type(ColourModel, "a ColourModel", colour=self.colour)
        if self.deviations.shape != (4,):
            raise ValueError(f"deviations: {self.deviations} are not four numbers")
        if self.miss.shape != ():
            raise ValueError(f"miss: {self.miss} is not one number")
        check_positive_array(deviations=self.deviations, miss=self.miss)

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
        """log L_colour + log(miss + exp(-½ ...)), without L_colour where there are no pixels."""
        own = take(observation.detections.boxes, states.reference)
        gaps = box_differences(own, self.colour.boxes(states)) / self.deviations[None]
        nearness = jnp.exp(-0.5 * jnp.sum(gaps**2, axis=1))
        detected = take(observation.detections.valid, states.reference)
        log_detected = jnp.log(self.miss + jnp.where(detected, nearness, 0.0))
        if observation.frame is None:
            return log_detected
        return self.colour.log_likelihood(observation.frame, states) + log_detected


class DetectionProposal(AbstractProposal):
    """Draw boxes from where dynamics and detection agree, as well as from the dynamics alone.

    q(x_t | x_{t-1}, y_t) = share N(x_t; μ, s²) + (1 - share) D(x_t | x_{t-1}), with N(μ, s²) the
    product of the Gaussians of the detection and of the prediction, coordinate by coordinate in
    (x, y, s_x, s_y), both weighed by their precision: a mixture like that of the boosted particle
    filter (Okuma et al. 2004, section 4.2), drawn as narrow as its target. Where the model's
    references switch, they do so as in D. The weights L D / q are exact. Where a reference has no
    detection q is D.

    Raises `ValueError` for a share outside [0, 1). Use it with few particles, which the dynamics
    alone would seldom put on a detection.
    """

    model: DetectedColourModel
    share: float = eqx.field(static=True, default=0.8)

    def __check_init__(self) -> None:
        check_type(DetectedColourModel, "a DetectedColourModel", model=self.model)
        check_share(share=self.share)
        if self.share == 1:
            raise ValueError("share: 1 leaves nothing to the dynamics; it has to be in [0, 1)")

    def propose(
        self, key: Key[Array, ""], observation: DetectedFrame, previous_states: BoxState
    ) -> tuple[BoxState, Float[Array, " n"]]:
        """x_t from the mixture, and its log density."""
        key_moved, key_noise, key_which = jax.random.split(fast_key(key), 3)
        moved = self.model.sample_transition(key_moved, previous_states)
        mean, deviations = self._agreement(observation.detections, previous_states)
        noise = jax.random.normal(key_noise, mean.shape, mean.dtype)
        detected = take(observation.detections.valid, previous_states.reference)
        share = jnp.where(detected, self.share, 0.0)
        from_agreement = jax.random.uniform(key_which, share.shape) < share
        box = jnp.where(from_agreement[:, None], mean + deviations * noise, moved.box)
        states = BoxState(box, moved.reference, moved.previous)
        log_agreement = jnp.sum(
            -0.5 * ((box - mean) / deviations) ** 2
            - jnp.log(deviations)
            - 0.5 * jnp.log(2 * jnp.pi),
            axis=1,
        )
        colour = self.model.colour
        log_dynamics = colour.dynamics_of(previous_states).log_density(
            box, previous_states.box, previous_states.previous
        )
        log_density = jnp.logaddexp(
            jnp.log(share) + log_agreement, jnp.log(1 - share) + log_dynamics
        )
        return states, log_density + colour.log_switch(states, previous_states)

    def _agreement(
        self, detections: Detections, previous: BoxState
    ) -> tuple[Float[Array, "n 4"], Float[Array, "n 4"]]:
        """Mean and deviation of the product of the detection's and the prediction's Gaussian."""
        colour = self.model.colour
        own = take(detections.boxes, previous.reference)
        size = take(colour.reference_boxes, previous.reference)[:, 2:]
        detected = jnp.concatenate([own[:, :2], own[:, 2:] / size], axis=1)
        # A small change of log w is that of w in shares of itself.
        unit = jnp.concatenate([own[:, 2:], detected[:, 2:]], axis=1)
        precision = 1 / (self.model.deviations[None] * unit) ** 2
        predicted, deviations = colour.dynamics_of(previous).moments(
            previous.box, previous.previous
        )
        prior = 1 / deviations**2
        total = precision + prior
        return (precision * detected + prior * predicted) / total, 1 / jnp.sqrt(total)


def _checked_scores(scores: Any, number: int) -> np.ndarray:
    """A finite score for each of so many boxes, all one where there are none given."""
    if scores is None:
        return np.ones(number, np.float32)
    try:
        values = np.asarray(scores, np.float32)
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"scores: {shown(scores)} are no numbers") from error
    if values.shape != (number,):
        raise ValueError(f"scores: shape {values.shape} is not that of one a box, ({number},)")
    if not np.isfinite(values).all():
        raise ValueError(f"scores: {shown(values)} are not all finite")
    return values


def box_differences(
    boxes: Float[Array, "*#n 4"], others: Float[Array, "*#n 4"]
) -> Float[Array, "*n 4"]:
    """How boxes differ from others: x and y in units of the others' size, and log w and log h."""
    # A box that shrank to nothing must not become a NaN.
    size = jnp.maximum(others[..., 2:], 1e-3)
    offset = (boxes[..., :2] - others[..., :2]) / size
    growth = jnp.log(jnp.maximum(boxes[..., 2:], 1e-3) / size)
    return jnp.concatenate([offset, growth], axis=-1)
