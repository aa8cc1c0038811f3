"""Whether what appears beside an object is another object or a double of it, learned online."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Key

from mpfjax.checks import check_share
from mpfjax.mixture import ParticleMixture
from mpfjax.moves.base import AbstractMove
from mpfjax.operations.floats import default_float
from mpfjax.operations.indexing import take
from mpfjax.vision.tracking.fates import KEPT, PRIOR
from mpfjax.vision.tracking.memory import (
    ASSIGNED,
    DOUBLES,
    LIVES,
    Doubles,
    Lives,
    mean_boxes,
    remember,
)
from mpfjax.vision.tracking.observation import TrackedFrame, overlap


class LearnDoubles(AbstractMove):
    """Learn whether components that appear beside an object are objects or doubles of it.

    A detector that gives two boxes for one object starts a second component, a double, and the two
    then take each other's detections. Where people walk in groups, the second one is a person. Only
    the recording tells which is the case. A new component has a host if its box overlaps that of an
    older component by more than `beside` (intersection over union): the older one that it overlaps
    most. It proves to be an object once they overlap by less in a frame in which both have a
    detection. It was a double if it ends before, while its host lives. If the host ends first,
    nothing is known. With r of the former and w of the latter, what appears beside an object
    is another object with probability

        (r + n / 2) / (r + w + n),  n = 5

    Counts lose four tenths in a hundred frames. While this probability is below `least`, a
    component that has a host is not shown, and `Assign` gives it a detection only from what all
    others leave. It goes on so that its fate can be counted.

    It follows `Births` and changes only its memory, `Doubles`, and who is shown. Use it with any
    detector. Raises `ValueError` for shares outside [0, 1].
    """

    beside: float = eqx.field(static=True, default=0.15)
    least: float = eqx.field(static=True, default=1 / 3)

    def __check_init__(self) -> None:
        check_share(beside=self.beside, least=self.least)

    @property
    def reads(self) -> frozenset[str]:
        """The memory that it needs of other moves."""
        return frozenset({ASSIGNED, LIVES})

    def initial_memory(self, num_components: int) -> dict[str, Doubles]:
        """No component has a host."""
        none = jnp.zeros(num_components, jnp.int32)
        zero = jnp.zeros((), default_float())
        return {DOUBLES: Doubles(none, none, zero, zero, none > 0)}

    def __call__(
        self, key: Key[Array, ""], mixture: ParticleMixture, observation: TrackedFrame
    ) -> ParticleMixture:
        """Count what this frame decides, and give new components their hosts."""
        del key, observation
        lives: Lives = mixture.memory[LIVES]
        before: Doubles = mixture.memory[DOUBLES]
        boxes, identities = mean_boxes(mixture), lives.identities
        overlaps = overlap(boxes, boxes)
        goes_on = lives.alive & (before.owners == identities)
        hosted = before.hosts > 0

        pairs = (before.hosts[:, None] == identities[None]) & lives.alive[None]
        host_lives = jnp.any(pairs, axis=1)
        detected = mixture.memory[ASSIGNED] >= 0
        parted = pairs & (overlaps < self.beside) & detected[:, None] & detected[None]
        proved = hosted & goes_on & jnp.any(parted, axis=1)
        ended = hosted & ~goes_on & host_lives

        older = lives.alive[None] & (identities[None] < identities[:, None])
        shares = jnp.where(older, overlaps, 0.0)
        nearest = take(identities, jnp.argmax(shares, axis=1).astype(jnp.int32))
        begun = jnp.where(jnp.max(shares, axis=1) > self.beside, nearest, 0)
        kept = jnp.where(host_lives & ~proved, before.hosts, 0)
        hosts = jnp.where(lives.alive, jnp.where(goes_on, kept, begun), 0)

        objects = KEPT * before.objects + jnp.sum(proved, dtype=before.objects.dtype)
        doubles = KEPT * before.doubles + jnp.sum(ended, dtype=before.doubles.dtype)
        probability = (objects + PRIOR / 2) / (objects + doubles + PRIOR)
        doubtful = (hosts > 0) & (probability < self.least)
        return remember(
            mixture,
            lives=lives._replace(shown=lives.shown & ~doubtful),
            doubles=Doubles(hosts, identities, objects, doubles, doubtful),
        )
