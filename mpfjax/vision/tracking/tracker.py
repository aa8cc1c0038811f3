"""A tracker of an unknown number of objects, from detections: a Kalman filter for each."""

from typing import Any, Literal, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key, UInt8

from mpfjax.checks import Checked, Count, Finite, Positive, checked
from mpfjax.vision.colour.bins import HSVColours
from mpfjax.vision.colour.histograms import sampled_histograms
from mpfjax.vision.tracking.associate import (
    TEMPERATURE,
    compatible,
    learned_descriptors,
    mahalanobis,
    one_to_one,
    probabilities,
    unlikeness,
)
from mpfjax.vision.tracking.camera import jolted
from mpfjax.vision.tracking.detections import Detections, Found
from mpfjax.vision.tracking.gaussian import (
    CameraMotion,
    Gaussian,
    along,
    boxes_of,
    overlap,
    shared,
    units,
    within,
)
from mpfjax.vision.tracking.lives import Lives, Spans
from mpfjax.vision.tracking.noise import NoiseState
from mpfjax.vision.tracking.scores import STRONG, WEAK, ScoreState
from mpfjax.vision.tracking.state import TrackerState, Tracks
from mpfjax.vision.tracking.vectors import cosine_distances

_COLOURS, _BANDS = HSVColours(num_hues=8, num_saturations=4, num_values=6), 3
# Of a weak detection, of an object that is not confirmed, and of one of another class.
_WEAK_COST, _DOUBT_COST, _CLASS_COST = 8.0, 2.0, 8.0
WEAK_ERROR = 1.35  # times the error of a strong detection
_YIELDING = 0.01  # of the claim of an object that takes only what others leave
_BIRTH_OVERLAP = 0.5  # with an object or a stronger detection: it is one more box of the same
_SAME = 0.5  # least overlap of a prediction that was right with the detection
_CONTACT = 0.12  # an overlap from which on objects would learn each other's colours
# Before any point of its own an object has odds of 1 to 10, and odds of 20 to 1 confirm it; one
# of its points in seven is missed.
_POINT_ODDS, _MISSED = -np.log(10) - np.log(20), -np.log(7)
_FIRST = 3  # strong detections of an object after which it teaches the noises


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

    Lengths are in boxes, so that nothing depends on the size of the frame or of the objects; with
    `point_deviation` in deviations of points. Who has which point is told by distance alone, and
    by how densely points of nobody lie, which is learned. One new point in ten is of an object, and
    one of an object's seven is missed: assumptions, and no measurements; odds of 20 to 1 confirm an
    object. Two that begin nearer than 3.5 deviations are one until they part. Vectors beside boxes
    count by what their cosine distances have told.

    - `max_objects`: M, how many objects there is room for.
    - `frames_per_second`: of the video.
    - `lost_seconds`: an object ends after so long without a detection. None takes a second, and
      eight frames where these are longer.
    - `point_deviation`: detections are points (x, y) with an error of this deviation along each,
      and no boxes: plots of a radar, keypoints, animals seen from above.
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
    frames_per_second: Positive | None = eqx.field(static=True, default=None, kw_only=True)
    lost_seconds: Positive | None = eqx.field(static=True, default=None, kw_only=True)
    point_deviation: Positive | None = eqx.field(static=True, default=None, kw_only=True)
    scores: Literal["rank", "as_given", "ignore"] = eqx.field(
        static=True, default="rank", kw_only=True
    )
    class_matters: Literal["prefers"] | bool = eqx.field(static=True, default=True, kw_only=True)

    @property
    def rate(self) -> float:
        """Frames a second, 25 where nobody says."""
        return 25.0 if self.frames_per_second is None else float(self.frames_per_second)

    @property
    def coordinates(self) -> int:
        """Of a detection: four of a box, two of a point."""
        return 4 if self.point_deviation is None else 2

    def init(self) -> TrackerState:
        """The state before the first frame: no objects."""
        none = np.zeros(0, int)
        return TrackerState(
            objects=Gaussian.none(self.coordinates),
            lives=Lives.begun(none, none, at_once=False),
            scores=ScoreState.initial(self.coordinates),
            noise=NoiseState.initial(self.rate, self.coordinates),
            colours=np.zeros((0, _BANDS * _COLOURS.num_bins)),
        )

    @checked
    def step(
        self,
        key: Key[Array, ""] | None,
        state: TrackerState,
        frame: UInt8[np.ndarray, "h w 3"] | None,
        detections: Any,
        motion: CameraMotion | None = None,
        *,
        time: Finite | None = None,
        frame_size: tuple[int, int] | None = None,
    ) -> tuple[TrackerState, Tracks]:
        """The state after a frame and its detections, and the tracks in it.

        `detections` are what a detector of `track` gives: boxes, (boxes, scores), (boxes, scores,
        classes), or `Detections`; with `point_deviation` points in the place of boxes; None where
        it did not run, which is not "nothing there". Those that cannot be tracked are left out as
        by `track`, and counted in the state. Where `frame` is None they are tracked alone, without
        colours. Nothing is drawn: the key may be None.

        - `motion`: what `OpticalFlow` makes of the frames; None leaves it to the detections.
        - `time`: in seconds, for frames that are not equally far apart; None takes the frame after
          the last, by `frames_per_second`.
        - `frame_size`: height and width, where there is no frame and they are known.

        Raises `ValueError` for a frame that is not (h, w, 3) of type uint8, for a time that is not
        after the one before, and for detections as `Detections.of` does.
        """
        del key
        found = None
        if detections is not None:
            named = f"detections: frame {state.number + 1}"
            size = frame_size if frame is None else np.shape(frame)[:2]
            given = Detections.of(detections, named, self.coordinates)
            found = Found.of(given, named, size, self.point_deviation)
            if frame is not None and self.point_deviation is None:
                found = coloured(found, frame)
        return advanced(self, state, found, motion, time)


def coloured(found: Found, frame: UInt8[np.ndarray, "h w 3"]) -> Found:
    """With the colours of the detections, the part of a frame that a step needs."""
    histograms = sampled_histograms(frame, found.boxes, _COLOURS, _BANDS)
    return found._replace(colours=histograms.reshape(len(histograms), _BANDS * _COLOURS.num_bins))


class _Taken(NamedTuple):
    """The detection of each object: its row, -1 for none, whether there is any, a strong one."""

    rows: Int[np.ndarray, " m"]
    there: Bool[np.ndarray, " m"]
    strong: Bool[np.ndarray, " m"]

    @classmethod
    def of(cls, rows: Int[np.ndarray, " m"], strong: Bool[np.ndarray, " d"]) -> "_Taken":
        """By the rows."""
        return cls(rows, rows >= 0, np.append(strong, False)[rows])

    def values(self, values: np.ndarray, none: Any) -> np.ndarray:
        """The value of each object's detection, or another where there is none."""
        filled = np.concatenate([values, np.full((1, *values.shape[1:]), none, values.dtype)])
        return filled[self.rows]


def advanced(
    tracker: ObjectTracker,
    state: TrackerState,
    found: Found | None,
    motion: CameraMotion | None = None,
    time: float | None = None,
) -> tuple[TrackerState, Tracks]:
    """A step with what was found, or None where no detector ran."""
    frames, before = 1.0, state.time
    if time is not None and before is not None:
        if time <= before:
            raise ValueError(f"time: {time} s is not after that of the frame before, {before} s")
        frames = (time - before) * tracker.rate
    if time is None and before is not None:
        time = before + 1 / tracker.rate
    if motion is not None and tracker.point_deviation is not None:
        motion = motion._replace(shift=motion.shift / tracker.point_deviation)
    state, gone, chains = _carried(state, motion, frames)
    frames += state.waited
    state = state._replace(number=state.number + 1, time=time, waited=frames)
    if found is None:
        # Objects move on, and nothing is held against them.
        state = state._replace(scores=state.scores._replace(boxes=chains), full=False)
        none = np.zeros(len(state.lives.seen))
        return state, _tracks(tracker, state, none.astype(int) - 1, none, 0)
    found.warn_of_first(state.left_out)
    given = found.scores
    if tracker.scores == "ignore":
        found = found._replace(scores=np.ones_like(found.scores))
    if not tracker.class_matters:
        found = found._replace(classes=np.zeros_like(found.classes))
    spans, lives = Spans.at(tracker.rate, tracker.lost_seconds), state.lives
    places, unlike, distances = found.places, _unlikeness(tracker, state, found), np.zeros((0, 0))
    if found.vectors is not None:
        state = _with_vectors(state, found.vectors.shape[1])
        distances = cosine_distances(state.vectors, found.vectors)
        unlike = unlike + state.likeness.cost(distances)
    doubles = overlap(found.boxes, found.boxes)
    doubles[~_may_be_one(tracker, found.classes, found.classes)] = 0.0
    others, variance, temperature, gained = 0.0, 2.0, TEMPERATURE, 0.0
    if tracker.point_deviation is None:
        state, shift = _with_camera(state, found, places, unlike, motion, gone)
        chains = chains + along(chains, shift)
    else:
        others, temperature = state.clutter.cost, 1.0  # distance is the only cue
        variance += float(np.mean(state.noise.noises.speed**2))
    scores = state.scores.after(
        found.boxes, found.scores, doubles, chains, frames, spans.lasting, variance
    )
    if tracker.scores == "as_given":
        scores = scores._replace(weak=WEAK, strong=STRONG)
    strong = found.scores >= scores.strong

    predicted, noises = state.objects, state.noise.noises
    cost = mahalanobis(predicted, noises.errors, places, unlike, others=others)
    counts = found.scores >= scores.weak
    source, probability = _associated(state, cost, strong, counts, temperature)
    if tracker.point_deviation is not None:
        gains = np.append(-0.5 * cost, np.full((len(cost), 1), _MISSED), axis=1)
        gained = gains[np.arange(len(cost)), source]
    taken, rows = _Taken.of(source, strong), np.flatnonzero(source >= 0)
    before, place = predicted.at(rows), places[source[rows]]
    wider = np.where(taken.strong[rows], 1.0, WEAK_ERROR)[:, None]
    updated, _, _ = before.updated(place, units(place) * noises.errors * wider)
    objects = Gaussian(*map(np.copy, predicted))
    objects.put(rows, updated.mixed_with(before, probability[rows, None]))

    coast = state.coasting.longest(spans)
    told = taken.there, taken.strong, frames, spans, coast, state.full
    counted, stays = lives.counted(*told, gained)
    stays &= within(boxes_of(objects.place), found.extent, centred=~taken.there)
    right = taken.there.copy()
    right[rows] = shared(boxes_of(before.place), found.boxes[source[rows]]) >= _SAME
    ended = lives.confirmed & np.where(taken.there, ~right, ~stays)
    unseen = lives.unseen + np.where(taken.there, 0.0, frames)
    coasting = state.coasting.after(unseen, lives.confirmed & right, ended, spans)

    wanted = _unexplained(tracker, state, objects.at(stays), stays, found, doubles, source, strong)
    born = np.flatnonzero(wanted)[: tracker.max_objects - np.sum(stays)]
    teaches = taken.strong & stays
    known = teaches & counted.confirmed & (counted.seen >= _FIRST)
    grown = objects.at(teaches & (counted.seen == _FIRST))
    speed = noises.speed
    noise = state.noise.after(taken.there, place, known[rows], grown)
    moments = noise.moments.at(stays).joined(noise.begun(places[born], speed))
    unit = units(places[born])
    start = Gaussian.begun(places[born], unit * noises.errors, unit * speed)
    objects = objects.at(stays).joined(start)
    names = state.last_identity + 1 + np.arange(len(born))
    is_boxes = tracker.point_deviation is None
    begun = Lives.begun(names, found.classes[born], at_once=is_boxes and not state.begun)
    if not is_boxes:
        begun = begun._replace(odds=begun.odds + _POINT_ODDS)
    taken = _Taken.of(np.append(source[stays], born), strong)
    told = taken.values(found.classes, 0), taken.values(given, 0.0)
    lives = counted.at(stays).joined(begun).described(taken.there, *told)

    boxes = boxes_of(objects.place)
    overlaps = overlap(boxes, boxes)
    overlaps[~_may_be_one(tracker, lives.classes, lives.classes)] = 0.0
    duplicates = state.duplicates.after(lives.identities, stays, taken.there, overlaps)
    lives = lives._replace(shown=lives.shown & ~duplicates.doubtful)
    colours, vectors = (
        np.append(held[stays], np.zeros((len(born), held.shape[1])), axis=0)
        for held in (state.colours, state.vectors)
    )
    alone = np.sum(overlaps > _CONTACT, axis=1) <= 1  # each overlaps itself
    if found.colours is not None:
        colours = learned_descriptors(colours, taken.values(found.colours, 0.0), alone)
    likeness, clutter = state.likeness, state.clutter
    if found.vectors is not None:
        vectors = learned_descriptors(vectors, taken.values(found.vectors, 0.0), alone)
        likeness = likeness.after(distances, source[:, None] == np.arange(len(places)))
    if not is_boxes:
        clutter = clutter.after(places, len(places) - len(rows) if state.begun else 0)
    state = TrackerState(
        objects, lives, scores, noise._replace(moments=moments), colours, coasting, duplicates,
        state.camera, vectors, likeness, clutter,
        last_identity=state.last_identity + len(born), full=bool(np.sum(wanted) > len(born)),
        begun=True, waited=0.0, time=time, number=state.number,
        left_out=state.left_out + found.left_out,
    )  # fmt: skip
    probability = np.append(probability[stays], np.ones(len(born)))
    left_out = int(found.left_out.sum())
    return state, _tracks(tracker, state, taken.values(found.rows, -1), probability, left_out)


def _tracks(
    tracker: ObjectTracker,
    state: TrackerState,
    rows: np.ndarray,
    probability: np.ndarray,
    left_out: int,
) -> Tracks:
    lives = state.lives
    told = lives.identities, lives.confirmed, lives.unseen, state.full, lives.shown
    boxes = boxes_of(state.objects.place) * (tracker.point_deviation or 1.0)
    return Tracks(boxes, *told, rows, probability, lives.classes, lives.scores, left_out)


def _may_be_one(
    tracker: ObjectTracker, a: Int[np.ndarray, " m"], b: Int[np.ndarray, " d"]
) -> Bool[np.ndarray, "m d"]:
    """Whether boxes of these classes may be of one object."""
    return compatible(a, b) | (tracker.class_matters == "prefers")


def _unlikeness(
    tracker: ObjectTracker, state: TrackerState, found: Found
) -> Float[np.ndarray, "m d"]:
    """What pairs cost beside distance: for their colours and classes, and infinitely if need be."""
    alike = compatible(state.lives.classes, found.classes)
    cost = np.where(alike, 0.0, _CLASS_COST if tracker.class_matters == "prefers" else np.inf)
    return cost if found.colours is None else cost + unlikeness(found.colours, state.colours)


def _with_vectors(state: TrackerState, size: int) -> TrackerState:
    """With room for vectors of this size, where there were none so far."""
    held = state.vectors
    if held.shape[1] not in (0, size):
        raise ValueError(f"detections: vectors of {size} numbers; there were {held.shape[1]}")
    return state if held.shape[1] else state._replace(vectors=np.zeros((len(held), size)))


def _carried(
    state: TrackerState, motion: CameraMotion | None, frames: float
) -> tuple[TrackerState, Float[np.ndarray, "m 2"], Float[np.ndarray, "c k"]]:
    """All so many frames later, and moved with the picture.

    Also by how far the picture moves the objects, and the boxes of the chains.
    """
    objects, noise, chains = state.objects, state.noise, state.scores.boxes
    if motion is not None:
        objects = motion.carried(objects)
        noise = noise._replace(moments=motion.carried(noise.moments))
        chains = np.concatenate([motion.moved(chains[:, :2]), chains[:, 2:]], axis=1)
    gone = (objects.place - state.objects.place)[:, :2]
    _, place, velocity, _ = noise.noises
    objects = objects.predicted(place, velocity, objects.unit, frames)
    return state._replace(objects=objects, noise=noise.predicted(frames)), gone, chains


def _with_camera(
    state: TrackerState,
    found: Found,
    places: Float[np.ndarray, "d 4"],
    unlike: Float[np.ndarray, "m d"],
    motion: CameraMotion | None,
    gone: Float[np.ndarray, "m 2"],
) -> tuple[TrackerState, Float[np.ndarray, "2"]]:
    """Objects moved with what they have in common beside the motion from pixels, and by how far."""
    lives, errors = state.lives, state.noise.noises.errors
    known = motion is not None and bool(motion.known)
    seen = np.where(lives.confirmed & (lives.unseen == 0), lives.seen, 0)
    counts, strong = (found.scores >= least for least in (state.scores.weak, state.scores.strong))
    cost = mahalanobis(state.objects, errors, places, unlike)
    near = np.asarray(np.any(cost[:, counts] < 0, axis=1))
    jolt = jolted(state.objects, errors, places[counts], unlike[:, counts], seen, near)
    objects, confirmed = state.objects.shifted(jolt), lives.confirmed
    if jolt.any():
        cost = mahalanobis(objects, errors, places, unlike)
    box = np.exp(objects.place[confirmed, 2:].sum(axis=0) / max(confirmed.sum(), 1))
    told = gone[confirmed] + jolt, known, cost[np.ix_(confirmed, strong)], errors, places[strong]
    camera, shift = state.camera.after(objects.at(confirmed), *told, box)
    shift = jolt + shift
    noise = state.noise._replace(moments=state.noise.moments.shifted(shift))
    objects = state.objects.shifted(shift)
    return state._replace(objects=objects, noise=noise, camera=camera), shift


def _associated(
    state: TrackerState,
    cost: Float[np.ndarray, "m d"],
    strong: Bool[np.ndarray, " d"],
    counts: Bool[np.ndarray, " d"],
    temperature: float,
) -> tuple[Int[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """The detection of each object, -1 for none, and the probability that it is its own."""
    cost = cost + np.where(strong, 0.0, _WEAK_COST)
    cost += np.where(state.lives.confirmed, 0.0, _DOUBT_COST)[:, None]
    possible = counts & (cost < 0)
    cost = np.where(state.duplicates.doubtful[:, None], _YIELDING * cost, cost)
    cost = np.where(possible, cost, np.inf)
    source = one_to_one(cost)
    rows, probability = np.flatnonzero(source >= 0), np.zeros(len(source))
    probability[rows] = probabilities(cost, temperature)[rows, source[rows]]
    return source, probability


def _unexplained(
    tracker: ObjectTracker,
    state: TrackerState,
    objects: Gaussian,
    stays: Bool[np.ndarray, " m"],
    found: Found,
    doubles: Float[np.ndarray, "d d"],
    source: Int[np.ndarray, " m"],
    strong: Bool[np.ndarray, " d"],
) -> Bool[np.ndarray, " d"]:
    """Which strong detections begin an object: no object has them, or is there already."""
    covered = overlap(boxes_of(objects.place), found.boxes) > _BIRTH_OVERLAP
    covered &= _may_be_one(tracker, state.lives.classes[stays], found.classes)
    wanted = strong & within(found.boxes, found.extent) & ~covered.any(axis=0)
    wanted[source[source >= 0]] = False
    return wanted & ~(np.triu(doubles > _BIRTH_OVERLAP, 1) & wanted[:, None]).any(axis=0)
