"""A tracker that starts and ends its components by itself, from detections: a chain of moves."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key, PyTree, UInt8

from mpfjax.checks import check_flag, check_positive, check_type, check_whole, given
from mpfjax.mixture import ParticleMixture
from mpfjax.moves.base import AbstractMove, AbstractRejuvenation
from mpfjax.moves.gaussian import GaussianRegeneration
from mpfjax.operations import default_float
from mpfjax.vision.colours import AbstractColours, HSVColours
from mpfjax.vision.detections import Detections
from mpfjax.vision.histograms import integral_histogram
from mpfjax.vision.sampled_histograms import SampledHistogram
from mpfjax.vision.tracking.assignment import Assign
from mpfjax.vision.tracking.births import Found, ShareMass
from mpfjax.vision.tracking.colours import LearnColours
from mpfjax.vision.tracking.deaths import Bury
from mpfjax.vision.tracking.memory import LIVES, Lives, mean_boxes
from mpfjax.vision.tracking.model import DetectedObjectModel, ObjectState, Pixels
from mpfjax.vision.tracking.motion import PropagateObjects
from mpfjax.vision.tracking.observation import TrackedFrame
from mpfjax.vision.tracking.scores import RankScores

# In 16 bits a box of this size is counted exactly.
_LARGEST_NARROW = 2**16


class Tracks(NamedTuple):
    """What a tracker says of one frame, a row for each of its M components.

    - `boxes`: (m, 4), the mean box of each, centre and size in pixels.
    - `identities`: (m,), a number that an object keeps for life, 0 for a dead component.
    - `confirmed`: (m,), whether detections have borne it out often enough to be believed.
    - `unseen`: (m,), for how many frames none has.
    - `full`: whether a detection that would have founded a component found no room.
    """

    boxes: Float[Array, "m 4"]
    identities: Int[Array, " m"]
    confirmed: Bool[Array, " m"]
    unseen: Int[Array, " m"]
    full: Bool[Array, ""]

    @property
    def corner_boxes(self) -> Float[Array, "m 4"]:
        """The boxes (x, y, w, h) with (x, y) the top-left corner, as files have them."""
        return jnp.concatenate([self.boxes[:, :2] - self.boxes[:, 2:] / 2, self.boxes[:, 2:]], 1)


class ObjectTracker(eqx.Module):
    """PLACEHOLDER"""

    moves: tuple[AbstractMove, ...]
    colours: AbstractColours
    max_objects: int = eqx.field(static=True)
    particles_per_object: int = eqx.field(static=True)
    exact_colours: bool = eqx.field(static=True)

    def __init__(
        self,
        max_objects: int = 24,
        particles_per_object: int = 50,
        *,
        frames_per_second: float = 25.0,
        rejuvenation: AbstractRejuvenation | None = None,
        colours: AbstractColours | None = None,
        exact_colours: bool = False,
        sigma: float | None = None,
        strong_score: float | None = None,
        weak_score: float | None = None,
        S: dict | None = None,
    ) -> None:
        check_whole(max_objects=max_objects, particles_per_object=particles_per_object)
        check_positive(frames_per_second=frames_per_second)
        check_flag(exact_colours=exact_colours)
        colours = HSVColours(8, 4, 6) if colours is None else colours
        check_type(AbstractColours, "AbstractColours such as HSVColours()", colours=colours)
        if rejuvenation is None:
            rejuvenation = GaussianRegeneration(particles_per_object, where=_motion)
        _check_rejuvenation(rejuvenation, particles_per_object)
        S = S or {}
        g = S.get
        model = DetectedObjectModel(
            position_noise=jnp.array([g("qx", 0.03), g("qy", 0.015)]),
            velocity_noise=jnp.array([g("qv", 0.03), g("qvy", 0.015)]),
            size_noise=jnp.array([g("qs", 0.03), g("qsh", 0.015)]),
            detection_deviations=jnp.array(
                [g("rx", 0.2), g("ry", 0.1), g("rw", 0.2), g("rh", 0.12)]
            ),
            miss=g("miss", 0.01), weak_error=g("Rweak",1.75),
            sigma=sigma,
        )
        confirmation, patience = g("conf", 3), g("patience", 25)
        self.moves = (
            RankScores(g("hi", 0.5), g("lo", 0.2), strong_score, weak_score),
            Assign(
                model, g("gate", 25.0), g("colour", 12.0), g("weakpen", 5.0), g("newcost", 3.0),
                confirmation,
            ),
            rejuvenation,
            PropagateObjects(model),
            Bury(confirmation, patience),
            Found(model, particles_per_object, g("birth_iou", 0.4)),
            LearnColours(colours, 3, g("adapt", 0.1), g("contact", 0.2)),
            ShareMass(),
        )
        self.colours = colours
        self.max_objects = max_objects
        self.particles_per_object = particles_per_object
        self.exact_colours = exact_colours

    def init(self) -> ParticleMixture:
        """Nothing tracked yet: every component dead, every slot empty."""
        m, n = self.max_objects, self.max_objects * self.particles_per_object
        memory = {}
        for move in self.moves:
            memory |= move.initial_memory(m)
        return ParticleMixture(
            particles=ObjectState(
                jnp.zeros((n, 4)), jnp.zeros((n, 2)), jnp.zeros(n, jnp.int32)
            ),
            log_weights=jnp.full(n, -jnp.inf, default_float()),
            component_indicators=jnp.zeros(n, jnp.int32),
            ancestor_indices=jnp.arange(n, dtype=jnp.int32),
            num_components=m,
            memory=memory,
        )

    @eqx.filter_jit
    def step(
        self,
        key: Key[Array, ""],
        state: ParticleMixture,
        frame: UInt8[Array, "h w 3"] | None,
        detections: Detections,
    ) -> tuple[ParticleMixture, Tracks]:
        """The state after a frame and its detections, and what is tracked in it."""
        seen = TrackedFrame(detections, self._pixels(frame))
        for move_key, move in zip(jax.random.split(key, len(self.moves)), self.moves, strict=True):
            state = move(move_key, state, seen)
            state = self._forgetting(state)
        lives = state.memory[LIVES]
        confirmed = lives.alive & (lives.seen >= 3)
        return state, Tracks(
            mean_boxes(state), lives.identities, confirmed, lives.unseen, jnp.array(False)
        )

    def _pixels(self, frame: UInt8[Array, "h w 3"] | None) -> Pixels | None:
        if frame is None:
            return None
        if self.exact_colours:
            return integral_histogram(frame, self.colours, True)
        return SampledHistogram(frame, self.colours)

    def _forgetting(self, mixture: ParticleMixture) -> ParticleMixture:
        """The mixture, whose moves know nothing of components that have died."""
        memory, dead = mixture.memory, ~mixture.active
        for move in self.moves:
            memory = move.forget(memory, dead)
        return mixture.replace(memory=memory)


def _check_rejuvenation(rejuvenation: AbstractRejuvenation, particles_per_object: int) -> None:
    check_type(AbstractRejuvenation, "a rejuvenating move", rejuvenation=rejuvenation)
    number = getattr(rejuvenation, "particles_per_component", None)
    # Another number would leave no empty slots for the newborn.
    if number != particles_per_object:
        raise ValueError(
            f"rejuvenation: its particles_per_component, {number}, is not particles_per_object,"
            f" {particles_per_object}"
        )
    if isinstance(rejuvenation, GaussianRegeneration) and rejuvenation.where is None:
        raise ValueError(
            "rejuvenation: where is None, but which object a particle is of is no Gaussian"
        )


def _motion(states: ObjectState) -> tuple[PyTree, PyTree]:
    return states.place, states.velocity
