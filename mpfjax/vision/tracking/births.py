"""Births: a new component for every strong detection that no component explains."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from mpfjax.checks import check_share, check_type, check_whole
from mpfjax.mixture import ParticleMixture
from mpfjax.moves.base import AbstractMove
from mpfjax.operations.indexing import take
from mpfjax.operations.prefix_sums import few_upto
from mpfjax.vision.tracking.detections import Detections
from mpfjax.vision.tracking.memory import (
    ASSIGNED,
    LIVES,
    SCORES,
    Lives,
    mean_boxes,
    noises_of,
    remember,
)
from mpfjax.vision.tracking.model import (
    DetectedObjectModel,
    Gaussian,
    ObjectState,
    places_of,
    units,
)
from mpfjax.vision.tracking.observation import TrackedFrame, overlap, within


class Births(AbstractMove):
    """Start a component at each strong detection that has none, while there is room.

    The place of a new component has the detector's error as its standard deviation, and its
    velocity has mean zero. A detection starts no component if it is assigned to one, or if it
    overlaps the box of a living component, or a stronger unassigned detection, by more than
    `birth_overlap` (intersection over union): it is then a second detection of the same object.
    Components of the first frame are confirmed at once, because objects are there when a video
    starts. If there are more detections than there is room for, the strongest are chosen. Memory:
    `Lives`, together with `Deaths`, which initialises it; and the assignments, so that a component
    is assigned the detection that started it.

    - `particles_per_object`: P.

    Births are decided and not sampled (`approximate` is true). Raises `ValueError` for a share
    outside [0, 1].
    """

    model: DetectedObjectModel
    particles_per_object: int = eqx.field(static=True, default=50)
    birth_overlap: float = eqx.field(static=True, default=0.5)

    def __check_init__(self) -> None:
        check_type(DetectedObjectModel, "a DetectedObjectModel", model=self.model)
        check_whole(particles_per_object=self.particles_per_object)
        check_share(birth_overlap=self.birth_overlap)

    @property
    def reads(self) -> frozenset[str]:
        """The memory that it needs of other moves."""
        return frozenset({ASSIGNED, LIVES, SCORES})

    @property
    def approximate(self) -> bool:
        """True: a birth adds probability mass at a detection."""
        return True

    @property
    def keeps_parents(self) -> bool:
        """False: the particles of a new object come from none."""
        return False

    def founding(self, mixture: ParticleMixture, observation: TrackedFrame) -> Bool[Array, " d"]:
        """Which detections would start a component if there were room for all."""
        found, source = observation.detections, mixture.memory[ASSIGNED]
        lives: Lives = mixture.memory[LIVES]
        rows = jnp.where(source >= 0, source, len(found.valid))
        free = jnp.ones(len(found.valid), bool).at[rows].set(False, mode="drop")
        strong = found.valid & (found.scores >= mixture.memory[SCORES].strong)
        covered = overlap(mean_boxes(mixture), found.boxes) > self.birth_overlap
        wanted = free & strong & within(found.boxes, observation.extent)
        wanted &= ~jnp.any(covered & lives.alive[:, None], axis=0)
        # One that a stronger one covers is a double, even where the stronger one starts none.
        doubles = (overlap(found.boxes, found.boxes) > self.birth_overlap) & wanted[:, None]
        return wanted & ~jnp.any(doubles & stronger(found), axis=0)

    def __call__(
        self, key: Key[Array, ""], mixture: ParticleMixture, observation: TrackedFrame
    ) -> ParticleMixture:
        """Start components, and give them identities."""
        del key
        found, lives = observation.detections, mixture.memory[LIVES]
        founding = self.founding(mixture, observation)
        source, born = matched(founding, found, ~lives.alive)
        seats, filled = self._seats(mixture, born)
        drawn = self._started(mixture, seats, take(found.boxes, source))
        particles = jax.tree.map(
            lambda new, old: jnp.where(filled.reshape(-1, *[1] * (new.ndim - 1)), new, old),
            drawn,
            mixture.particles,
        )
        # Weights within a component; `ShareMass` sets the mixture weights.
        log_share = -jnp.log(jnp.asarray(self.particles_per_object, mixture.log_weights.dtype))
        mixture = mixture.replace(
            particles=particles,
            log_weights=jnp.where(filled, log_share, mixture.log_weights),
            component_indicators=jnp.where(filled, seats, mixture.component_indicators),
            ancestor_indices=jnp.where(filled, -1, mixture.ancestor_indices),
        )
        number = few_upto(born)
        at_the_start = born & ~lives.begun
        lives = lives._replace(
            identities=jnp.where(born, lives.last_identity + number, lives.identities),
            last_identity=lives.last_identity + number[-1],
            seen=jnp.where(born, 1, lives.seen),
            unseen=jnp.where(born, 0, lives.unseen),
            unsure=jnp.where(born, 0, lives.unsure),
            confirmed=lives.confirmed | at_the_start,
            shown=lives.shown | at_the_start,
            full=jnp.sum(founding, dtype=jnp.int32) > number[-1],
            begun=jnp.ones_like(lives.begun),
        )
        assigned = jnp.where(born, source, mixture.memory[ASSIGNED])
        return remember(mixture, lives=lives, assigned=assigned)

    def _started(
        self, mixture: ParticleMixture, seats: Int[Array, " n"], boxes: Float[Array, "m 4"]
    ) -> ObjectState:
        """Hypotheses for every slot, about the detection that started its component."""
        places = places_of(boxes)
        unit, still = units(places), jnp.zeros_like(places)
        noises = noises_of(mixture, self.model)
        errors, speeds = unit * noises.errors[None], unit * noises.start_velocity[None]
        moments = Gaussian(places, still, errors**2, still, speeds**2)
        return ObjectState.of(Gaussian(*(take(moment, seats) for moment in moments)), seats)

    def _seats(
        self, mixture: ParticleMixture, born: Bool[Array, " m"]
    ) -> tuple[Int[Array, " n"], Bool[Array, " n"]]:
        """Deal empty slots to new components, P each.

        Returns the component of every slot, and whether the slot is one of a new component.
        """
        empty = ~mixture.occupied
        number = (few_upto(empty) - 1) // self.particles_per_object
        order = jnp.argsort(~born, stable=True).astype(jnp.int32)  # new components first
        filled = empty & (number < jnp.sum(born, dtype=jnp.int32))
        return take(order, jnp.clip(number, 0, len(born) - 1)), filled


class ShareMass(AbstractMove):
    """Give every living component the same mixture weight.

    Components stand for objects that all exist, and are not rival hypotheses: the prior reassembly
    of Smith and Gatica-Pérez (2004). The likelihood of one object relative to another is dropped
    (`approximate` is true).
    """

    @property
    def approximate(self) -> bool:
        """True: the mixture weights that follow from the likelihood are replaced."""
        return True

    def __call__(
        self, key: Key[Array, ""], mixture: ParticleMixture, observation: TrackedFrame
    ) -> ParticleMixture:
        """Set all mixture weights to the same value."""
        del key, observation
        number = jnp.maximum(jnp.sum(mixture.active), 1).astype(mixture.log_weights.dtype)
        log_weights = mixture.log_component_weights - jnp.log(number)
        return mixture.replace(log_weights=log_weights, log_scale=jnp.zeros(()))


def _ranks(found: Detections) -> Int[Array, " d"]:
    """The rank of each detection: the strongest first, and of equally strong ones the largest."""
    areas = jnp.prod(found.boxes[:, 2:], axis=1)
    order = jnp.lexsort((-areas, -found.scores)).astype(jnp.int32)
    return jnp.zeros_like(order).at[order].set(jnp.arange(len(order), dtype=jnp.int32))


def stronger(found: Detections) -> Bool[Array, "d d"]:
    """Whether the first of a pair is the stronger one."""
    ranks = _ranks(found)
    return ranks[:, None] < ranks[None]


def matched(
    wanted: Bool[Array, " d"], found: Detections, free: Bool[Array, " m"]
) -> tuple[Int[Array, " m"], Bool[Array, " m"]]:
    """The index of the wanted row that each free place takes, strongest first, and whether any."""
    ranks = jnp.where(wanted, _ranks(found), len(wanted))
    rows = jnp.argsort(ranks, stable=True).astype(jnp.int32)
    rank = few_upto(free) - 1
    taken = free & (rank < jnp.sum(wanted, dtype=jnp.int32))
    return take(rows, jnp.clip(rank, 0, len(wanted) - 1)), taken
