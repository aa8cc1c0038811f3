"""The colours that each object is known by, learned while it stands alone."""

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
from mpfjax.vision.tracking.occlusion import in_front


class LearnAppearance(AbstractMove):
    """Move each component's reference histogram towards what its detection shows now.

    h_ref <- (1 - adaptation) h_ref + adaptation h(d), in frames in which a detection bears the
    component out and no other component overlaps its box by more than `contact` (intersection over
    union) or shares that detection: of two in contact, either would learn the other's colours. The
    first detection of a component gives it its reference. It leaves the particles as they are;
    memory: the references, (m, parts, channels, bins), all zero for a component that has none.

    The model changes with the data (`approximate` is true). Raises `ValueError` for shares outside
    [0, 1] and a number of parts that is no whole number from 1 on.
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
        """True: what is seen changes what is expected."""
        return True

    def initial_memory(self, num_components: int) -> dict[str, Array]:
        """Nobody has colours yet."""
        shape = (num_components, self.num_parts, self.colours.num_channels, self.colours.num_bins)
        return {REFERENCES: jnp.zeros(shape)}

    def forget(self, memory: dict, dead: Bool[Array, " m"]) -> dict:
        """The dead have none."""
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
        # What holds no pixel teaches nothing.
        alone &= ~in_front(mixture)
        teaches = (source >= 0) & jnp.any(seen > 0, axis=(1, 2, 3)) & (alone | ~known)
        rate = jnp.where(teaches, jnp.where(known, self.adaptation, 1.0), 0.0)
        rate = rate.astype(references.dtype)[:, None, None, None]
        return remember(mixture, references=(1 - rate) * references + rate * seen)
