"""The step of the tracker: prediction, comparison, association, update, survival, births."""

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from mpfjax.checks import warn
from mpfjax.vision.tracking import associate, gaussian
from mpfjax.vision.tracking.camera import find_jolt
from mpfjax.vision.tracking.detections import FrameDetections, Kind
from mpfjax.vision.tracking.gaussian import CameraMotion, Gaussian
from mpfjax.vision.tracking.lives import BESIDE, Lives, Spans
from mpfjax.vision.tracking.pairs import Flags, Integers, Numbers, Pairs
from mpfjax.vision.tracking.scores import STRONG, WEAK
from mpfjax.vision.tracking.state import TrackerState, Tracks

if TYPE_CHECKING:
    from mpfjax.vision.tracking.tracker import ObjectTracker

_WEAK_COST, _DOUBT_COST = 8.0, 2.0  # of a weak detection, and an object that is not confirmed
WEAK_ERROR = 1.35  # times the error of a strong detection
_FAST = np.ones(2)  # boxes a frame along x and y, the deviation of few new objects' velocities
_FAST_COST = 3.0  # of a pair that is explained by it
_YIELDING = 0.01  # of the claim of an object that takes only what others leave
_BIRTH_OVERLAP = 0.5  # with an object or a stronger detection: it is one more box of the same
_LEAST_AGE = 2  # frames of a chain of detections after which its object is confirmed at once
_SAME = 0.5  # least overlap of a prediction that was right with the detection
_CONTACT = 0.12  # an overlap from which on objects would learn each other's colours
_FIRST = 3  # strong detections of an object after which it teaches the noises
Born = Int[np.ndarray, " b"]  # the rows of detections at which objects begin


class _Frame(NamedTuple):
    """A frame's detections, and how they compare with the objects and with each other.

    - `frames`: since the last frame on which the detector ran.
    - `places`: (d, k), of the detections.
    - `costs`: (m, d), what pairs cost beside distance; `distances`: (m, d), cosine distances of
      their vectors, (0, 0) without any.
    - `overlaps`: of detections that may be of one object.
    - `strong`: (d,), which are, and `counts`: which may be of an object.
    """

    detections: FrameDetections
    frames: float
    spans: Spans
    places: Float[np.ndarray, "d k"]
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

    columns: Integers
    matched: Flags
    strong: Flags
    probabilities: Numbers
    gains: Numbers

    def values(self, values: np.ndarray, none: Any) -> np.ndarray:
        """The value of each object's detection, or another where there is none."""
        filled = np.concatenate([values, np.full((1, *values.shape[1:]), none, values.dtype)])
        return filled[self.columns]

    def renew(self, stays: Flags, born: Born) -> "_Matches":
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
        return state, _tracks(tracker.kind, state, none, np.zeros(len(none)))
    if detections.warning and not state.has_faults:
        warn(detections.warning)
    has_faults = state.has_faults or bool(detections.warning)
    state = state._replace(forms=detections.form_counts(state.forms), has_faults=has_faults)
    state, frame = _compare(tracker, state, detections, frames)
    state, shift = _with_camera(tracker.kind, state, frame, motion is not None, displacements)
    state, frame = _judge(tracker, state, frame, chains + gaussian.along(chains, shift))
    return _associate(tracker, state, frame)


def _associate(
    tracker: "ObjectTracker", state: TrackerState, frame: _Frame
) -> tuple[TrackerState, Tracks]:
    """The part of a step that decides whose the detections are, with what follows from it."""
    state, matches = _follow_fast(tracker.kind, state, frame, _match(tracker.kind, state, frame))
    predicted, state = state.objects, _update(state, frame, matches)
    state, stays = _survive(state, frame, matches, predicted)
    is_birth = _births(state, frame, matches, stays)
    born = np.flatnonzero(is_birth)[: tracker.max_objects - np.sum(stays)]
    state = _renew(tracker.kind, state, frame, matches, stays, born)
    renewed = matches.renew(stays, born)
    state = _describe(state, frame, matches, renewed, stays)
    number = len(frame.places) - int(matches.matched.sum()) if state.has_begun else 0
    clutter, full = state.clutter.after(frame.places, number), bool(np.sum(is_birth) > len(born))
    state = state._replace(clutter=clutter, full=full, has_begun=True, waited=0.0)
    rows = renewed.values(frame.detections.rows, -1)
    return state, _tracks(tracker.kind, state, rows, renewed.probabilities)


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
    classes, colours, vectors = detections.classes, detections.colours, detections.vectors
    costs = np.broadcast_to(0.0, (len(state.lives.classes), len(classes)))
    if state.lives.classes.any() and classes.any():
        costs = np.where(associate.compatible(state.lives.classes[:, None], classes), costs, np.inf)
    if colours is not None:
        costs = costs + associate.unlikeness(colours, state.colours)
    distances = np.zeros((0, 0))
    if vectors is not None:
        state = _with_vectors(state, vectors.shape[1])
        distances = associate.cosine_distances(state.vectors, vectors)
        costs = costs + state.likeness.cost(distances)
    boxes = detections.boxes
    overlaps = _of_one_class(gaussian.overlapping(boxes, boxes, 0.0), classes, classes)
    places = gaussian.places_of(boxes)
    return state, _Frame(detections, frames, tracker.spans, places, costs, distances, overlaps)


def _with_vectors(state: TrackerState, size: int) -> TrackerState:
    """With room for vectors of this size, where there were none so far."""
    vectors = state.vectors
    if vectors.shape[1] not in (0, size):
        raise ValueError(f"detections: vectors of {size} numbers; there were {vectors.shape[1]}")
    return state if vectors.shape[1] else state._replace(vectors=np.zeros((len(vectors), size)))


def _with_camera(
    kind: Kind, state: TrackerState, frame: _Frame, is_known: bool, displacements: np.ndarray
) -> tuple[TrackerState, Float[np.ndarray, "2"]]:
    """Objects moved with what they have in common beside the motion from pixels, and by how far."""
    if not kind.has_boxes:
        return state, np.zeros(2)
    errors, confirmed = state.noise.noises.errors, state.lives.confirmed
    cost = associate.mahalanobis(state.objects, errors, frame.places, frame.costs)
    jolt, objects = _jolt(state, frame, cost), state.objects
    if jolt.any():
        objects = objects.shift(jolt)
        cost = associate.mahalanobis(objects, errors, frame.places, frame.costs)
    # An object and a detection tell the motion if each has its least cost with the other.
    strong = frame.detections.scores >= state.scores.strong
    cost = cost.at(confirmed[cost.rows] & strong[cost.columns])
    partner = cost._replace(values=-cost.values).partners
    rows = np.flatnonzero(partner >= 0)
    gaps = (frame.places[partner[rows]] - objects.place[rows])[:, :2]
    variances = (objects.var_place + (objects.unit * errors) ** 2)[rows, :2]
    box = np.exp(objects.place[confirmed, 2:].sum(axis=0) / max(confirmed.sum(), 1))
    camera, shift = state.camera.after(gaps, variances, (displacements + jolt)[rows], is_known, box)
    faster, shift = camera.steady * shift / frame.frames, jolt + shift
    noise = state.noise._replace(moments=state.noise.moments.shift(shift, faster))
    objects = state.objects.shift(shift, faster)
    return state._replace(objects=objects, noise=noise, camera=camera), shift


def _jolt(state: TrackerState, frame: _Frame, cost: Pairs) -> Float[np.ndarray, "2"]:
    """The shift of a jolt after which most objects have no detection near them, or zero."""
    lives, counts = state.lives, frame.detections.scores >= state.scores.weak
    near = np.unique(cost.rows[(cost.values < 0) & counts[cost.columns]])
    lately = np.flatnonzero(lives.confirmed & (lives.unseen == 0) & (lives.num_strong > 0))
    lately = lately[np.argsort(-lives.num_strong[lately], kind="stable")]
    num_near = int(np.isin(lately, near).sum())
    if 2 * num_near > len(lately) or len(lately) < num_near + 2:
        return np.zeros(2)
    errors, unlike = state.noise.noises.errors, frame.costs[np.ix_(lately, counts)]
    about = errors, frame.places[counts], unlike, num_near
    return find_jolt(state.objects.at(lately), lives.num_strong[lately], *about)


def _judge(
    tracker: "ObjectTracker", state: TrackerState, frame: _Frame, chains: np.ndarray
) -> tuple[TrackerState, _Frame]:
    """With the thresholds of the scores, and which detections are strong."""
    variance, boxes, scores = 2.0, frame.detections.boxes, frame.detections.scores
    if not tracker.kind.has_boxes:
        variance += float(np.mean(state.noise.noises.speed**2))
    learned = state.scores.after(boxes, scores, frame.overlaps, chains, frame.frames, variance)
    if tracker.scores == "as_given":
        learned = learned._replace(weak=WEAK, strong=STRONG)
    frame = frame._replace(strong=scores >= learned.strong, counts=scores >= learned.weak)
    return state._replace(scores=learned), frame


def _match(kind: Kind, state: TrackerState, frame: _Frame) -> _Matches:
    """The detection of each object, and the probability that it is its own."""
    others = 0.0 if kind.has_boxes else state.clutter.cost
    errors = state.noise.noises.errors
    distance = associate.mahalanobis(state.objects, errors, frame.places, frame.costs, others)
    distance = distance.at(frame.counts[distance.columns])
    costs = distance.values + np.where(frame.strong, 0.0, _WEAK_COST)[distance.columns]
    costs += np.where(state.lives.confirmed, 0.0, _DOUBT_COST)[distance.rows]
    distance, costs = distance.at(costs < 0), costs[costs < 0]
    claims = np.where(state.duplicates.doubtful, _YIELDING, 1.0)[distance.rows]
    cost = distance._replace(values=claims * costs)
    columns = associate.one_to_one(cost)
    matched, chosen = columns >= 0, columns[cost.rows] == cost.columns
    rows, probability = cost.rows[chosen], np.zeros(len(columns))
    probability[rows] = associate.probabilities(cost, kind.temperature)[chosen]
    gains = np.where(matched, 0.0, kind.missed)
    if not kind.has_boxes:
        gains[rows] = -0.5 * distance.values[chosen]
    strong = np.append(frame.strong, False)[columns]
    return _Matches(columns, matched, strong, probability, gains)


def _follow_fast(
    kind: Kind, state: TrackerState, frame: _Frame, matches: _Matches
) -> tuple[TrackerState, _Matches]:
    """With what is left of the strong detections, for new objects that have none near them.

    The velocity of a new object has a second prior, with a deviation of one box in a frame: an
    oncoming car is as fast at ten frames a second, and no track of it would begin otherwise.
    """
    is_new = (state.lives.num_strong == 1) & (state.lives.unseen == 0) & ~matches.matched
    rows, free = np.flatnonzero(is_new & kind.has_boxes), frame.strong.copy()
    free[matches.columns[matches.matched]] = False
    if not len(rows) or not free.any():
        return state, matches
    slow, errors = state.objects.at(rows), state.noise.noises.errors
    fast = slow.accelerate(gaussian.along(slow.place, _FAST) * slow.unit, frame.frames)
    beside = frame.costs[rows] + _DOUBT_COST + _FAST_COST
    cost = associate.mahalanobis(fast, errors, frame.places, beside)
    cost = cost.at((cost.values < 0) & free[cost.columns])
    chosen = associate.one_to_one(cost)[cost.rows] == cost.columns
    again, pairs = rows[cost.rows[chosen]], cost.columns[chosen]
    objects, matches = Gaussian(*map(np.copy, state.objects)), _Matches(*map(np.copy, matches))
    objects.put(again, fast.at(cost.rows[chosen]))
    matches.columns[again], matches.matched[again], matches.strong[again] = pairs, True, True
    matches.probabilities[again] = associate.probabilities(cost, kind.temperature)[chosen]
    return state._replace(objects=objects), matches


def _update(state: TrackerState, frame: _Frame, matches: _Matches) -> TrackerState:
    """The objects follow their detections by the probabilities of the pairs."""
    rows = np.flatnonzero(matches.matched)
    before, place = state.objects.at(rows), frame.places[matches.columns[rows]]
    wider = np.where(matches.strong[rows], 1.0, WEAK_ERROR)[:, None]
    updated, _, _ = before.update(place, gaussian.units(place) * state.noise.noises.errors * wider)
    objects = Gaussian(*map(np.copy, state.objects))
    objects.put(rows, updated.mix(before, matches.probabilities[rows, None]))
    return state._replace(objects=objects)


def _survive(
    state: TrackerState, frame: _Frame, matches: _Matches, predicted: Gaussian
) -> tuple[TrackerState, Flags]:
    """Counts of frames, which objects live on, and how right the predictions of the lost were."""
    lives, spans, matched = state.lives, frame.spans, matches.matched
    coast = state.coasting.longest(spans)
    lives_now = lives._replace(odds=lives.odds + matches.gains)
    counts = matched, matches.strong, frame.frames, spans, coast, state.full
    lives_now, stays = lives_now.advance(*counts)
    extent = frame.detections.extent
    stays &= gaussian.within(gaussian.boxes_of(state.objects.place), extent, centred=~matched)
    right, rows = matched.copy(), np.flatnonzero(matched)
    boxes = frame.detections.boxes[matches.columns[rows]]
    right[rows] = gaussian.shared(gaussian.boxes_of(predicted.place[rows]), boxes) >= _SAME
    ended = lives.confirmed & np.where(matched, ~right, ~stays)
    unseen = lives.unseen + np.where(matched, 0.0, frame.frames)
    coasting = state.coasting.after(unseen, lives.confirmed & right, ended, spans)
    return state._replace(lives=lives_now, coasting=coasting), stays


def _births(
    state: TrackerState, frame: _Frame, matches: _Matches, stays: Flags
) -> Bool[np.ndarray, " d"]:
    """Which strong detections begin an object: no object has them, or is there already."""
    boxes, classes = frame.detections.boxes, frame.detections.classes
    objects = gaussian.boxes_of(state.objects.place[stays])
    covered = gaussian.overlapping(objects, boxes, _BIRTH_OVERLAP)
    covered = _of_one_class(covered, state.lives.classes[stays], classes)
    is_birth = frame.strong & gaussian.within(boxes, frame.detections.extent)
    is_birth[covered.columns] = is_birth[matches.columns[matches.matched]] = False
    others = frame.overlaps.at(frame.overlaps.values > _BIRTH_OVERLAP)
    is_first = others.rows < others.columns
    is_birth[others.columns[is_first & is_birth[others.rows]]] = False
    return is_birth


def _end_long_chains(
    state: TrackerState, frame: _Frame, stays: Flags, born: Born
) -> Bool[np.ndarray, " b"]:
    """Which births end a chain of weaker detections that has lasted, and are beside no object."""
    objects, boxes = gaussian.boxes_of(state.objects.place[stays]), frame.detections.boxes[born]
    is_long = state.scores.ages[born] >= max(frame.spans.unsure, _LEAST_AGE)
    is_long[gaussian.overlapping(objects, boxes, BESIDE).columns] = False
    return is_long


def _renew(
    kind: Kind, state: TrackerState, frame: _Frame, matches: _Matches, stays: Flags, born: Born
) -> TrackerState:
    """Without the objects that end, and with those that begin; the former teach the noises."""
    objects, lives, noises = state.objects, state.lives, state.noise.noises
    places = frame.places[born]
    teaches = matches.strong & stays
    experienced = teaches & lives.confirmed & (lives.num_strong >= _FIRST)
    grown = objects.at(teaches & (lives.num_strong == _FIRST))
    noise = state.noise.after(matches.columns, frame.places, experienced, grown)
    noise = noise.renew(stays, places, noises.speed)
    unit = gaussian.units(places)
    start = Gaussian.initial(places, unit * noises.errors, unit * noises.speed)
    names = state.last_identity + 1 + np.arange(len(born))
    # The scores of a first frame have hardly a rank: a single one is always the highest.
    is_first = kind.has_boxes and not state.has_begun
    at_once = is_first & (frame.detections.scores[born] >= STRONG)
    at_once |= kind.has_boxes & _end_long_chains(state, frame, stays, born)
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
    state: TrackerState, frame: _Frame, matches: _Matches, renewed: _Matches, stays: np.ndarray
) -> TrackerState:
    """Scores, classes, colours and vectors of the objects, and which are second boxes."""
    detections, matched, lives = frame.detections, renewed.matched, state.lives
    classes = np.where(lives.classes > 0, lives.classes, renewed.values(detections.classes, 0))
    scores = np.where(matched, renewed.values(detections.scores, 0.0), lives.scores)
    lives = lives._replace(classes=classes, scores=scores)
    boxes = gaussian.boxes_of(state.objects.place)
    overlaps = _of_one_class(gaussian.overlapping(boxes, boxes, 0.0), lives.classes, lives.classes)
    duplicates = state.duplicates.after(lives.identities, stays, matched, overlaps)
    lives = lives._replace(shown=lives.shown & ~duplicates.doubtful)
    contacts = overlaps.rows[overlaps.values > _CONTACT]  # each overlaps itself
    alone = np.bincount(contacts, minlength=len(boxes)) <= 1
    colours, vectors, likeness = state.colours, state.vectors, state.likeness
    if detections.colours is not None:
        values = renewed.values(detections.colours, 0.0)
        colours = associate.learned_descriptors(colours, values, alone)
    if detections.vectors is not None:
        values = renewed.values(detections.vectors, 0.0)
        vectors = associate.learned_descriptors(vectors, values, alone)
        same = matches.columns[:, None] == np.arange(len(frame.places))
        likeness = likeness.after(frame.distances, same)
    return state._replace(
        lives=lives, duplicates=duplicates, colours=colours, vectors=vectors, likeness=likeness
    )


def _tracks(kind: Kind, state: TrackerState, rows: Integers, probabilities: Numbers) -> Tracks:
    lives = state.lives
    boxes = gaussian.boxes_of(state.objects.place) * kind.unit
    about = lives.identities, lives.confirmed, lives.unseen, state.full, lives.shown
    return Tracks(boxes, *about, rows, probabilities, lives.classes, lives.scores, state.number)


def _of_one_class(pairs: Pairs, a: Int[np.ndarray, " m"], b: Int[np.ndarray, " d"]) -> Pairs:
    """The pairs that may be of one object by their classes."""
    return pairs.at(associate.compatible(a[pairs.rows], b[pairs.columns]))
