"""A tracker that starts and ends its components by itself, from detections: a chain of moves."""

from collections.abc import Iterable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key, PyTree, UInt8

from mpfjax.checks import (
    check_flag,
    check_positive,
    check_type,
    check_whole,
    given,
    is_series,
    shown,
)
from mpfjax.filter import Filter, step_and_faults
from mpfjax.mixture import ParticleMixture
from mpfjax.moves.base import AbstractMove, AbstractResampling
from mpfjax.moves.resampling.gaussian import GaussianRegeneration
from mpfjax.vision.colour.bins import AbstractColours, HSVColours
from mpfjax.vision.colour.histograms import integral_histogram
from mpfjax.vision.colour.sampled_histograms import SampledBoxes, SampledHistogram
from mpfjax.vision.tracking.appearance import LearnAppearance
from mpfjax.vision.tracking.assignment import Assign
from mpfjax.vision.tracking.births import Births, ShareMass
from mpfjax.vision.tracking.camera import FollowCamera
from mpfjax.vision.tracking.deaths import Deaths
from mpfjax.vision.tracking.detections import Detections
from mpfjax.vision.tracking.doubles import LearnDoubles
from mpfjax.vision.tracking.guesses import LearnGuesses
from mpfjax.vision.tracking.memory import (
    LIVES,
    Lives,
    assigned_detections,
    mean_boxes,
)
from mpfjax.vision.tracking.model import DetectedObjectModel, NoObjectYet, ObjectState, Pixels
from mpfjax.vision.tracking.motion import PropagateObjects
from mpfjax.vision.tracking.noise import LearnNoise
from mpfjax.vision.tracking.observation import CameraMotion, TrackedFrame
from mpfjax.vision.tracking.scores import RankScores

# A box of this many pixels cannot be counted in 16 bits.
_LARGEST_NARROW = 2**16
# The default number of particles of an object, where they differ.
RIVALS_PER_OBJECT = 16


class Tracks(NamedTuple):
    """The tracks in one frame, a row for each of the M components.

    - `boxes`: (m, 4), the mean box of each, centre and size in pixels.
    - `identities`: (m,), a number that an object keeps for life, 0 for a dead component.
    - `confirmed`: (m,), whether it has had enough detections to be taken for an object.
    - `unseen`: (m,), frames since its last detection; 0 in a frame with one.
    - `full`: whether a detection that would have started a component found no room.
    - `shown`: (m,), which are confirmed, were detected a moment ago, and are not more
      probably doubles of another one.
    - `detections`: (m,), the row of the detection assigned to each in this frame, in what the
      detector gave; -1 for none. Use it to look up class labels, masks and features.
    """

    boxes: Float[Array, "m 4"]
    identities: Int[Array, " m"]
    confirmed: Bool[Array, " m"]
    unseen: Int[Array, " m"]
    full: Bool[Array, ""]
    shown: Bool[Array, " m"]
    detections: Int[Array, " m"]

    @classmethod
    def of(cls, mixture: ParticleMixture, detections: Detections) -> "Tracks":
        """The tracks in a mixture, after a step with these detections."""
        lives: Lives = mixture.memory[LIVES]
        return cls(
            boxes=mean_boxes(mixture),
            identities=lives.identities,
            confirmed=lives.confirmed,
            unseen=mixture.memory[LIVES].unseen,
            full=lives.full,
            shown=lives.shown,
            detections=detections.rows_of(assigned_detections(mixture)),
        )

    @property
    def corner_boxes(self) -> Float[Array | np.ndarray, "m 4"]:
        """The boxes (x, y, w, h) with (x, y) the top-left corner, as files have them."""
        sides = self.boxes[:, np.array([2, 3, 2, 3])]
        return self.boxes - sides * np.array([[0.5, 0.5, 0, 0]], self.boxes.dtype)


class ObjectTracker(eqx.Module):
    """A mixture particle filter with a component for each object, born and ended by detections.

    `filter` is a `Filter` that starts empty; `run_filter` takes it, with `TrackedFrame`s for
    observations. A step is a chain of moves on a `ParticleMixture`, each with a memory of its own:

    - `RankScores`: which detections are strong, by the scores seen so far;
    - `FollowCamera`: the motion that all objects have in common;
    - `Assign`: at most one detection for each component, at the least total cost;
    - `LearnGuesses`: for how long an object without a detection is shown;
    - a resampling, of the GM-MPF (Lin et al. 2012) or of the MPF (Vermaak et al. 2003), unless P is
      1: the Gaussian of one particle is that particle;
    - `PropagateObjects`: a Kalman prediction and update of each hypothesis, and its weight;
    - `Deaths`: end components without detections, or outside the frame;
    - `Births`: a component for each strong detection that no component explains;
    - `LearnDoubles`: whether what appears beside an object is another one;
    - `LearnNoise`: the detector's errors, and the noises of motion and growth;
    - `LearnAppearance`: the colours of objects that stand alone;
    - `ShareMass`: the same mixture weight for every object.

    Lengths are in boxes, so that nothing depends on the size of the frame or of the objects.
    Particles carry Gaussian moments. With Gaussian regeneration a component is one Gaussian: P = 1
    is enough and, unless particles are weighed by colours, nothing is drawn at random. With a
    resampling, particles are rival hypotheses of the association. All moves except
    `PropagateObjects` and the resampling depart from the exact recursion (`approximate`). Use it to
    track an unknown and changing number of objects, with any detector.

    - `max_objects`: M; `particles_per_object`: P. None takes P from the resampling, or else 1, or
      16 where particles are weighed by colours.
    - `frames_per_second`: of the video. An object ends after a second without a detection. None
      takes 25.
    - `resampling`: `Resample(particles_per_component=P)` for an MPF, or `GaussianRegeneration(P,
      where=lambda states: (states.place, states.velocity))`, by default with stratified noise.
    - `colours`: the bins of the histograms.
    - `exact_colours`: count every pixel of a box by an integral histogram, whose cost grows with
      the frame, in place of the grid of points of a `SampledHistogram`.
    - `sigma`: weigh particles by their colours as well, as a `DetectedObjectModel` does; None, the
      default, uses colours only to assign detections, which costs less.
    - `strong_score`, `weak_score`: the score from which a detection starts a component, and the
      least score that counts at all; None takes them from the scores seen so far.
    - `moves`: a chain of your own in place of all of these, with settings of its own; colours are
      learned where it holds a `LearnAppearance`, by whose bins.

    Raises `ValueError` for a count that is not a whole number from 1 on, a rate or σ that is not
    positive and finite, a weak score above the strong one, and a resampling that does not give
    every component P particles or would redraw their labels. Raises `ValueError` for a setting
    given beside `moves` that the moves have themselves, for moves that share one memory, and for a
    move that needs the memory of a move that is missing.
    """

    filter: Filter
    colours: AbstractColours
    exact_colours: bool = eqx.field(static=True)
    # The bands of a box whose colours are learned, where those of detections suffice for a step.
    _bands: int | None = eqx.field(static=True)

    def __init__(
        self,
        max_objects: int = 24,
        particles_per_object: int | None = None,
        *,
        frames_per_second: float | None = None,
        resampling: AbstractResampling | None = None,
        colours: AbstractColours | None = None,
        exact_colours: bool = False,
        sigma: float | None = None,
        strong_score: float | None = None,
        weak_score: float | None = None,
        moves: Iterable[AbstractMove] | None = None,
    ) -> None:
        moves = tuple(moves) if is_series(moves) else moves
        if particles_per_object is None:
            particles_per_object = _enough_particles(resampling, moves, sigma)
        check_whole(max_objects=max_objects, particles_per_object=particles_per_object)
        check_positive(**given(frames_per_second=frames_per_second, sigma=sigma))
        check_flag(exact_colours=exact_colours)
        if moves is not None:
            moves = _own_chain(
                moves,
                particles_per_object,
                frames_per_second=frames_per_second,
                resampling=resampling,
                sigma=sigma,
                strong_score=strong_score,
                weak_score=weak_score,
            )
            colours = _learned_colours(moves, colours)
        colours = HSVColours(8, 4, 6) if colours is None else colours
        check_type(AbstractColours, "AbstractColours such as HSVColours()", colours=colours)
        if moves is None:
            is_alone = resampling is None and particles_per_object == 1
            if resampling is None:
                resampling = GaussianRegeneration(
                    particles_per_object, where=_motion, noise="stratified"
                )
            _check_resampling(resampling, particles_per_object)
            rate = 25.0 if frames_per_second is None else frames_per_second
            model = object_model(rate, sigma)
            assign = Assign(model)
            deaths = Deaths(
                patience=max(round(rate), 8),
                longest_guess=max(round(0.1 * rate), 1),
                longest_unsure=max(round(0.3 * rate), 1),
            )
            moves = (
                RankScores(
                    lasting=max(round(2 * rate), 10),
                    strong_score=strong_score,
                    weak_score=weak_score,
                ),
                FollowCamera(assign),
                assign,
                LearnGuesses(model, deaths),
                *(() if is_alone else (resampling,)),
                PropagateObjects(model, matched=isinstance(resampling, GaussianRegeneration)),
                deaths,
                Births(model, particles_per_object),
                LearnDoubles(),
                LearnNoise(model),
                LearnAppearance(colours),
                ShareMass(),
            )
        size = max_objects * particles_per_object
        self.filter = Filter(NoObjectYet(), moves, size, max_objects, starts_empty=True)
        self.colours = colours
        self.exact_colours = bool(exact_colours)
        learned = [move.num_parts for move in moves if isinstance(move, LearnAppearance)]
        suffice = not exact_colours and len(learned) == 1 and all(map(_sees_detections, moves))
        self._bands = learned[0] if suffice else None

    @property
    def moves(self) -> tuple[AbstractMove, ...]:
        """The moves of one step."""
        return self.filter.moves

    @property
    def max_objects(self) -> int:
        """M, how many objects there is room for."""
        return self.filter.num_components

    @property
    def particles_per_object(self) -> int:
        """P."""
        return self.filter.num_particles // self.filter.num_components

    @property
    def approximate(self) -> bool:
        """Whether any move departs from the exact recursion."""
        return self.filter.approximate

    def init(self) -> ParticleMixture:
        """The state before the first frame: every component dead, every slot empty."""
        return _begin(self.filter)

    @eqx.filter_jit
    def step(
        self,
        key: Key[Array, ""],
        state: ParticleMixture,
        frame: UInt8[Array, "h w 3"] | SampledBoxes | None,
        detections: Detections,
        motion: CameraMotion | None = None,
    ) -> tuple[ParticleMixture, Tracks]:
        """The state after a frame and its detections, and the tracks in it.

        The result of `look` may be given in place of the frame. Where `frame` is None detections
        are tracked alone, without colours. `motion` is what `OpticalFlow` makes of the frames; None
        leaves the camera's motion to the detections. Frames may have any size, but each new size
        compiles anew, and boxes keep their places in pixels. Raises `ValueError` for a frame that
        is not (h, w, 3) of type uint8, and for anything but `Detections`.
        """
        check_type(Detections, "Detections, as from_boxes makes them", detections=detections)
        seen = TrackedFrame(detections, self._pixels(frame), motion)
        state, _, _ = step_and_faults(self.filter, key, state, seen)
        return state, Tracks.of(state, detections)

    def look(
        self, frame: UInt8[np.ndarray, "h w 3"], detections: Detections
    ) -> SampledBoxes | UInt8[np.ndarray, "h w 3"]:
        """The part of a frame that `step` needs: the detections' colours, where these suffice.

        The time of a step then does not depend on the size of the frame, and a new size does not
        compile anew. The result is the whole frame where particles are weighed by their colours,
        where colours are exact, and for a chain that holds moves of other kinds than the default
        chain. Raises `ValueError` for a frame as `step` does.
        """
        if self._bands is None:
            return frame
        return SampledBoxes.of(frame, np.asarray(detections.boxes), self.colours, self._bands)

    def _pixels(self, frame: Any) -> Pixels | None:
        if frame is None or isinstance(frame, SampledBoxes):
            return frame
        if self.exact_colours:
            wide = frame.shape[0] * frame.shape[1] >= _LARGEST_NARROW
            return integral_histogram(frame, self.colours, wide)
        return SampledHistogram(frame, self.colours)


@eqx.filter_jit
def _begin(filter: Filter) -> ParticleMixture:
    """All of the initial state in one program; operation by operation it would be some forty."""
    return filter.init(jax.random.key(0))


def object_model(
    frames_per_second: float = 25.0, sigma: float | None = None
) -> DetectedObjectModel:
    """The model of objects before anything is learned, at a frame rate.

    At a lower frame rate new objects may move further in a frame. Raises `ValueError` for a rate or
    σ that is not positive.
    """
    check_positive(frames_per_second=frames_per_second)
    model = DetectedObjectModel(sigma=sigma)
    speeds = model.start_velocity * min(25 / frames_per_second, 2.5)
    return eqx.tree_at(lambda model: model.start_velocity, model, speeds)


def _enough_particles(resampling: Any, moves: Any, sigma: float | None) -> int:
    """P of the resampling, or else the least number that represents what is drawn."""
    for move in [resampling] if moves is None or not is_series(moves) else moves:
        number = getattr(move, "particles_per_component", None)
        if number is not None:
            return number
    nothing_drawn = resampling is None and moves is None and sigma is None
    return 1 if nothing_drawn else RIVALS_PER_OBJECT


def _own_chain(
    moves: Iterable[AbstractMove], particles_per_object: int, **settings: Any
) -> tuple[AbstractMove, ...]:
    """The user's moves, or a `ValueError` for settings beside them and moves that do not fit."""
    if not is_series(moves):
        raise ValueError(f"moves: {shown(moves)} is not a sequence of moves")
    for name, value in given(**settings).items():
        raise ValueError(
            f"{name}: {shown(value)} is given beside moves, which have settings of their own"
        )
    chain = tuple(moves)
    for move in chain:
        check_type(AbstractMove, "a sequence of moves", moves=move)
        if isinstance(move, AbstractResampling):
            _check_resampling(move, particles_per_object, "moves")
    if not any(isinstance(move, Deaths) for move in chain):
        raise ValueError(f"moves: {shown(chain)} lacks Deaths, which keeps the list of objects")
    return chain


def _learned_colours(
    moves: Iterable[AbstractMove], colours: AbstractColours | None
) -> AbstractColours | None:
    """The bins of the chain's `LearnAppearance`; `colours`, if given, have to be the same."""
    for move in moves:
        if isinstance(move, LearnAppearance):
            if colours is not None and not eqx.tree_equal(colours, move.colours):
                raise ValueError(
                    f"colours: {shown(colours)} are not those of LearnAppearance, {move.colours}"
                )
            return move.colours
    return colours


def _check_resampling(
    resampling: AbstractResampling, particles_per_object: int, argument: str = "resampling"
) -> None:
    check_type(AbstractResampling, "a resampling move", **{argument: resampling})
    number = getattr(resampling, "particles_per_component", None)
    # Another number would leave no empty slots for new components.
    if number != particles_per_object:
        raise ValueError(
            f"{argument}: its particles_per_component, {number}, is not particles_per_object,"
            f" {particles_per_object}"
        )
    if isinstance(resampling, GaussianRegeneration) and resampling.where is None:
        raise ValueError(
            f"{argument}: where is None, but the label of a particle's object is not Gaussian"
        )


def _sees_detections(move: AbstractMove) -> bool:
    """Whether the move uses the colours of detections alone, or none."""
    if isinstance(move, PropagateObjects):
        return move.model.sigma is None
    kinds = (
        RankScores,
        Assign,
        AbstractResampling,
        Deaths,
        Births,
        LearnAppearance,
    )
    learning = (LearnDoubles, LearnGuesses, LearnNoise)
    return isinstance(move, (*kinds, *learning, FollowCamera, ShareMass))


def _motion(states: ObjectState) -> tuple[PyTree, PyTree]:
    return states.place, states.velocity
