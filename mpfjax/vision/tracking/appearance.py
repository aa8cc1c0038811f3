"""The colour histogram of each object, learned while the object stands alone."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Key

from mpfjax.checks import check_share, check_whole
from mpfjax.mixture import ParticleMixture
from mpfjax.moves.base import AbstractMove
from mpfjax.operations.indexing import take
from mpfjax.vision.colour.bins import AbstractColours
from mpfjax.vision.tracking.memory import ASSIGNED, LIVES, REFERENCES, mean_boxes, remember
from mpfjax.vision.tracking.observation import TrackedFrame, overlap


class LearnAppearance(AbstractMove):
    """Move each component's reference histogram towards the colours of its detection.

        h_ref <- (1 - adaptation) h_ref + adaptation h(d)

    A component learns in frames in which a detection d is assigned to it, no other component's box
    overlaps its own by more than `contact` (intersection over union), and it shares its detection
    with no other. Objects in contact would learn each other's colours. The first detection of a
    component sets its reference. The particles do not change. Memory: the references, (m, parts,
    channels, bins), all zero for a component that has none.

    The model changes with the data (`approximate` is true). Raises `ValueError` for shares outside
    [0, 1] and for a number of parts that is not a whole number from 1 on.
    """

    colours: AbstractColours
    num_parts: int = eqx.field(static=True, default=3)
    adaptation: float = eqx.field(static=True, default=0.14)
    contact: float = eqx.field(static=True, default=0.12)

    def __check_init__(self) -> None:
        check_whole(num_parts=self.num_parts)
        check_share(adaptation=self.adaptation, contact=self.contact)

    @property
    def reads(self) -> frozenset[str]:
        """The memory that it needs of other moves."""
        return frozenset({ASSIGNED, LIVES})

    @property
    def approximate(self) -> bool:
        """True: the references are learned from the same data that they explain."""
        return True

    def initial_memory(self, num_components: int) -> dict[str, Array]:
        """No component has a reference yet."""
        shape = (num_components, self.num_parts, self.colours.num_channels, self.colours.num_bins)
        return {REFERENCES: jnp.zeros(shape)}

    def forget(self, memory: dict, dead: Bool[Array, " m"]) -> dict:
        """Clear the references of dead components."""
        references = memory[REFERENCES]
        return memory | {REFERENCES: jnp.where(dead[:, None, None, None], 0.0, references)}

    def __call__(
        self, key: Key[Array, ""], mixture: ParticleMixture, observation: TrackedFrame
    ) -> ParticleMixture:
        """Learn from the detections of this frame."""
        del key
        if observation.pixels is None:
            return mixture
        references = mixture.memory[REFERENCES]
        source = mixture.memory[ASSIGNED]
        seen = take(observation.detected_colours(self.num_parts), jnp.maximum(source, 0))
        boxes, alive = mean_boxes(mixture), mixture.memory[LIVES].alive
        others = alive[None] & ~jnp.eye(len(boxes), dtype=bool)
        alone = ~jnp.any((overlap(boxes, boxes) > self.contact) & others, axis=1)
        known = jnp.any(references > 0, axis=(1, 2, 3))
        # A detection that holds no pixel has no colours to learn.
        teaches = (source >= 0) & jnp.any(seen > 0, axis=(1, 2, 3)) & (alone | ~known)
        rate = jnp.where(teaches, jnp.where(known, self.adaptation, 1.0), 0.0)
        rate = rate.astype(references.dtype)[:, None, None, None]
        return remember(mixture, references=(1 - rate) * references + rate * seen)
