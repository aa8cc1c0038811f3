"""The memory of the tracker's moves: its fields, and the keys under which they are stored."""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mpfjax.mixture import ParticleMixture
from mpfjax.vision.tracking.model import DetectedObjectModel, Noises, boxes_of

SCORES, ASSIGNED, LIVES, REFERENCES = "scores", "assigned", "lives", "references"
DOUBTS = "doubts"
CAMERA, NOISES, RIVALS, FATES = "camera", "noises", "rivals", "fates"
GUESSES, DOUBLES = "guesses", "doubles"


class Scores(NamedTuple):
    """Memory of `RankScores`: recent scores, how many there were in all, and the thresholds."""

    recent: Float[Array, " k"]
    count: Int[Array, ""]
    weak: Float[Array, ""]
    strong: Float[Array, ""]


class Camera(NamedTuple):
    """Memory of `FollowCamera`: the shift in this frame, and the standard deviations of shifts.

    - `shift`: in pixels, beside the motion from pixels where that is known.
    - `deviations`: of all of the camera's motion; `left`: of what the pixels do not tell; in boxes.
    """

    shift: Float[Array, "2"]
    deviations: Float[Array, "2"]
    left: Float[Array, "2"]


class Lives(NamedTuple):
    """Memory of `Deaths` and `Births`: the identity of each component, and its counts of frames.

    - `identities`: 0 for a dead component; `last_identity`: the highest ever given.
    - `seen`: in how many frames it had a strong detection.
    - `unseen`, `unsure`: for how many frames it has had no detection, and no strong one.
    - `confirmed`: whether it has had enough detections.
    - `shown`: whether it should be shown.
    - `full`: whether there was no room for a new component in the last frame.
    - `begun`: whether there was a frame before.
    """

    identities: Int[Array, " m"]
    last_identity: Int[Array, ""]
    seen: Int[Array, " m"]
    unseen: Int[Array, " m"]
    unsure: Int[Array, " m"]
    confirmed: Bool[Array, " m"]
    shown: Bool[Array, " m"]
    full: Bool[Array, ""]
    begun: Bool[Array, ""]

    @classmethod
    def none(cls, num_components: int) -> "Lives":
        """No component is alive yet."""
        none = jnp.zeros(num_components, jnp.int32)
        zero = jnp.zeros((), jnp.int32)
        return cls(none, zero, none, none, none, none > 0, none > 0, zero > 0, zero > 0)

    @property
    def alive(self) -> Bool[Array, " m"]:
        """Which components stand for an object."""
        return self.identities > 0


class Doubles(NamedTuple):
    """Memory of `LearnDoubles`.

    - `hosts`: the identity of the object beside which each component appeared, 0 for none and for a
      component that has been apart from it.
    - `owners`: the identity of each component in the last frame.
    - `objects`, `doubles`: how many proved to be objects, and how many to be doubles.
    - `doubtful`: which components are more probably doubles.
    """

    hosts: Int[Array, " m"]
    owners: Int[Array, " m"]
    objects: Float[Array, ""]
    doubles: Float[Array, ""]
    doubtful: Bool[Array, " m"]


def mean_boxes(mixture: ParticleMixture) -> Float[Array, "m 4"]:
    """The box of each component, centre and size in pixels: the mean place of its particles."""
    return boxes_of(mixture.component_averages(mixture.particles.place))


def assigned_detections(mixture: ParticleMixture) -> Int[Array, " m"]:
    """The index of the detection that each component took; -1 for all where no move assigns any."""
    none = jnp.full(mixture.num_components, -1, jnp.int32)
    return mixture.memory.get(ASSIGNED, none)


def noises_of(mixture: ParticleMixture, model: DetectedObjectModel) -> Noises:
    """The learned noises, or the model's own where no move learns any."""
    return mixture.memory.get(NOISES, model.noises)


def remember(mixture: ParticleMixture, **memory: Any) -> ParticleMixture:
    """The mixture with some of its memory changed."""
    return mixture.replace(memory=mixture.memory | memory)
