"""The step of the tracker: prediction, comparison, association, update, survival, births."""

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from mpfjax.vision.tracking.associate import (
    compatible,
    learned_descriptors,
    mahalanobis,
    one_to_one,
    probabilities,
    unlikeness,
)
from mpfjax.vision.tracking.camera import find_jolt
from mpfjax.vision.tracking.detections import FrameDetections
from mpfjax.vision.tracking.gaussian import (
    CameraMotion,
    Gaussian,
    along,
    boxes_of,
    overlapping,
    shared,
    units,
    within,
)
from mpfjax.vision.tracking.kinds import Kind
from mpfjax.vision.tracking.lives import Lives, Spans
from mpfjax.vision.tracking.pairs import Pairs
from mpfjax.vision.tracking.scores import STRONG, WEAK
from mpfjax.vision.tracking.state import TrackerState, Tracks
from mpfjax.vision.tracking.vectors import cosine_distances

if TYPE_CHECKING:
    from mpfjax.vision.tracking.tracker import ObjectTracker

# Of a weak detection, of an object that is not confirmed, and of one of another class.
_WEAK_COST, _DOUBT_COST, _CLASS_COST = 8.0, 2.0, 8.0
WEAK_ERROR = 1.35  # times the error of a strong detection
_YIELDING = 0.01  # of the claim of an object that takes only what others leave
_BIRTH_OVERLAP = 0.5  # with an object or a stronger detection: it is one more box of the same
_SAME = 0.5  # least overlap of a prediction that was right with the detection
_CONTACT = 0.12  # an overlap from which on objects would learn each other's colours
_FIRST = 3  # strong detections of an object after which it teaches the noises


class _Frame(NamedTuple):
    """A frame's detections, and how they compare with the objects and with each other.

    - `frames`: since the last frame on which the detector ran.
    - `places`: (d, k), of the detections; `scores`: (d,), all equal if these are not to count.
    - `costs`: (m, d), what pairs cost beside distance; `distances`: (m, d), cosine distances of
      their vectors, (0, 0) without any.
    - `overlaps`: of detections that may be of one object.
    - `strong`: (d,), which are, and `counts`: which may be of an object.
    """

    detections: FrameDetections
    frames: float
    spans: Spans
    places: Float[np.ndarray, "d k"]
    scores: Float[np.ndarray, " d"]
    costs: Float[np.ndarray, "m d"]
    distances: Float[np.ndarray, "a b"]
    overlaps: Pairs
    strong: Bool[np.ndarray, " d"] = np.zeros(0, bool)
    counts: Bool[np.ndarray, " d"] = np.zeros(0, bool)


class _Matches(NamedTuple):
    """The detection of each object.

    - `columns`: (m,), which it is, -1 for none; `matched`: whether there is any; `strong`: a
      strong one.
    - `probabilities`: (m,), that it is the object's own; `gains`: (m,), of the object's log-odds.
    """

    columns: Int[np.ndarray, " m"]
    matched: Bool[np.ndarray, " m"]
    strong: Bool[np.ndarray, " m"]
    probabilities: Float[np.ndarray, " m"]
    gains: Float[np.ndarray, " m"]

    def values(self, values: np.ndarray, none: Any) -> np.ndarray:
        """The value of each object's detection, or another where there is none."""
        filled = np.concatenate([values, np.full((1, *values.shape[1:]), none, values.dtype)])
        return filled[self.columns]

    def renew(self, stays: Bool[np.ndarray, " m"], born: Int[np.ndarray, " b"]) -> "_Matches":
        """The matches of the objects that stay, and of those that begin at detections."""
        sure = np.ones(len(born))
        new = born, sure > 0, sure > 0, sure, 0.0 * sure
        return _Matches(*(np.append(a[stays], b) for a, b in zip(self, new, strict=True)))


def advance(
    tracker: "ObjectTracker",
    state: TrackerState,
    detections: FrameDetections | None,
    motion: CameraMotion | None = None,
    time: float | None = None,
) -> tuple[TrackerState, Tracks]:
    """A step with a frame's detections, or None where no detector ran."""
    frames, time = _frames_since(tracker, state, time)
    state, displacements, chains = _predicted(tracker.kind, state, motion, frames)
    frames += state.waited
    state = state._replace(number=state.number + 1, time=time, waited=frames)
    if detections is None:
        # Objects move on, and nothing is held against them.
        state = state._replace(scores=state.scores._replace(boxes=chains), full=False)
        none = np.full(len(state.lives.num_strong), -1)
        return state, _tracks(tracker.kind, state, none, np.zeros(len(none)), 0)
    detections.warn_of_first(state.left_out)
    state = state._replace(forms=detections.form_counts(state.forms))
    state, frame = _compare(tracker, state, detections, frames)
    is_known = motion is not None and bool(motion.known)
    state, shift = _with_camera(tracker.kind, state, frame, is_known, displacements)
    state, frame = _judge(tracker, state, frame, chains + along(chains, shift))
    return _associate(tracker, state, frame)


def _associate(
    tracker: "ObjectTracker", state: TrackerState, frame: _Frame
) -> tuple[TrackerState, Tracks]:
    """The part of a step that decides whose the detections are, with what follows from it."""
    matches = _match(tracker.kind, state, frame)
    predicted, state = state.objects, _update(state, frame, matches)
    state, stays = _survive(state, frame, matches, predicted)
    is_birth = _births(tracker, state, frame, matches, stays)
    born = np.flatnonzero(is_birth)[: tracker.max_objects - np.sum(stays)]
    state = _renew(tracker.kind, state, frame, matches, stays, born)
    renewed = matches.renew(stays, born)
    state = _describe(tracker, state, frame, matches, renewed, stays)
    number, detections = len(frame.places) - int(matches.matched.sum()), frame.detections
    state = state._replace(
        clutter=state.clutter.after(frame.places, number if state.has_begun else 0),
        full=bool(np.sum(is_birth) > len(born)), has_begun=True, waited=0.0,
        left_out=state.left_out + detections.left_out,
    )  # fmt: skip
    rows, left_out = renewed.values(detections.rows, -1), int(detections.left_out.sum())
    return state, _tracks(tracker.kind, state, rows, renewed.probabilities, left_out)


def _frames_since(
    tracker: "ObjectTracker", state: TrackerState, time: float | None
) -> tuple[float, float | None]:
    """Frames since the last one, and the time of this one in seconds, None where unknown."""
    if state.time is None:
        return 1.0, time
    if time is None:
        return 1.0, state.time + 1 / tracker.rate
    if time <= state.time:
        raise ValueError(f"time: {time} s is not after that of the frame before, {state.time} s")
    return (time - state.time) * tracker.rate, time


def _predicted(
    kind: Kind, state: TrackerState, motion: CameraMotion | None, frames: float
) -> tuple[TrackerState, Float[np.ndarray, "m 2"], Float[np.ndarray, "c k"]]:
    """All so many frames later, and moved with the picture.

    Also by how far the picture moves the objects, and the boxes of the chains.
    """
    objects, noise, chains = state.objects, state.noise, state.scores.boxes
    if motion is not None:
        motion = motion._replace(shift=motion.shift / kind.unit)
        objects = motion.carry(objects)
        noise = noise._replace(moments=motion.carry(noise.moments))
        chains = np.concatenate([motion.move(chains[:, :2]), chains[:, 2:]], axis=1)
    displacements = (objects.place - state.objects.place)[:, :2]
    _, place, velocity, _ = noise.noises
    objects = objects.predict(place, velocity, objects.unit, frames)
    state = state._replace(objects=objects, noise=noise.predict(frames))
    return state, displacements, chains


def _compare(
    tracker: "ObjectTracker", state: TrackerState, detections: FrameDetections, frames: float
) -> tuple[TrackerState, _Frame]:
    """What pairs cost beside distance, and which detections may be of one object."""
    if not tracker.class_matters:
        detections = detections._replace(classes=np.zeros_like(detections.classes))
    classes, colours, vectors = detections.classes, detections.colours, detections.vectors
    other_class = _CLASS_COST if tracker.class_matters == "prefers" else np.inf
    costs = np.broadcast_to(0.0, (len(state.lives.classes), len(classes)))
    if state.lives.classes.any() and classes.any():
        costs = np.where(compatible(state.lives.classes[:, None], classes), costs, other_class)
    if colours is not None:
        costs = costs + unlikeness(colours, state.colours)
    distances = np.zeros((0, 0))
    if vectors is not None:
        state = _with_vectors(state, vectors.shape[1])
        distances = cosine_distances(state.vectors, vectors)
        costs = costs + state.likeness.cost(distances)
    boxes = detections.boxes
    overlaps = _of_one_class(tracker, overlapping(boxes, boxes), classes, classes)
    spans, scores = Spans.at(tracker.rate, tracker.lost_seconds), detections.scores
    if tracker.scores == "ignore":
        scores = np.ones_like(scores)
    about = detections.places, scores, costs, distances, overlaps
    return state, _Frame(detections, frames, spans, *about)


def _with_vectors(state: TrackerState, size: int) -> TrackerState:
    """With room for vectors of this size, where there were none so far."""
    vectors = state.vectors
    if vectors.shape[1] not in (0, size):
        raise ValueError(f"detections: vectors of {size} numbers; there were {vectors.shape[1]}")
    return state if vectors.shape[1] else state._replace(vectors=np.zeros((len(vectors), size)))


def _with_camera(
    kind: Kind,
    state: TrackerState,
    frame: _Frame,
    is_known: bool,
    displacements: Float[np.ndarray, "m 2"],
) -> tuple[TrackerState, Float[np.ndarray, "2"]]:
    """Objects moved with what they have in common beside the motion from pixels, and by how far."""
    if not kind.has_boxes:
        return state, np.zeros(2)
    lives, errors = state.lives, state.noise.noises.errors
    places, scores, costs = frame.places, frame.scores, frame.costs
    num_strong = np.where(lives.confirmed & (lives.unseen == 0), lives.num_strong, 0)
    counts, strong = (scores >= least for least in (state.scores.weak, state.scores.strong))
    cost = mahalanobis(state.objects, errors, places, costs)
    near = np.zeros(len(num_strong), bool)
    near[cost.rows[(cost.values < 0) & counts[cost.columns]]] = True
    jolt = find_jolt(state.objects, errors, places, costs, num_strong, near, counts)
    objects, confirmed = state.objects.shift(jolt), lives.confirmed
    if jolt.any():
        cost = mahalanobis(objects, errors, places, costs)
    box = np.exp(objects.place[confirmed, 2:].sum(axis=0) / max(confirmed.sum(), 1))
    cost = cost.at(confirmed[cost.rows] & strong[cost.columns])
    about = objects, displacements + jolt, is_known, cost, errors, places, box
    camera, shift = state.camera.after(*about)
    shift = jolt + shift
    noise = state.noise._replace(moments=state.noise.moments.shift(shift))
    objects = state.objects.shift(shift)
    return state._replace(objects=objects, noise=noise, camera=camera), shift


def _judge(
    tracker: "ObjectTracker", state: TrackerState, frame: _Frame, chains: Float[np.ndarray, "c k"]
) -> tuple[TrackerState, _Frame]:
    """With the thresholds of the scores, and which detections are strong."""
    variance, scores = 2.0, frame.scores
    if not tracker.kind.has_boxes:
        variance += float(np.mean(state.noise.noises.speed**2))
    learned = state.scores.after(
        frame.detections.boxes, scores, frame.overlaps, chains, frame.frames,
        frame.spans.lasting, variance,
    )  # fmt: skip
    if tracker.scores == "as_given":
        learned = learned._replace(weak=WEAK, strong=STRONG)
    frame = frame._replace(strong=scores >= learned.strong, counts=scores >= learned.weak)
    return state._replace(scores=learned), frame


def _match(kind: Kind, state: TrackerState, frame: _Frame) -> _Matches:
    """The detection of each object, and the probability that it is its own."""
    others = 0.0 if kind.has_boxes else state.clutter.cost
    errors = state.noise.noises.errors
    distance = mahalanobis(state.objects, errors, frame.places, frame.costs, others)
    distance = distance.at(frame.counts[distance.columns])
    costs = distance.values + np.where(frame.strong, 0.0, _WEAK_COST)[distance.columns]
    costs += np.where(state.lives.confirmed, 0.0, _DOUBT_COST)[distance.rows]
    distance, costs = distance.at(costs < 0), costs[costs < 0]
    claims = np.where(state.duplicates.doubtful, _YIELDING, 1.0)[distance.rows]
    cost = distance._replace(values=claims * costs)
    columns = one_to_one(cost)
    matched, chosen = columns >= 0, columns[cost.rows] == cost.columns
    rows, probability = cost.rows[chosen], np.zeros(len(columns))
    probability[rows] = probabilities(cost, kind.temperature)[chosen]
    gains = np.where(matched, 0.0, kind.missed)
    if not kind.has_boxes:
        gains[rows] = -0.5 * distance.values[chosen]
    strong = np.append(frame.strong, False)[columns]
    return _Matches(columns, matched, strong, probability, gains)


def _update(state: TrackerState, frame: _Frame, matches: _Matches) -> TrackerState:
    """The objects follow their detections by the probabilities of the pairs."""
    rows = np.flatnonzero(matches.matched)
    before, place = state.objects.at(rows), frame.places[matches.columns[rows]]
    wider = np.where(matches.strong[rows], 1.0, WEAK_ERROR)[:, None]
    updated, _, _ = before.update(place, units(place) * state.noise.noises.errors * wider)
    objects = Gaussian(*map(np.copy, state.objects))
    objects.put(rows, updated.mix(before, matches.probabilities[rows, None]))
    return state._replace(objects=objects)


def _survive(
    state: TrackerState, frame: _Frame, matches: _Matches, predicted: Gaussian
) -> tuple[TrackerState, Bool[np.ndarray, " m"]]:
    """Counts of frames, which objects live on, and how right the predictions of the lost were."""
    lives, spans, matched = state.lives, frame.spans, matches.matched
    coast = state.coasting.longest(spans)
    counts = matched, matches.strong, frame.frames, spans, coast, state.full
    lives_now, stays = lives.advance(*counts, matches.gains)
    extent = frame.detections.extent
    stays &= within(boxes_of(state.objects.place), extent, centred=~matched)
    right, rows = matched.copy(), np.flatnonzero(matched)
    boxes = frame.detections.boxes[matches.columns[rows]]
    right[rows] = shared(boxes_of(predicted.place[rows]), boxes) >= _SAME
    ended = lives.confirmed & np.where(matched, ~right, ~stays)
    unseen = lives.unseen + np.where(matched, 0.0, frame.frames)
    coasting = state.coasting.after(unseen, lives.confirmed & right, ended, spans)
    return state._replace(lives=lives_now, coasting=coasting), stays


def _births(
    tracker: "ObjectTracker",
    state: TrackerState,
    frame: _Frame,
    matches: _Matches,
    stays: Bool[np.ndarray, " m"],
) -> Bool[np.ndarray, " d"]:
    """Which strong detections begin an object: no object has them, or is there already."""
    boxes, classes, extent = (getattr(frame.detections, n) for n in ("boxes", "classes", "extent"))
    covered = overlapping(boxes_of(state.objects.place[stays]), boxes, _BIRTH_OVERLAP)
    covered = _of_one_class(tracker, covered, state.lives.classes[stays], classes)
    is_birth = frame.strong & within(boxes, extent)
    is_birth[covered.columns] = is_birth[matches.columns[matches.matched]] = False
    others = frame.overlaps.at(frame.overlaps.values > _BIRTH_OVERLAP)
    is_first = others.rows < others.columns
    is_birth[others.columns[is_first & is_birth[others.rows]]] = False
    return is_birth


def _renew(
    kind: Kind,
    state: TrackerState,
    frame: _Frame,
    matches: _Matches,
    stays: Bool[np.ndarray, " m"],
    born: Int[np.ndarray, " b"],
) -> TrackerState:
    """Without the objects that end, and with those that begin; the former teach the noises."""
    objects, lives, noises = state.objects, state.lives, state.noise.noises
    places = frame.places[born]
    teaches = matches.strong & stays
    experienced = teaches & lives.confirmed & (lives.num_strong >= _FIRST)
    grown = objects.at(teaches & (lives.num_strong == _FIRST))
    noise = state.noise.after(matches.columns, frame.places, experienced, grown)
    noise = noise.renew(stays, places, noises.speed)
    unit = units(places)
    start = Gaussian.initial(places, unit * noises.errors, unit * noises.speed)
    names = state.last_identity + 1 + np.arange(len(born))
    # The scores of a first frame have hardly a rank: a single one is always the highest.
    is_first = kind.has_boxes and not state.has_begun
    at_once = is_first & (frame.scores[born] >= STRONG)
    new_lives = Lives.initial(names, frame.detections.classes[born], at_once, kind.odds)
    colours, vectors = (
        np.append(rows[stays], np.zeros((len(born), rows.shape[1])), axis=0)
        for rows in (state.colours, state.vectors)
    )
    return state._replace(
        objects=objects.at(stays).append(start), lives=lives.at(stays).append(new_lives),
        noise=noise, colours=colours, vectors=vectors,
        last_identity=state.last_identity + len(born),
    )  # fmt: skip


def _describe(
    tracker: "ObjectTracker",
    state: TrackerState,
    frame: _Frame,
    matches: _Matches,
    renewed: _Matches,
    stays: Bool[np.ndarray, " m"],
) -> TrackerState:
    """Scores, classes, colours and vectors of the objects, and which are second boxes."""
    detections, matched = frame.detections, renewed.matched
    values = renewed.values(detections.classes, 0), renewed.values(detections.scores, 0.0)
    lives = state.lives.describe(matched, *values)
    boxes = boxes_of(state.objects.place)
    overlaps = _of_one_class(tracker, overlapping(boxes, boxes), lives.classes, lives.classes)
    duplicates = state.duplicates.after(lives.identities, stays, matched, overlaps)
    lives = lives._replace(shown=lives.shown & ~duplicates.doubtful)
    contacts = overlaps.rows[overlaps.values > _CONTACT]  # each overlaps itself
    alone = np.bincount(contacts, minlength=len(boxes)) <= 1
    colours, vectors, likeness = state.colours, state.vectors, state.likeness
    if detections.colours is not None:
        values = renewed.values(detections.colours, 0.0)
        colours = learned_descriptors(colours, values, alone)
    if detections.vectors is not None:
        values = renewed.values(detections.vectors, 0.0)
        vectors = learned_descriptors(vectors, values, alone)
        same = matches.columns[:, None] == np.arange(len(frame.places))
        likeness = likeness.after(frame.distances, same)
    return state._replace(
        lives=lives, duplicates=duplicates, colours=colours, vectors=vectors, likeness=likeness
    )


def _tracks(
    kind: Kind, state: TrackerState, rows: np.ndarray, probability: np.ndarray, left_out: int
) -> Tracks:
    lives = state.lives
    boxes = boxes_of(state.objects.place) * kind.unit
    about = lives.identities, lives.confirmed, lives.unseen, state.full, lives.shown
    return Tracks(
        boxes, *about, rows, probability, lives.classes, lives.scores, left_out, state.number
    )


def _of_one_class(
    tracker: "ObjectTracker", pairs: Pairs, a: Int[np.ndarray, " m"], b: Int[np.ndarray, " d"]
) -> Pairs:
    """The pairs that may be of one object by their classes."""
    if tracker.class_matters == "prefers":
        return pairs
    return pairs.at(compatible(a[pairs.rows], b[pairs.columns]))
