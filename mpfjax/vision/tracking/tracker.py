"""A tracker of an unknown number of objects, from detections: a Kalman filter for each."""

from typing import Annotated, Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key, UInt8

from mpfjax.checks import POSITIVE, Checked, Count, as_numbers, checked
from mpfjax.vision.colour.bins import HSVColours
from mpfjax.vision.colour.histograms import SampledBoxes, normalise
from mpfjax.vision.tracking.associate import (
    compatible,
    learned_colours,
    mahalanobis,
    one_to_one,
    probabilities,
    seated,
    stronger,
    unlikeness,
)
from mpfjax.vision.tracking.camera import CameraState, jolted
from mpfjax.vision.tracking.detections import DetectedBoxes, Detections
from mpfjax.vision.tracking.gaussian import (
    CameraMotion,
    Gaussian,
    boxes_of,
    overlap,
    places_of,
    shared,
    units,
    within,
    zeros,
)
from mpfjax.vision.tracking.lives import Coasting, Duplicates, Lives, Spans
from mpfjax.vision.tracking.noise import NoiseState
from mpfjax.vision.tracking.scores import STRONG, WEAK, ScoreState
from mpfjax.vision.tracking.state import TrackerState, Tracks

_COLOURS, _BANDS = HSVColours(8, 4, 6), 3
# Of a weak detection, of an object that is not confirmed, and of one of another class.
_WEAK_COST, _DOUBT_COST, _CLASS_COST = 8.0, 2.0, 8.0
WEAK_ERROR = 1.35  # times the error of a strong detection
_YIELDING = 0.01  # of the claim of an object that takes only what others leave
_BIRTH_OVERLAP = 0.5  # with an object or a stronger detection: it is one more box of the same
_SAME = 0.5  # least overlap of a prediction that was right with the detection
_CONTACT = 0.12  # an overlap from which on objects would learn each other's colours
_FIRST = 3  # strong detections of an object after which it teaches the noises


def _as_rate(frames_per_second: Any) -> np.ndarray:
    """An array, so that one program serves all rates."""
    rate = 25 if frames_per_second is None else frames_per_second
    return np.asarray(as_numbers("frames_per_second", rate), np.float32)


class ObjectTracker(Checked):
    """Tracks an unknown and changing number of objects, with any detector.

    Every object has a Kalman filter for its box. `step` is a function of the state and of what is
    found in a frame; nothing is drawn at random. In a step

    - objects move by their velocities, and by the motion that all have in common, the camera's;
    - the detections' scores tell which are strong, by what became of earlier ones;
    - each pair of object and detection has a probability in the joint distribution of all
      one-to-one assignments; the most probable assignment is chosen, and an object follows its
      detection by the probability of the pair, as in probabilistic data association;
    - objects without detections, or outside the frame, end; strong detections that nobody explains
      begin new ones;
    - the detector's errors and the noises of the motion are learned from the innovations.

    Lengths are in boxes, so that nothing depends on the size of the frame or of the objects.

    - `max_objects`: M, how many objects there is room for.
    - `frames_per_second`: of the video. An object ends after a second without a detection. None
      takes 25.
    - `scores`: "rank" finds from which score on a detection is strong, and starts an object, on any
      scale. "as_given" takes scores for probabilities: strong from .5 on, and below .2 a detection
      counts for nothing. "ignore" takes all for strong.
    - `class_matters`: with True objects have detections of their own class only, and those of
      another one are no duplicates. "prefers" is for detectors that mix up classes: another class
      costs as much as a weak score does. False does not look at classes. Class 0 is none, and goes
      with all.

    Raises `ValueError` for a number of objects that is not whole, or below 1, a rate that is not
    positive, and scores or classes that are none of these.
    """

    max_objects: Count = eqx.field(static=True, default=24)
    frames_per_second: Annotated[Float[Array | np.ndarray, ""], POSITIVE] = eqx.field(
        converter=_as_rate, default=None, kw_only=True
    )
    scores: Literal["rank", "as_given", "ignore"] = eqx.field(
        static=True, default="rank", kw_only=True
    )
    class_matters: Literal["prefers"] | bool = eqx.field(static=True, default=True, kw_only=True)

    def init(self) -> TrackerState:
        """The state before the first frame: no objects."""
        m = self.max_objects
        state = TrackerState(
            objects=Gaussian.nowhere(m),
            lives=Lives.initial(m),
            coasting=Coasting.initial(),
            duplicates=Duplicates.initial(m),
            scores=ScoreState.initial(m),
            camera=CameraState.initial(),
            noise=NoiseState.initial(m, float(self.frames_per_second)),
            colours=zeros(m, _BANDS * _COLOURS.num_bins),
        )
        return jax.tree.map(jnp.asarray, state)

    @checked
    def step(
        self,
        key: Key[Array, ""] | None,
        state: TrackerState,
        frame: UInt8[np.ndarray, "h w 3"] | None,
        detections: Any,
        motion: CameraMotion | None = None,
    ) -> tuple[TrackerState, Tracks]:
        """The state after a frame and its detections, and the tracks in it.

        `detections` are what a detector of `track` gives: boxes, (boxes, scores), or (boxes,
        scores, classes). There is room for twice `max_objects`; `Detections` have room of your own.
        Where `frame` is None detections are tracked alone, without colours. `motion` is what
        `OpticalFlow` makes of the frames; None leaves the camera's motion to the detections.
        Nothing is drawn: the key may be None. Raises `ValueError` for a frame that is not (h, w, 3)
        of type uint8, for boxes as `Detections.from_boxes` does, and for anything but a state of
        `init`.
        """
        del key
        if not isinstance(detections, Detections):
            boxes, scores, classes = DetectedBoxes.of(detections, "detections")
            size = None if frame is None else np.shape(frame)[:2]
            detections = Detections.from_boxes(
                boxes, 2 * self.max_objects, scores, frame_size=size, classes=classes
            )
        seen = None if frame is None else colours_of(frame, detections)
        return _advanced(self, state, detections, seen, motion)


def colours_of(frame: UInt8[np.ndarray, "h w 3"], detections: Detections) -> SampledBoxes:
    """The part of a frame that a step needs: the detections' colours."""
    return SampledBoxes.of(np.asarray(frame), np.asarray(detections.boxes), _COLOURS)


class _Found(NamedTuple):
    """The detections of a frame, and what they are to each other.

    - `places`: (d, 4); `classes`: (d,), 0 where they do not matter; `extent`: of the frame.
    - `colours`: (d, bins), None without pixels.
    - `stronger`: (d, d), whether the first of a pair is; `overlaps`: (d, d), of what may be one.
    """

    detections: Detections
    places: Float[Array, "d 4"]
    classes: Int[Array, " d"]
    extent: Float[Array, "4"]
    colours: Float[Array, "d bins"] | None
    stronger: Bool[Array, "d d"]
    overlaps: Float[Array, "d d"]

    @classmethod
    def of(
        cls, tracker: ObjectTracker, detections: Detections, seen: SampledBoxes | None
    ) -> "_Found":
        """Compare all with all."""
        if tracker.scores == "ignore":
            same = jnp.ones_like(detections.scores)
            detections = eqx.tree_at(lambda found: found.scores, detections, same)
        colours, extent, boxes = None, detections.extent, detections.boxes
        if seen is not None:
            extent = jnp.array([0, 0, 1, 1]) * jnp.tile(jnp.stack([seen.width, seen.height]), 2)
            extent = extent.astype(boxes.dtype)
            colours = normalise(seen.counts(_BANDS)).reshape(len(boxes), -1)
        classes = detections.classes if tracker.class_matters else 0
        classes = jnp.broadcast_to(classes, detections.valid.shape).astype(jnp.int32)
        ranked = stronger(detections.scores, jnp.prod(boxes[:, 2:], axis=1))
        overlaps = jnp.where(_may_be_one(tracker, classes, classes), overlap(boxes, boxes), 0.0)
        return cls(detections, places_of(boxes), classes, extent, colours, ranked, overlaps)

    def strong(self, least: Float[Array, ""]) -> Bool[Array, " d"]:
        """Which detections have at least this score."""
        return self.detections.valid & (self.detections.scores >= least)


class _Taken(NamedTuple):
    """The detection of each object: its row, whether there is any, and a strong one; its place."""

    rows: Int[Array, " m"]
    there: Bool[Array, " m"]
    strong: Bool[Array, " m"]
    place: Float[Array, "m 4"]

    @classmethod
    def of(cls, source: Int[Array, " m"], strong: Bool[Array, " d"], found: _Found) -> "_Taken":
        """By the rows, -1 for none."""
        rows, there = jnp.maximum(source, 0), source >= 0
        return cls(rows, there, there & strong[rows], found.places[rows])

    def values(self, values: Array, none: Any) -> Array:
        """The value of each object's detection, or another where there is none."""
        return jnp.where(self.there.reshape(-1, *[1] * (values.ndim - 1)), values[self.rows], none)


def advanced(
    tracker: ObjectTracker,
    state: TrackerState,
    detections: Detections,
    seen: SampledBoxes | None = None,
    motion: CameraMotion | None = None,
) -> tuple[TrackerState, Tracks]:
    """A step as a pure function, for `jax.lax.scan` and for programs of your own."""
    found = _Found.of(tracker, detections, seen)
    spans = Spans.at(jnp.asarray(tracker.frames_per_second))
    unlike = _unlikeness(tracker, state, found)
    predicted, noise, camera, shift = _moved(state, found, unlike, motion)
    scores = state.scores.after(
        found.detections, found.stronger, found.overlaps, shift, spans.lasting
    )
    if tracker.scores == "as_given":
        weak, strong = (jnp.full_like(scores.weak, score) for score in (WEAK, STRONG))
        scores = scores._replace(weak=weak, strong=strong)
    strong = found.strong(scores.strong)

    errors, speed = noise.noises.errors, noise.noises.speed
    cost = mahalanobis(predicted, errors, found.places) + unlike
    source, probability = _associated(state, cost, strong, found.strong(scores.weak))
    taken = _Taken.of(source, strong, found)
    error = units(taken.place) * errors[None] * jnp.where(taken.strong, 1.0, WEAK_ERROR)[:, None]
    updated, _, _ = predicted.updated(taken.place, error)
    objects = updated.mixed_with(predicted, probability[:, None])

    inside = within(boxes_of(objects.place), found.extent, centred=~taken.there)
    coast = state.coasting.longest(spans)
    lives = state.lives.counted(taken.there, taken.strong, inside, spans, coast)
    right = shared(boxes_of(predicted.place), found.detections.boxes[taken.rows]) >= _SAME
    coasting = state.coasting.after(state.lives, lives, taken.there, right, spans)

    stays, wanted = lives.alive, _unexplained(tracker, state, lives, objects, found, source, strong)
    begun = seated(wanted, found.stronger, ~stays)
    taken, born = _Taken.of(jnp.where(stays, source, begun), strong, found), begun >= 0
    unit = units(taken.place)
    start = Gaussian.begun(taken.place, unit * errors[None], unit * speed[None])
    objects = start.where(born, objects)
    lives = lives.begins(born, taken.values(found.classes, 0), jnp.sum(wanted, dtype=jnp.int32))

    boxes = boxes_of(objects.place)
    alike = _may_be_one(tracker, lives.classes, lives.classes)
    overlaps = jnp.where(alike, overlap(boxes, boxes), 0.0)
    duplicates = state.duplicates.after(lives.identities, stays, taken.there, overlaps)
    lives = lives._replace(shown=lives.shown & ~duplicates.doubtful)
    teaches, there = taken.strong & stays, taken.there & stays
    known, grown = teaches & lives.confirmed & (lives.seen >= _FIRST), lives.seen == _FIRST
    noise = noise.after(taken.place, there, known, born, teaches & grown, objects)
    colours = state.colours
    if found.colours is not None:
        others = lives.alive[None] & ~jnp.eye(len(boxes), dtype=bool)
        alone = ~jnp.any((overlaps > _CONTACT) & others, axis=1)
        kept = jnp.where(born[:, None], 0.0, colours)
        colours = learned_colours(kept, taken.values(found.colours, 0.0), alone)
    state = TrackerState(objects, lives, coasting, duplicates, scores, camera, noise, colours)
    rows = detections.rows_of(jnp.where(taken.there, taken.rows, -1))
    probability = jnp.where(born, 1.0, jnp.where(stays, probability, 0.0))
    told = lives.identities, lives.confirmed, lives.unseen, lives.full, lives.shown
    return state, Tracks(boxes, *told, rows, probability, lives.classes)


_advanced = eqx.filter_jit(advanced)


def _may_be_one(
    tracker: ObjectTracker, a: Int[Array, " m"], b: Int[Array, " d"]
) -> Bool[Array, "m d"]:
    """Whether boxes of these classes may be of one object."""
    return compatible(a, b) | (tracker.class_matters == "prefers")


def _unlikeness(tracker: ObjectTracker, state: TrackerState, found: _Found) -> Float[Array, "m d"]:
    """What pairs cost beside distance: for their colours and classes, and infinitely if need be."""
    cost = unlikeness(found.colours, state.colours)
    if tracker.class_matters == "prefers":
        cost += jnp.where(compatible(state.lives.classes, found.classes), 0.0, _CLASS_COST)
    return jnp.where(_may_be_one(tracker, state.lives.classes, found.classes), cost, jnp.inf)


def _moved(
    state: TrackerState,
    found: _Found,
    unlike: Float[Array, "m d"],
    motion: CameraMotion | None,
) -> tuple[Gaussian, NoiseState, CameraState, Float[Array, "#c 2"]]:
    """Objects a frame later, moved with the camera, and by how far it moves chains of boxes."""
    before, noise, gone, away = state.objects, state.noise, jnp.zeros((1, 2)), jnp.zeros((1, 2))
    deviations = state.camera.deviations
    if motion is not None:
        carried = motion.carried(before)
        gone = (carried.place - before.place)[:, :2]
        chains = Gaussian(*[state.scores.boxes] * 5)
        away = (motion.carried(chains).place - chains.place)[:, :2]
        before, noise = carried, noise._replace(moments=motion.carried(noise.moments))
        deviations = jnp.where(motion.known, state.camera.left, deviations)
    errors, place, velocity, _ = noise.noises
    objects = before.predicted(place[None], velocity[None])
    confirmed, lately = state.lives.confirmed, state.lives.unseen == 0
    pairs = jnp.where(found.strong(state.scores.weak)[None], unlike, jnp.inf)
    seen = jnp.where(confirmed & lately, state.lives.seen, 0)
    jolt = jolted(objects, errors, found.places, pairs, seen)
    objects, gone = objects.shifted(jolt), gone + jolt[None]
    number = jnp.maximum(jnp.sum(confirmed, dtype=objects.place.dtype), 1.0)
    box = jnp.exp(jnp.sum(jnp.where(confirmed[:, None], objects.place[:, 2:], 0.0), 0) / number)
    cost = mahalanobis(objects, errors, found.places, 2 * deviations * box) + unlike
    pairs = confirmed[:, None] & found.strong(state.scores.strong)[None]
    cost = jnp.where(pairs, cost, jnp.inf)
    known = jnp.asarray(False) if motion is None else jnp.asarray(motion.known)
    camera, shift = state.camera.after(objects, gone, known, cost, errors, found.places, box)
    noise = noise._replace(moments=noise.moments.shifted(jolt + shift))
    return objects.shifted(shift), noise, camera, away + (jolt + shift)[None]


def _associated(
    state: TrackerState,
    cost: Float[Array, "m d"],
    strong: Bool[Array, " d"],
    counts: Bool[Array, " d"],
) -> tuple[Int[Array, " m"], Float[Array, " m"]]:
    """The detection of each object, -1 for none, and the probability that it is its own."""
    cost += jnp.where(strong, 0.0, _WEAK_COST)[None]
    cost += jnp.where(state.lives.confirmed, 0.0, _DOUBT_COST)[:, None]
    possible = state.lives.alive[:, None] & counts[None] & (cost < 0)
    cost = jnp.where(state.duplicates.doubtful[:, None], _YIELDING * cost, cost)
    cost = jnp.where(possible, cost, jnp.inf)
    source = one_to_one(cost)
    chosen = jnp.maximum(source, 0)[:, None]
    probability = jnp.take_along_axis(probabilities(cost), chosen, axis=1)[:, 0]
    return source, jnp.where(source >= 0, probability, 0.0)


def _unexplained(
    tracker: ObjectTracker,
    state: TrackerState,
    lives: Lives,
    objects: Gaussian,
    found: _Found,
    source: Int[Array, " m"],
    strong: Bool[Array, " d"],
) -> Bool[Array, " d"]:
    """Which strong detections begin an object: no object has them, or is there already."""
    boxes = found.detections.boxes
    covered = lives.alive[:, None] & (overlap(boxes_of(objects.place), boxes) > _BIRTH_OVERLAP)
    covered &= _may_be_one(tracker, state.lives.classes, found.classes)
    past = jnp.where(source >= 0, source, len(strong))  # a scatter drops it
    free = jnp.ones_like(strong).at[past].set(False, mode="drop")
    wanted = strong & free & within(boxes, found.extent) & ~jnp.any(covered, axis=0)
    duplicates = (found.overlaps > _BIRTH_OVERLAP) & wanted[:, None] & found.stronger
    return wanted & ~jnp.any(duplicates, axis=0)
