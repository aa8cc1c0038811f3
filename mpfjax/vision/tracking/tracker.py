"""A tracker of an unknown number of objects, from detections: a Kalman filter for each."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key, UInt8

from mpfjax.checks import (
    check_finite,
    check_one_of,
    check_positive,
    check_type,
    check_whole,
    given,
    shown,
)
from mpfjax.vision.colour.bins import HSVColours
from mpfjax.vision.colour.histograms import normalise
from mpfjax.vision.colour.sampled_histograms import SampledBoxes
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
from mpfjax.vision.tracking.camera import CameraState
from mpfjax.vision.tracking.detections import Detections
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
from mpfjax.vision.tracking.lives import Doubles, Guesses, Lives, Spans
from mpfjax.vision.tracking.noise import NoiseState
from mpfjax.vision.tracking.scores import ScoreState
from mpfjax.vision.tracking.state import TrackerState, Tracks

_COLOURS, _BANDS = HSVColours(8, 4, 6), 3
# Of a weak detection, of an object that is not confirmed, and of one with another label.
_WEAK_COST, _DOUBT_COST, _LABEL_COST = 8.0, 2.0, 8.0
_WEAK_ERROR = 1.35  # times the error of a strong detection
_YIELDING = 0.01  # of the claim of an object that takes only what others leave
_BIRTH_OVERLAP = 0.5  # with an object or a stronger detection: it is one more box of the same
_SAME = 0.5  # least overlap of a prediction that was right with the detection
_CONTACT = 0.12  # an overlap from which on objects would learn each other's colours
_FIRST = 3  # strong detections of an object after which it teaches the noises


class ObjectTracker(eqx.Module):
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
    - `scores`: "learned" finds from which score on a detection is strong, and starts an object.
      "ignore" takes all for strong. A pair (weak, strong) has thresholds of your own: below weak a
      detection counts for nothing.
    - `class_matters`: "always" pairs objects with detections of their own label only, and does not
      take those of another one for doubles. "prefers" is for detectors that mix up classes: another
      label costs as much as a weak score does. False does not look at labels. The label 0 is none,
      and goes with all.

    Raises `ValueError` for a number of objects that is not whole, or below 1, a rate that is not
    positive, and scores or classes that are none of these.
    """

    max_objects: int = eqx.field(static=True)
    rate: Float[Array | np.ndarray, ""]
    scores: str | tuple[float, float] = eqx.field(static=True)
    class_matters: str | bool = eqx.field(static=True)

    def __init__(
        self,
        max_objects: int = 24,
        *,
        frames_per_second: float | None = None,
        scores: str | tuple[float, float] = "learned",
        class_matters: str | bool = "always",
    ) -> None:
        check_whole(max_objects=max_objects)
        check_positive(**given(frames_per_second=frames_per_second))
        self.max_objects = max_objects
        # An array, so that one program serves all rates.
        self.rate = np.asarray(frames_per_second or 25, np.float32)
        self.scores = _checked_scores(scores)
        if class_matters is not False:
            check_one_of(("always", "prefers"), class_matters=class_matters)
        self.class_matters = class_matters

    def init(self) -> TrackerState:
        """The state before the first frame: no objects."""
        m = self.max_objects
        state = TrackerState(
            objects=Gaussian.nowhere(m),
            lives=Lives.initial(m),
            guesses=Guesses.initial(),
            doubles=Doubles.initial(m),
            scores=ScoreState.initial(m),
            camera=CameraState.initial(),
            noise=NoiseState.initial(m, float(self.rate)),
            colours=zeros(m, _BANDS * _COLOURS.num_bins),
        )
        return jax.tree.map(jnp.asarray, state)

    def step(
        self,
        key: Key[Array, ""] | None,
        state: TrackerState,
        frame: UInt8[np.ndarray, "h w 3"] | SampledBoxes | None,
        detections: Detections,
        motion: CameraMotion | None = None,
    ) -> tuple[TrackerState, Tracks]:
        """The state after a frame and its detections, and the tracks in it.

        The result of `look` may be given in place of the frame. Where `frame` is None detections
        are tracked alone, without colours. `motion` is what `OpticalFlow` makes of the frames; None
        leaves the camera's motion to the detections. Nothing is drawn: the key may be None. Raises
        `ValueError` for a frame that is not (h, w, 3) of type uint8, and for anything but
        `Detections` and a state of `init`.
        """
        del key
        check_type(Detections, "Detections, as from_boxes makes them", detections=detections)
        check_type(TrackerState, "a state, as init and step return it", state=state)
        if frame is not None and not isinstance(frame, SampledBoxes):
            frame = self.look(frame, detections)
        return _advanced(self, state, detections, frame, motion)

    def look(self, frame: UInt8[np.ndarray, "h w 3"], detections: Detections) -> SampledBoxes:
        """The part of a frame that `step` needs: the detections' colours.

        Raises `ValueError` for a frame as `step` does.
        """
        return SampledBoxes.of(np.asarray(frame), np.asarray(detections.boxes), _COLOURS, _BANDS)


def _checked_scores(scores: Any) -> str | tuple[float, float]:
    if isinstance(scores, str) and scores in ("learned", "ignore"):
        return scores
    if not isinstance(scores, tuple) or len(scores) != 2:
        raise ValueError(
            f'scores: {shown(scores)} is neither "learned" nor "ignore", nor a pair (weak, strong)'
        )
    weak, strong = scores
    check_finite(**{"scores: weak": weak, "scores: strong": strong})
    if weak > strong:
        raise ValueError(f"scores: the weak one, {weak}, is above the strong one, {strong}")
    return float(weak), float(strong)


class _Found(NamedTuple):
    """The detections of a frame, and what they are to each other.

    - `places`: (d, 4); `colours`: (d, bins), None without pixels; `extent`: of the frame.
    - `stronger`: (d, d), whether the first of a pair is; `overlaps`: (d, d).
    """

    detections: Detections
    places: Float[Array, "d 4"]
    colours: Float[Array, "d bins"] | None
    extent: Float[Array, "4"]
    stronger: Bool[Array, "d d"]
    overlaps: Float[Array, "d d"]

    @classmethod
    def of(cls, detections: Detections, seen: SampledBoxes | None) -> "_Found":
        """Compare all with all."""
        colours, extent, boxes = None, detections.extent, detections.boxes
        if seen is not None:
            extent = jnp.array([0, 0, 1, 1]) * jnp.tile(jnp.stack([seen.width, seen.height]), 2)
            extent = extent.astype(boxes.dtype)
            colours = normalise(seen.counts(_BANDS)).reshape(len(boxes), -1)
        ranked = stronger(detections.scores, jnp.prod(boxes[:, 2:], axis=1))
        return cls(detections, places_of(boxes), colours, extent, ranked, overlap(boxes, boxes))


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


def advanced(
    tracker: ObjectTracker,
    state: TrackerState,
    detections: Detections,
    seen: SampledBoxes | None = None,
    motion: CameraMotion | None = None,
) -> tuple[TrackerState, Tracks]:
    """A step as a pure function, for `jax.lax.scan` and for programs of your own."""
    if tracker.scores == "ignore":
        same = jnp.ones_like(detections.scores)
        detections = eqx.tree_at(lambda found: found.scores, detections, same)
    found, lives = _Found.of(detections, seen), state.lives
    spans = Spans.at(jnp.asarray(tracker.rate))
    labels = jnp.broadcast_to(detections.labels, detections.valid.shape).astype(jnp.int32)
    alike = compatible(lives.labels, labels)
    strictly = tracker.class_matters == "always"
    if strictly:
        together = compatible(labels, labels)
        found = found._replace(overlaps=jnp.where(together, found.overlaps, 0.0))
    unlike = unlikeness(found.colours, state.colours)
    if tracker.class_matters == "prefers":
        unlike += jnp.where(alike, 0.0, _LABEL_COST)
    unlike = jnp.where(alike | (not strictly), unlike, jnp.inf)

    objects, noise, camera, shift = _moved(state, found, unlike, motion)
    errors, speed = noise.noises.errors, noise.noises.speed
    scores = state.scores.after(detections, found.stronger, found.overlaps, shift, spans.lasting)
    if isinstance(tracker.scores, tuple):
        weak, strong = (jnp.full_like(scores.weak, score) for score in tracker.scores)
        scores = scores._replace(weak=weak, strong=strong)
    strong = detections.valid & (detections.scores >= scores.strong)

    cost = mahalanobis(objects, errors, found.places) + unlike
    cost += jnp.where(strong, 0.0, _WEAK_COST)[None]
    cost += jnp.where(lives.confirmed, 0.0, _DOUBT_COST)[:, None]
    counts = detections.valid & (detections.scores >= scores.weak)
    possible = lives.alive[:, None] & counts[None] & (cost < 0)
    cost = jnp.where(state.doubles.doubtful[:, None], _YIELDING * cost, cost)
    cost = jnp.where(possible, cost, jnp.inf)
    probability, source = probabilities(cost), one_to_one(cost)
    taken = _Taken.of(source, strong, found)
    predicted = boxes_of(objects.place)
    right = shared(predicted, detections.boxes[taken.rows]) >= _SAME
    error = units(taken.place) * errors[None] * jnp.where(taken.strong, 1.0, _WEAK_ERROR)[:, None]
    updated, _, _ = objects.updated(taken.place, error)
    trust = jnp.take_along_axis(probability, taken.rows[:, None], axis=1)
    objects = updated.mixed_with(objects, jnp.where(taken.there[:, None], trust, 0.0))

    boxes = boxes_of(objects.place)
    inside = within(boxes, found.extent, centred=~taken.there)
    guess = state.guesses.longest(spans)
    stayed = lives.counted(taken.there, taken.strong, inside, spans, guess)
    guesses = state.guesses.after(lives, stayed, taken.there, right, spans)

    stays = stayed.alive
    covered = stays[:, None] & (overlap(boxes, detections.boxes) > _BIRTH_OVERLAP)
    covered &= alike | (not strictly)
    free = jnp.ones_like(strong).at[_or_past(source, strong)].set(False, mode="drop")
    wanted = strong & free & within(detections.boxes, found.extent) & ~jnp.any(covered, axis=0)
    doubles = (found.overlaps > _BIRTH_OVERLAP) & wanted[:, None] & found.stronger
    wanted &= ~jnp.any(doubles, axis=0)
    begun = seated(wanted, found.stronger, ~stays)
    taken = _Taken.of(jnp.where(stays, source, begun), strong, found)
    born, unit = begun >= 0, units(taken.place)
    start = Gaussian.begun(taken.place, unit * errors[None], unit * speed[None])
    objects = start.where(born, objects)
    told = jnp.where(taken.there, labels[taken.rows], 0)
    lives = stayed.begins(born, told, jnp.sum(wanted, dtype=jnp.int32))

    boxes = boxes_of(objects.place)
    overlaps = overlap(boxes, boxes)
    if strictly:
        overlaps = jnp.where(compatible(lives.labels, lives.labels), overlaps, 0.0)
    second = state.doubles.after(lives.identities, stays, taken.there, overlaps)
    lives = lives._replace(shown=lives.shown & ~second.doubtful)
    teaches = taken.strong & stays
    noise = noise.after(
        taken.place,
        taken.there & stays,
        teaches & lives.confirmed & (lives.seen >= _FIRST),
        born,
        teaches & (lives.seen == _FIRST),
        objects,
    )
    colours = state.colours
    if found.colours is not None:
        others = lives.alive[None] & ~jnp.eye(len(boxes), dtype=bool)
        alone = ~jnp.any((overlaps > _CONTACT) & others, axis=1)
        seen_now = jnp.where(taken.there[:, None], found.colours[taken.rows], 0.0)
        colours = learned_colours(jnp.where(born[:, None], 0.0, colours), seen_now, alone)
    state = TrackerState(objects, lives, guesses, second, scores, camera, noise, colours)
    rows = detections.rows_of(jnp.where(taken.there, taken.rows, -1))
    shown = lives.identities, lives.confirmed, lives.unseen, lives.full, lives.shown
    return state, Tracks(boxes, *shown, rows)


_advanced = eqx.filter_jit(advanced)


def _moved(
    state: TrackerState,
    found: _Found,
    unlike: Float[Array, "m d"],
    motion: CameraMotion | None,
) -> tuple[Gaussian, NoiseState, CameraState, Float[Array, "2"]]:
    """Objects a frame later, moved with the camera, and by how far that was."""
    before, noise, gone = state.objects, state.noise, None
    deviations = state.camera.deviations
    if motion is not None:
        carried = motion.carried(before)
        gone = (carried.place - before.place)[:, :2]
        before, noise = carried, noise._replace(moments=motion.carried(noise.moments))
        deviations = jnp.where(motion.known, state.camera.left, deviations)
    errors, place, velocity, _ = noise.noises
    objects = before.predicted(place[None], velocity[None])
    confirmed = state.lives.confirmed
    number = jnp.maximum(jnp.sum(confirmed, dtype=objects.place.dtype), 1.0)
    box = jnp.exp(jnp.sum(jnp.where(confirmed[:, None], objects.place[:, 2:], 0.0), 0) / number)
    cost = mahalanobis(objects, errors, found.places, 2 * deviations * box) + unlike
    strong = found.detections.valid & (found.detections.scores >= state.scores.strong)
    cost = jnp.where(confirmed[:, None] & strong[None], cost, jnp.inf)
    known = jnp.asarray(False) if motion is None else jnp.asarray(motion.known)
    camera, shift = state.camera.after(objects, gone, known, cost, errors, found.places, box)
    noise = noise._replace(moments=noise.moments.shifted(shift))
    return objects.shifted(shift), noise, camera, shift


def _or_past(source: Int[Array, " m"], rows: Array) -> Int[Array, " m"]:
    """The rows, with one past the last for none, which a scatter drops."""
    return jnp.where(source >= 0, source, len(rows))
