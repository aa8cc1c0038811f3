"""A tracker that starts and ends its components by itself, from detections."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key, PyTree, UInt8
from optax.assignment import hungarian_algorithm

from mpfjax.checks import check_flag, check_positive, check_share, check_type, check_whole, shown
from mpfjax.filter import Filter
from mpfjax.mixture import ParticleMixture
from mpfjax.models.dynamics import Autoregression
from mpfjax.moves.base import AbstractRejuvenation
from mpfjax.moves.gaussian import GaussianRegeneration
from mpfjax.moves.propagation import Propagate
from mpfjax.operations.floats import default_float
from mpfjax.operations.generator import fast_key
from mpfjax.operations.indexing import take
from mpfjax.vision.colour_model import BoxState, ColourModel
from mpfjax.vision.colours import AbstractColours, HSVColours
from mpfjax.vision.detected_model import (
    DetectedColourModel,
    DetectedFrame,
    DetectionProposal,
    Detections,
    box_differences,
)
from mpfjax.vision.histograms import (
    IntegralHistogram,
    bhattacharyya,
    integral_histogram,
    normalise,
)

# How far a detection may lie from the box that it is taken for: (x, y, log w, log h).
GATE = (1.2, 0.5, 1.2, 0.8)
COLOUR_COST, IMPOSSIBLE = 1.0, 1e3


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


class TrackerState(eqx.Module):
    """All that a tracker carries from frame to frame; its shapes never change.

    - `colour`: the colour model, with a reference box for each of the M components.
    - `mixture`: the particles, M P slots.
    - `identities`: (m,), 0 for a dead component; `last_identity`: the highest so far.
    - `seen`, `unseen`: (m,), how many frames detections bore the component out, and for how many
      they have not since.
    - `crowded`: (m,), for how many frames it has covered an older component.
    """

    colour: ColourModel
    mixture: ParticleMixture
    identities: Int[Array, " m"]
    last_identity: Int[Array, ""]
    seen: Int[Array, " m"]
    unseen: Int[Array, " m"]
    crowded: Int[Array, " m"]


class ObjectTracker(eqx.Module):
    """A mixture particle filter with a component for each object, born and ended by detections.

    A step is that of the GM-MPF (Lin et al. 2012, section 4) with `DetectedColourModel`: redraw
    each component, propagate, weigh. Around it: a detection that no component covers founds one,
    with the detection's own colours as its reference; a component that no detection has borne out
    for `patience` frames, or that has left the frame, dies; and of two that cover each other for
    `crowding` frames the younger does. Every component keeps the same mass, as in the prior
    reassembly of Smith and Gatica-Pérez (2004): components are objects that all exist here, not
    rival hypotheses. All of this is outside the exact recursion. Use it to track an unknown and
    changing number of objects before a camera that stands still.

    - `max_objects`: M; `particles_per_object`: P.
    - `rejuvenation`: `Resample(particles_per_component=P)` for an MPF, or
      `GaussianRegeneration(P, where=lambda states: (states.box, states.previous))`, the default.
    - `colours`, `sigma`, `num_parts`, `wide_counts`: of the `ColourModel`. Objects of 65 536 pixels
      or more need the last; without it they have no colours, and nothing of them is learned.
    - `momentum`: the share of a box centre's last step that it repeats in the next, in [0, 1]: 1 is
      constant velocity, 0 a random walk. Sizes have none.
    - `step_deviations`: of the noise of a step, (x, y) in units of the box and (s_x, s_y).
    - `detection_deviations`: of a detection from the box that it sees, (x, y) in units of the box
      and (log w, log h), as in `DetectedColourModel`.
    - `confirmation`: in how many frames detections must bear a component out before it is
      believed; until then it dies at the first frame in which they do not.
    - `patience`: for how many frames in a row a believed component may go without a detection; it
      dies in the next.
    - `crowding`: in which frame in a row of covering an older component the younger one dies.
    - `adaptation`: the share of a reference that is learned anew in each frame in which one
      detection, and no other component, bears it out, in [0, 1).
    - `frames_per_second`: of the video.

    Raises `ValueError` for a count that is not a whole number from 1 on, a deviation or σ that is
    not positive and finite, a share outside its range, and a rejuvenation that does not give every
    component P particles or would redraw the references.
    """

    rejuvenation: AbstractRejuvenation
    max_objects: int = eqx.field(static=True)
    particles_per_object: int = eqx.field(static=True)
    colours: AbstractColours
    sigma: float = eqx.field(static=True)
    momentum: float = eqx.field(static=True)
    num_parts: int = eqx.field(static=True)
    step_deviations: tuple[float, ...] = eqx.field(static=True)
    detection_deviations: tuple[float, ...] = eqx.field(static=True)
    confirmation: int = eqx.field(static=True)
    patience: int = eqx.field(static=True)
    crowding: int = eqx.field(static=True)
    adaptation: float = eqx.field(static=True)
    wide_counts: bool = eqx.field(static=True)
    frames_per_second: float = eqx.field(static=True)

    def __init__(
        self,
        max_objects: int = 24,
        particles_per_object: int = 50,
        *,
        rejuvenation: AbstractRejuvenation | None = None,
        colours: AbstractColours | None = None,
        sigma: float = 0.2,
        momentum: float = 1.0,
        num_parts: int = 3,
        step_deviations: tuple[float, float, float, float] = (0.08, 0.03, 0.02, 0.02),
        detection_deviations: tuple[float, float, float, float] = (0.2, 0.1, 0.25, 0.15),
        confirmation: int = 3,
        patience: int = 10,
        crowding: int = 8,
        adaptation: float = 0.05,
        wide_counts: bool = False,
        frames_per_second: float = 25.0,
    ) -> None:
        check_whole(
            max_objects=max_objects,
            particles_per_object=particles_per_object,
            num_parts=num_parts,
            confirmation=confirmation,
            patience=patience,
            crowding=crowding,
        )
        check_positive(sigma=sigma, frames_per_second=frames_per_second)
        check_share(momentum=momentum, adaptation=adaptation)
        if adaptation == 1:
            raise ValueError(f"adaptation: {adaptation} is not in [0, 1)")
        check_flag(wide_counts=wide_counts)
        colours = HSVColours() if colours is None else colours
        check_type(AbstractColours, "AbstractColours such as HSVColours()", colours=colours)
        if rejuvenation is None:
            rejuvenation = GaussianRegeneration(particles_per_object, where=_motion)
        _check_rejuvenation(rejuvenation, particles_per_object)
        self.rejuvenation = rejuvenation
        self.max_objects = max_objects
        self.particles_per_object = particles_per_object
        self.colours = colours
        self.sigma = sigma
        self.momentum = momentum
        self.num_parts = num_parts
        self.step_deviations = _four_positive("step_deviations", step_deviations)
        self.detection_deviations = _four_positive("detection_deviations", detection_deviations)
        self.confirmation = confirmation
        self.patience = patience
        self.crowding = crowding
        self.adaptation = adaptation
        self.wide_counts = wide_counts
        self.frames_per_second = frames_per_second

    def init(self) -> TrackerState:
        """Nothing tracked yet: every component dead, every slot empty."""
        m, n = self.max_objects, self.max_objects * self.particles_per_object
        shape = (m, self.num_parts, self.colours.num_channels, self.colours.num_bins)
        colour = ColourModel(
            reference_boxes=jnp.ones((m, 4)),
            references=jnp.zeros(shape),
            colour_weights=jnp.ones(shape),
            dynamics=self._dynamics(jnp.ones((m, 4))),
            initial_deviations=jnp.ones((m, 4)),
            sigma=jnp.asarray(self.sigma, float),
            colours=self.colours,
            wide_counts=self.wide_counts,
        )
        mixture = ParticleMixture(
            particles=BoxState(jnp.ones((n, 4)), jnp.zeros(n, jnp.int32), jnp.ones((n, 4))),
            log_weights=jnp.full(n, -jnp.inf, default_float()),
            component_indicators=jnp.zeros(n, jnp.int32),
            ancestor_indices=jnp.arange(n, dtype=jnp.int32),
            num_components=m,
        )
        none = jnp.zeros(m, jnp.int32)
        return TrackerState(colour, mixture, none, jnp.zeros((), jnp.int32), none, none, none)

    @eqx.filter_jit
    def step(
        self,
        key: Key[Array, ""],
        state: TrackerState,
        frame: UInt8[Array, "h w 3"] | None,
        detections: Detections,
    ) -> tuple[TrackerState, Tracks]:
        """The state after a frame and its detections, and what is tracked in it.

        Where `frame` is None detections are tracked alone, without colours. Frames may have any
        size, which should not change: each new one compiles anew, and boxes stay where they are in
        pixels. Raises `ValueError` for a frame that is not (h, w, 3) of type uint8.
        """
        key_filter, key_births = jax.random.split(key)
        table = None
        if frame is not None:
            table = integral_histogram(frame, self.colours, self.wide_counts)
        own, taken = self._assigned(state, detections, table)
        state = self._filtered(key_filter, state, DetectedFrame(table, own))
        boxes = _mean_boxes(state)
        state = self._bury(state, boxes, own, table)
        state = self._learn(state, boxes, own, table)
        unexplained = _replace(detections, valid=detections.valid & ~taken)
        state, full = self._bear(key_births, state, boxes, unexplained, table)
        confirmed = (state.identities > 0) & (state.seen >= self.confirmation)
        return state, Tracks(_mean_boxes(state), state.identities, confirmed, state.unseen, full)

    def _assigned(
        self, state: TrackerState, detections: Detections, table: IntegralHistogram | None
    ) -> tuple[Detections, Bool[Array, " d"]]:
        """The detection of each component, and which detections are taken.

        The assignment of least total cost, where a pair costs how far the detection lies from the
        component's last mean box, in `GATE`s, and how unlike the colours are.
        """
        boxes = _mean_boxes(state)
        gaps = box_differences(detections.boxes[None], boxes[:, None]) / jnp.array([[GATE]])
        unlike = 0.0
        if table is not None:
            seen = normalise(table.counts(detections.boxes, self.num_parts))
            unlike = jnp.mean(
                jnp.sum(bhattacharyya(seen[None], state.colour.references[:, None]), axis=3), axis=2
            )
        far = jnp.sum(gaps**2, axis=2)
        possible = (state.identities > 0)[:, None] & detections.valid[None] & (far < 1)
        cost = jnp.where(possible, far + COLOUR_COST * unlike, IMPOSSIBLE)
        rows, columns = hungarian_algorithm(cost)
        pair = possible[rows, columns]
        source = jnp.zeros(self.max_objects, jnp.int32).at[rows].set(columns.astype(jnp.int32))
        assigned = jnp.zeros(self.max_objects, bool).at[rows].set(pair)
        taken = jnp.zeros(detections.valid.shape, bool).at[columns].set(pair)
        scores = take(detections.scores, source)
        return Detections(take(detections.boxes, source), assigned, scores), taken

    def _filtered(
        self, key: Key[Array, ""], state: TrackerState, observation: DetectedFrame
    ) -> TrackerState:
        """Redraw, propagate, weigh; then the same mass for every component."""
        model = DetectedColourModel(state.colour, jnp.array(self.detection_deviations))
        filter = Filter(
            model,
            [self.rejuvenation, Propagate(model, DetectionProposal(model))],
            self.max_objects * self.particles_per_object,
            self.max_objects,
        )
        mixture, _ = filter.step(key, state.mixture, observation)
        num_alive = jnp.maximum(jnp.sum(mixture.active), 1).astype(mixture.log_weights.dtype)
        log_weights = mixture.log_component_weights - jnp.log(num_alive)
        return _replace(state, mixture=mixture.replace(log_weights=log_weights))

    def _bury(
        self,
        state: TrackerState,
        boxes: Float[Array, "m 4"],
        own: Detections,
        table: IntegralHistogram | None,
    ) -> TrackerState:
        """End what no detection bears out, what has left the frame, and doubles."""
        alive = state.identities > 0
        borne_out = own.valid
        seen = jnp.where(alive & borne_out, state.seen + 1, state.seen)
        unseen = jnp.where(borne_out, 0, state.unseen + 1)
        older = (state.identities[None] < state.identities[:, None]) & alive[None]
        covered = jnp.any((_overlap(boxes, boxes) > 0.5) & older, axis=1)
        crowded = jnp.where(covered, state.crowded + 1, 0)
        patience = jnp.where(seen >= self.confirmation, self.patience, 0)
        lives = alive & _within(boxes, table) & (unseen <= patience) & (crowded < self.crowding)
        # A component may also have died in the filter, all its particles at zero likelihood.
        lives &= state.mixture.active
        dies = ~take(lives, state.mixture.component_indicators)
        log_weights = jnp.where(dies, -jnp.inf, state.mixture.log_weights)
        return _replace(
            state,
            mixture=state.mixture.replace(log_weights=log_weights),
            identities=jnp.where(lives, state.identities, 0),
            seen=jnp.where(lives, seen, 0),
            unseen=jnp.where(lives, unseen, 0),
            crowded=jnp.where(lives, crowded, 0),
        )

    def _learn(
        self,
        state: TrackerState,
        boxes: Float[Array, "m 4"],
        own: Detections,
        table: IntegralHistogram | None,
    ) -> TrackerState:
        """Move the references of well seen components towards what they see now."""
        if self.adaptation == 0 or table is None:
            return state
        alive = state.identities > 0
        others = ~jnp.eye(self.max_objects, dtype=bool) & alive[None]
        alone = ~jnp.any((_overlap(boxes, boxes) > 0.05) & others, axis=1)
        rate = jnp.where(own.valid & alone, self.adaptation, 0.0)
        histograms = normalise(table.counts(boxes, self.num_parts))
        # What has no pixel, or too many to count, teaches nothing.
        counted = jnp.sum(histograms, axis=3, keepdims=True) > 0
        rate = jnp.where(counted, rate[:, None, None, None], 0.0)
        references = (1 - rate) * state.colour.references + rate * histograms
        return _replace(state, colour=_replace(state.colour, references=references))

    def _bear(
        self,
        key: Key[Array, ""],
        state: TrackerState,
        boxes: Float[Array, "m 4"],
        detections: Detections,
        table: IntegralHistogram | None,
    ) -> tuple[TrackerState, Bool[Array, ""]]:
        """Found a component on every detection in the frame that none covers, while there is room.

        Of more detections than there is room for, the first are chosen, the strongest; and whether
        there were.
        """
        alive = state.identities > 0
        covered = _inside(boxes, detections.boxes) | (_overlap(boxes, detections.boxes) > 0.2)
        # What lies outside would die in the next frame, again and again.
        new = detections.valid & _within(detections.boxes, table)
        new &= ~jnp.any(covered & alive[:, None], axis=0)
        source, born = _matched(new, ~alive)
        full = jnp.sum(new) > jnp.sum(born)
        places = take(detections.boxes, source)
        mixture, colour = state.mixture, state.colour
        seats, filled = self._seats(mixture, born)
        unit = jnp.concatenate([places[:, 2:], jnp.ones_like(places[:, 2:])], axis=1)
        deviations = unit * jnp.array([self.step_deviations], unit.dtype)
        step = _where(born, deviations, colour.initial_deviations)
        colour = _replace(
            colour,
            reference_boxes=_where(born, places, colour.reference_boxes),
            references=self._references(places, born, colour.references, table),
            dynamics=self._dynamics(step),
            initial_deviations=step,
        )
        centre = jnp.concatenate([places[:, :2], jnp.ones_like(places[:, 2:])], axis=1)
        # The box of the frame before is as uncertain as a step: so is the speed at birth.
        noise = jax.random.normal(fast_key(key), (2, *mixture.particles.box.shape), centre.dtype)
        drawn = take(centre, seats)[None] + take(deviations, seats)[None] * noise
        num_alive = jnp.maximum(jnp.sum(alive | born), 1)
        log_share = -jnp.log((num_alive * self.particles_per_object).astype(centre.dtype))
        log_old = mixture.log_component_weights - jnp.log(num_alive.astype(centre.dtype))
        born_state = _replace(
            state,
            colour=colour,
            mixture=mixture.replace(
                particles=BoxState(
                    _where(filled, drawn[0], mixture.particles.box),
                    jnp.where(filled, seats, mixture.particles.reference),
                    _where(filled, drawn[1], mixture.particles.previous),
                ),
                log_weights=jnp.where(filled, log_share, log_old),
                component_indicators=jnp.where(filled, seats, mixture.component_indicators),
            ),
            identities=jnp.where(
                born, state.last_identity + jnp.cumsum(born).astype(jnp.int32), state.identities
            ),
            last_identity=state.last_identity + jnp.sum(born, dtype=jnp.int32),
            seen=jnp.where(born, 1, state.seen),
        )
        return born_state, full

    def _references(
        self,
        places: Float[Array, "m 4"],
        born: Bool[Array, " m"],
        references: Float[Array, "m parts channels bins"],
        table: IntegralHistogram | None,
    ) -> Float[Array, "m parts channels bins"]:
        """The references, with those of the newborn as they look in their first box."""
        if table is None:
            return _where(born, jnp.zeros_like(references), references)
        return _where(born, normalise(table.counts(places, self.num_parts)), references)

    def _dynamics(self, deviations: Float[Array, "m 4"]) -> Autoregression:
        """Momentum of the centre; the size only diffuses."""
        momentum = jnp.diag(jnp.array([self.momentum, self.momentum, 0.0, 0.0]))
        rows = (len(deviations), 4, 4)
        return Autoregression(
            jnp.broadcast_to(jnp.eye(4) + momentum, rows),
            jnp.broadcast_to(-momentum, rows),
            jax.vmap(jnp.diag)(deviations),
            jnp.zeros((len(deviations), 4)),
        )

    def _seats(
        self, mixture: ParticleMixture, born: Bool[Array, " m"]
    ) -> tuple[Int[Array, " n"], Bool[Array, " n"]]:
        """Deal empty slots to the newborn, P each: the component of every slot, and whether."""
        empty = ~mixture.occupied
        number = (jnp.cumsum(empty) - 1) // self.particles_per_object
        order = jnp.argsort(~born, stable=True).astype(jnp.int32)  # the newborn first
        filled = empty & (number < jnp.sum(born))
        return order[jnp.clip(number, 0, self.max_objects - 1)], filled


def _matched(
    wanted: Bool[Array, " d"], free: Bool[Array, " m"]
) -> tuple[Int[Array, " m"], Bool[Array, " m"]]:
    """For each free place the wanted row that it takes, first to first, and whether it does."""
    rows = jnp.argsort(~wanted, stable=True).astype(jnp.int32)
    rank = jnp.cumsum(free) - 1
    taken = free & (rank < jnp.sum(wanted))
    return rows[jnp.clip(rank, 0, wanted.shape[0] - 1)], taken


def _mean_boxes(state: TrackerState) -> Float[Array, "m 4"]:
    return state.mixture.component_averages(state.colour.boxes(state.mixture.particles))


def _within(boxes: Float[Array, "k 4"], table: IntegralHistogram | None) -> Bool[Array, " k"]:
    """Whether the centre of each box lies in the frame, where there is one."""
    if table is None:
        return jnp.ones(len(boxes), bool)
    x, y = boxes[:, 0], boxes[:, 1]
    return (x > 0) & (x < table.width) & (y > 0) & (y < table.height)


def _inside(boxes: Float[Array, "m 4"], around: Float[Array, "d 4"]) -> Bool[Array, "m d"]:
    """Whether the centre of each box lies within each of the others."""
    gaps = jnp.abs(boxes[:, None, :2] - around[None, :, :2])
    return jnp.all(gaps < 0.5 * around[None, :, 2:], axis=2)


def _overlap(a: Float[Array, "m 4"], b: Float[Array, "d 4"]) -> Float[Array, "m d"]:
    """Intersection over union of every box with every other, 0 where one has no area."""
    low = jnp.maximum(a[:, None, :2] - a[:, None, 2:] / 2, b[None, :, :2] - b[None, :, 2:] / 2)
    high = jnp.minimum(a[:, None, :2] + a[:, None, 2:] / 2, b[None, :, :2] + b[None, :, 2:] / 2)
    common = jnp.prod(jnp.maximum(high - low, 0.0), axis=2)
    union = jnp.prod(a[:, 2:], axis=1)[:, None] + jnp.prod(b[:, 2:], axis=1)[None] - common
    return jnp.where(union > 0, common / jnp.where(union > 0, union, 1.0), 0.0)


def _where(chosen: Bool[Array, " n"], new: Array, old: Array) -> Array:
    return jnp.where(chosen.reshape(chosen.shape + (1,) * (new.ndim - 1)), new, old)


def _replace(module, **fields):
    names = tuple(fields)
    return eqx.tree_at(
        lambda tree: tuple(getattr(tree, name) for name in names), module, tuple(fields.values())
    )


def _four_positive(name: str, values: Any) -> tuple[float, ...]:
    try:
        numbers = np.asarray(values, float)
    except (TypeError, ValueError):
        numbers = np.zeros(0)
    if numbers.shape != (4,) or not np.all((numbers > 0) & np.isfinite(numbers)):
        raise ValueError(f"{name}: {shown(values)} are not four positive numbers")
    return tuple(numbers.tolist())


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
            "rejuvenation: where is None, but which reference a box is taken for is no Gaussian"
        )


def _motion(states: BoxState) -> tuple[PyTree, PyTree]:
    return states.box, states.previous
