"""Objects in contact: one detection may stand for an object and for those that it hides."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, Key

from mpfjax.checks import check_share, check_whole
from mpfjax.mixture import ParticleMixture
from mpfjax.moves.base import AbstractMove
from mpfjax.operations.indexing import take
from mpfjax.vision.tracking.memory import (
    ASSIGNED,
    HIDDEN,
    LIVES,
    SHARED,
    Lives,
    noises_of,
    remember,
    shared_detections,
)
from mpfjax.vision.tracking.model import DetectedObjectModel, boxes_of
from mpfjax.vision.tracking.observation import TrackedFrame, covered


class ShareDetections(AbstractMove):
    """Let a component that is hidden by another one share the other's detection.

    A detector often finds only one of two objects in contact, or both as one, because it keeps one
    of the boxes that overlap. A confirmed component without a detection is therefore treated as
    hidden, and not as unseen, where the detection of another confirmed component covers more than
    the share `cover` of its predicted box. While it is hidden it stays alive and is shown. The
    detection tells it roughly where it is, and nothing of its size or colours; the other component
    follows the detection with a larger error (`PropagateObjects`, `LearnAppearance`). When both are
    detected again, motion and colours decide which detection belongs to which (`Assign`).

    - `longest`: after this many hidden frames in a row a component counts as unseen.
    - `recent`: a component that has been unseen for more frames than this cannot become hidden.

    The particles do not change. Memory: the index of the detection that each component shares, -1
    for none, and for how many frames it has been hidden. Whether a component is hidden is decided
    and not summed over (`approximate` is true). Raises `ValueError` for a share outside [0, 1] and
    for numbers of frames that are not whole, or below 1 and 0.
    """

    model: DetectedObjectModel
    cover: float = eqx.field(static=True, default=0.7)
    longest: int = eqx.field(static=True, default=7)
    recent: int = eqx.field(static=True, default=3)

    def __check_init__(self) -> None:
        check_share(cover=self.cover)
        check_whole(longest=self.longest)
        check_whole(0, recent=self.recent)

    @property
    def reads(self) -> frozenset[str]:
        """The memory that it needs of other moves."""
        return frozenset({ASSIGNED, LIVES})

    @property
    def approximate(self) -> bool:
        """True: a component that is probably hidden is taken for hidden."""
        return True

    def initial_memory(self, num_components: int) -> dict[str, Array]:
        """No component is hidden."""
        return {
            SHARED: jnp.full(num_components, -1, jnp.int32),
            HIDDEN: jnp.zeros(num_components, jnp.int32),
        }

    def forget(self, memory: dict, dead: Bool[Array, " m"]) -> dict:
        """Dead components are not hidden."""
        return memory | {
            SHARED: jnp.where(dead, -1, memory[SHARED]),
            HIDDEN: jnp.where(dead, 0, memory[HIDDEN]),
        }

    def __call__(
        self, key: Key[Array, ""], mixture: ParticleMixture, observation: TrackedFrame
    ) -> ParticleMixture:
        """Decide which components are hidden, and by which detections."""
        del key
        source, lives = mixture.memory[ASSIGNED], mixture.memory[LIVES]
        detected = source >= 0
        moved = self.model.predicted(mixture.particles, noises_of(mixture, self.model))
        predicted = boxes_of(mixture.component_averages(moved.place))
        own = take(observation.detections.boxes, jnp.maximum(source, 0))
        hides = (lives.confirmed & detected)[None] & ~jnp.eye(len(source), dtype=bool)
        shares = jnp.where(hides, covered(predicted, own), 0.0)
        hidden = self._missed(lives, detected) & (jnp.max(shares, axis=1) > self.cover)
        frames = jnp.where(detected, 0, mixture.memory[HIDDEN] + hidden.astype(jnp.int32))
        hidden &= frames <= self.longest
        front = take(source, jnp.argmax(shares, axis=1).astype(jnp.int32))
        return remember(mixture, shared=jnp.where(hidden, front, -1), hidden=frames)

    def _missed(self, lives: Lives, detected: Bool[Array, " m"]) -> Bool[Array, " m"]:
        """Components without a detection now that had one lately."""
        return lives.alive & lives.confirmed & ~detected & (lives.unseen <= self.recent)


def in_front(mixture: ParticleMixture) -> Bool[Array, " m"]:
    """Components whose detection is shared by another."""
    source: Int[Array, " m"] = mixture.memory[ASSIGNED]
    same = shared_detections(mixture)[None] == source[:, None]
    return (source >= 0) & jnp.any(same, axis=1)
