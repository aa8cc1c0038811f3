"""A tracker that starts and ends its components by itself, from detections."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key, UInt8

from mpfjax.filters import Filter
from mpfjax.mixture import ParticleMixture
from mpfjax.models.dynamics import RandomWalk
from mpfjax.moves.base import AbstractRejuvenation
from mpfjax.moves.gaussian import GaussianRegeneration
from mpfjax.moves.propagation import Propagate
from mpfjax.operations import default_float, take
from mpfjax.vision.colour_model import BoxState, ColourModel
from mpfjax.vision.colours import AbstractColours, HSVColours
from mpfjax.vision.detected_model import DetectedColourModel, DetectedFrame, Detections
from mpfjax.vision.histograms import IntegralHistogram, integral_histogram, normalise


class Tracks(NamedTuple):
    """What a tracker says of one frame, a row for each of its M components.

    - `boxes`: (m, 4), the mean box of each, centre and size in pixels.
    - `identities`: (m,), a number that an object keeps for life, 0 for a dead component.
    - `confirmed`: (m,), whether detections have borne it out often enough to be believed.
    """

    boxes: Float[Array, "m 4"]
    identities: Int[Array, " m"]
    confirmed: Bool[Array, " m"]


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
    - `rejuvenation`: `GaussianRegeneration` of the boxes, or `Resample` for an MPF; with
      `particles_per_component` P.
    - `colours`, `sigma`, `num_parts`: of the `ColourModel`.
    - `step_deviations`: of the random walk in a frame, (x, y) in units of the box and (s_x, s_y).
    - `confirmation`: in how many frames detections must bear a component out before it is
      believed; until then it dies at the first frame in which they do not.
    - `adaptation`: the share of a reference that is learned anew in each frame in which one
      detection, and no other component, bears it out.

    Raises `ValueError` for numbers that are not positive, or a share outside [0, 1).
    """

    rejuvenation: AbstractRejuvenation
    max_objects: int = eqx.field(static=True)
    particles_per_object: int = eqx.field(static=True)
    colours: AbstractColours
    sigma: float = eqx.field(static=True)
    num_parts: int = eqx.field(static=True)
    step_deviations: tuple[float, ...] = eqx.field(static=True)
    confirmation: int = eqx.field(static=True)
    patience: int = eqx.field(static=True)
    crowding: int = eqx.field(static=True)
    adaptation: float = eqx.field(static=True)

    def __init__(
        self,
        max_objects: int = 24,
        particles_per_object: int = 25,
        *,
        rejuvenation: AbstractRejuvenation | None = None,
        colours: AbstractColours | None = None,
        sigma: float = 0.15,
        num_parts: int = 3,
        step_deviations: tuple[float, float, float, float] = (0.15, 0.05, 0.02, 0.02),
        confirmation: int = 3,
        patience: int = 10,
        crowding: int = 8,
        adaptation: float = 0.05,
    ) -> None:
        whole = {
            "max_objects": max_objects,
            "particles_per_object": particles_per_object,
            "num_parts": num_parts,
            "confirmation": confirmation,
            "patience": patience,
            "crowding": crowding,
        }
        for name, value in whole.items():
            if value < 1:
                raise ValueError(f"{name}: {value} is less than 1")
        if not sigma > 0:
            raise ValueError(f"sigma: {sigma} is not positive")
        if len(step_deviations) != 4 or not all(value > 0 for value in step_deviations):
            raise ValueError(f"step_deviations: {step_deviations} are not four positive numbers")
        if not 0 <= adaptation < 1:
            raise ValueError(f"adaptation: {adaptation} is not in [0, 1)")
        if rejuvenation is None:
            rejuvenation = GaussianRegeneration(particles_per_object, where=_box)
        self.rejuvenation = rejuvenation
        self.max_objects = max_objects
        self.particles_per_object = particles_per_object
        self.colours = HSVColours() if colours is None else colours
        self.sigma = sigma
        self.num_parts = num_parts
        self.step_deviations = tuple(step_deviations)
        self.confirmation = confirmation
        self.patience = patience
        self.crowding = crowding
        self.adaptation = adaptation

    def init(self) -> TrackerState:
        """Nothing tracked yet: every component dead, every slot empty."""
        m, n = self.max_objects, self.max_objects * self.particles_per_object
        shape = (m, self.num_parts, self.colours.num_channels, self.colours.num_bins)
        colour = ColourModel(
            reference_boxes=jnp.ones((m, 4)),
            references=jnp.zeros(shape),
            colour_weights=jnp.ones(shape),
            dynamics=RandomWalk(jnp.ones((m, 4))),
            initial_deviations=jnp.ones((m, 4)),
            sigma=jnp.asarray(self.sigma, float),
            colours=self.colours,
        )
        mixture = ParticleMixture(
            particles=BoxState(jnp.ones((n, 4)), jnp.zeros(n, jnp.int32)),
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
        frame: UInt8[Array, "h w 3"],
        detections: Detections,
    ) -> tuple[TrackerState, Tracks]:
        """The state after a frame and its detections, and what is tracked in it."""
        key_filter, key_births = jax.random.split(key)
        table = integral_histogram(frame, self.colours)
        state = self._filtered(key_filter, state, DetectedFrame(table, detections))
        boxes = _mean_boxes(state)
        state = self._bury(state, boxes, detections, table)
        state = self._learn(state, boxes, detections, table)
        state = self._bear(key_births, state, boxes, detections, table)
        confirmed = (state.identities > 0) & (state.seen >= self.confirmation)
        return state, Tracks(_mean_boxes(state), state.identities, confirmed)

    def _filtered(
        self, key: Key[Array, ""], state: TrackerState, observation: DetectedFrame
    ) -> TrackerState:
        """Redraw, propagate, weigh; then the same mass for every component."""
        model = DetectedColourModel(state.colour)
        filter = Filter(
            model,
            [self.rejuvenation, Propagate(model)],
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
        detections: Detections,
        table: IntegralHistogram,
    ) -> TrackerState:
        """End what no detection bears out, what has left the frame, and doubles."""
        alive = state.identities > 0
        borne_out = jnp.any(_inside(boxes, detections.boxes) & detections.valid[None], axis=1)
        seen = jnp.where(alive & borne_out, state.seen + 1, state.seen)
        unseen = jnp.where(borne_out, 0, state.unseen + 1)
        older = (state.identities[None] < state.identities[:, None]) & alive[None]
        covered = jnp.any((_overlap(boxes, boxes) > 0.5) & older, axis=1)
        crowded = jnp.where(covered, state.crowded + 1, 0)
        x, y = boxes[:, 0], boxes[:, 1]
        inside = (x > 0) & (x < table.width) & (y > 0) & (y < table.height)
        patience = jnp.where(seen >= self.confirmation, self.patience, 0)
        lives = alive & inside & (unseen <= patience) & (crowded < self.crowding)
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
        detections: Detections,
        table: IntegralHistogram,
    ) -> TrackerState:
        """Move the references of well seen components towards what they see now."""
        if self.adaptation == 0:
            return state
        alive = state.identities > 0
        agrees = (_overlap(boxes, detections.boxes) > 0.5) & detections.valid[None]
        others = ~jnp.eye(self.max_objects, dtype=bool) & alive[None]
        alone = ~jnp.any((_overlap(boxes, boxes) > 0.05) & others, axis=1)
        rate = jnp.where(alive & alone & jnp.any(agrees, axis=1), self.adaptation, 0.0)
        rate = rate[:, None, None, None]
        histograms = normalise(table.counts(boxes, self.num_parts))
        references = (1 - rate) * state.colour.references + rate * histograms
        return _replace(state, colour=_replace(state.colour, references=references))

    def _bear(
        self,
        key: Key[Array, ""],
        state: TrackerState,
        boxes: Float[Array, "m 4"],
        detections: Detections,
        table: IntegralHistogram,
    ) -> TrackerState:
        """Found a component on every detection that none covers, as long as there is room."""
        alive = state.identities > 0
        covered = _inside(boxes, detections.boxes) | (_overlap(boxes, detections.boxes) > 0.2)
        new = detections.valid & ~jnp.any(covered & alive[:, None], axis=0)
        source, born = _matched(new, ~alive)
        places = take(detections.boxes, source)
        mixture, colour = state.mixture, state.colour
        seats, filled = self._seats(mixture, born)
        unit = jnp.concatenate([places[:, 2:], jnp.ones_like(places[:, 2:])], axis=1)
        deviations = unit * jnp.array([self.step_deviations], unit.dtype)
        colour = _replace(
            colour,
            reference_boxes=_where(born, places, colour.reference_boxes),
            references=_where(
                born, normalise(table.counts(places, self.num_parts)), colour.references
            ),
            dynamics=RandomWalk(_where(born, deviations, colour.dynamics.deviations)),
            initial_deviations=_where(born, deviations, colour.initial_deviations),
        )
        centre = jnp.concatenate([places[:, :2], jnp.ones_like(places[:, 2:])], axis=1)
        noise = jax.random.normal(key, mixture.particles.box.shape, centre.dtype)
        drawn = take(centre, seats) + take(deviations, seats) * noise
        num_alive = jnp.maximum(jnp.sum(alive | born), 1)
        log_share = -jnp.log((num_alive * self.particles_per_object).astype(centre.dtype))
        log_old = mixture.log_component_weights - jnp.log(num_alive.astype(centre.dtype))
        return _replace(
            state,
            colour=colour,
            mixture=mixture.replace(
                particles=BoxState(
                    _where(filled, drawn, mixture.particles.box),
                    jnp.where(filled, seats, mixture.particles.reference),
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


def _inside(boxes: Float[Array, "m 4"], around: Float[Array, "d 4"]) -> Bool[Array, "m d"]:
    """Whether the centre of each box lies within each of the others."""
    gaps = jnp.abs(boxes[:, None, :2] - around[None, :, :2])
    return jnp.all(gaps < 0.5 * around[None, :, 2:], axis=2)


def _overlap(a: Float[Array, "m 4"], b: Float[Array, "d 4"]) -> Float[Array, "m d"]:
    """Intersection over union of every box with every other, 0 where one has no area."""
    low = jnp.maximum(
        a[:, None, :2] - a[:, None, 2:] / 2, b[None, :, :2] - b[None, :, 2:] / 2
    )
    high = jnp.minimum(
        a[:, None, :2] + a[:, None, 2:] / 2, b[None, :, :2] + b[None, :, 2:] / 2
    )
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


def _box(states: BoxState) -> Float[Array, "n 4"]:
    return states.box
