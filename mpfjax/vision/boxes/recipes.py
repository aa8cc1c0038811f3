"""Presets for tracking boxes in video by their colours: a PF and an MPF, ready to run.

Each preset is a function of the first frame and a box for each object. It returns two filters with
the same model and the same initial particles: a particle filter of 200 particles, and a mixture
particle filter of at most 10 components of 20. "objects" has twice as many particles, and for more
than three objects more of both, see `most_components`. `PRESETS` has the presets by name.
"""

import dataclasses
import itertools
from collections.abc import Generator, Iterable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key, UInt8

from mpfjax.arrays import to_rows
from mpfjax.checks import Count, checked
from mpfjax.filter import Filter
from mpfjax.filters import mixture_particle_filter, particle_filter
from mpfjax.models.dynamics import RandomWalkWithJumps, WalkWithVelocity
from mpfjax.moves.propagation.propagate import Propagate
from mpfjax.moves.regrouping.kmeans import KMeans
from mpfjax.moves.regrouping.merge import Exclusion, Merge, Prune
from mpfjax.moves.regrouping.partitions import GroupBy
from mpfjax.moves.regrouping.split import Split
from mpfjax.moves.resampling.resample import Resample
from mpfjax.operations.compiling import cpu_options, in_little_memory, jit_with
from mpfjax.operations.random import split
from mpfjax.report import with_densities
from mpfjax.transforms import with_resampling
from mpfjax.vision.boxes.colour_model import BoxState, ColourModel
from mpfjax.vision.boxes.hypotheses import AdaptAppearance, LearnedColourModel, best_components
from mpfjax.vision.colour import RGBColours
from mpfjax.vision.files.frames import of_one_kind
from mpfjax.vision.tracking.state import Tracks

Frame, Boxes = UInt8[np.ndarray, "h w 3"], Float[np.ndarray, "k 4"]
NUM_PARTICLES, MAX_COMPONENTS, PARTICLES_PER_COMPONENT = 200, 10, 20
HYPOTHESES, PARTICLES_PER_HYPOTHESIS = 3, 40


def paper_filters(frame: Frame, boxes: Boxes) -> dict[str, Filter]:
    """The paper's model and parameters; thresholds of the MPF are in units of the mean box."""
    size = boxes[:, 2:].mean(axis=0)
    model = with_one_reference(ColourModel.from_frame(frame, boxes, sigma=0.15))
    where: dict[str, Any] = {"features": _centre, "scale": size}
    merge = Merge(None, max_distance=0.5, **where)
    splitting = Split(4.0, min_distance=0.5, min_share=0.15, **where)
    where |= {"regroup": [merge, splitting, KMeans(5, **where)], "regroup_every": 1}
    mixture = mixture_particle_filter(model, NUM_PARTICLES, MAX_COMPONENTS, **where)
    mixture = with_resampling(mixture, Resample(particles_per_component=PARTICLES_PER_COMPONENT))
    return {"pf": particle_filter(model, NUM_PARTICLES), "mpf": mixture}


def default_filters(frame: Frame, boxes: Boxes) -> dict[str, Filter]:
    """The recipe with the highest coverage on real video: any component may follow any object.

    A particle is compared with one of the given boxes, and sometimes changes to another. Sometimes
    it takes a long step. Components exclude each other. They split if they cover two places, and
    merge only after ten frames at the same place.
    """
    size = boxes[:, 2:].mean(axis=0)
    steps = _steps(boxes)
    # Some steps of the places are longer by a factor; sizes never jump.
    walk = RandomWalkWithJumps(steps, steps * np.array([6.0, 6.0, 1.0, 1.0]), 0.05)
    model = _model_of_boxes(ColourModel, frame, boxes, steps, walk)
    model = dataclasses.replace(model, switch_probability=0.05)
    where: dict[str, Any] = {"features": _centre, "scale": size}
    mixture = Filter(
        model,
        moves=[
            Resample(particles_per_component=PARTICLES_PER_COMPONENT),
            Propagate(),
            Exclusion(strength=4.0, radius=0.5, **where),
            Merge(None, max_distance=0.25, patience=10, **where),
            Split(4.0, min_distance=0.5, min_share=0.15, **where),
        ],
        num_particles=NUM_PARTICLES,
        num_components=MAX_COMPONENTS,
        # One component for each box.
        initial_moves=[
            KMeans(10, reseed=True, **_apart(size)),
            Merge(None, max_distance=0.5, features=_reference),
        ],
    )
    return {"pf": particle_filter(model, NUM_PARTICLES), "mpf": mixture}


def objects_filters(frame: Frame, boxes: Boxes) -> dict[str, Filter]:
    """The recipe with the fewest strays and swaps: every component keeps to its object.

    Every particle is compared only with the box that it started from, and learns the current
    appearance and motion of its object. The components of an object are therefore rival hypotheses
    about it. An object may be hidden; its components then move on by the dynamics. Only components
    of one object merge, a component splits where hypotheses diverge, and improbable ones are
    pruned. Objects exclude each other where they are nearly at one place. They share the particles
    equally: 400 in all, and from four objects on 120 for each object.
    """
    size = boxes[:, 2:].mean(axis=0)
    # Steps about a velocity are shorter than those of a random walk.
    steps = _steps(boxes) * np.array([0.3, 0.5, 1.0, 1.0])
    walk = RandomWalkWithJumps(steps, steps * np.array([8.0, 6.0, 1.0, 1.0]), 0.1)
    # Places keep their velocity, which is about a tenth of a width a frame at first.
    speeds = 0.1 * boxes[:, 2:3] * np.array([[1.0, 1.0, 0.0, 0.0]])
    walk = WalkWithVelocity(walk, (0.1, 0.1, 0.0, 0.0), speeds)
    model = _model_of_boxes(LearnedColourModel, frame, boxes, steps, walk)
    apart = _apart(size)
    learn = AdaptAppearance(rate=0.03)
    num_components = most_components(len(boxes))
    num_particles = PARTICLES_PER_HYPOTHESIS * num_components
    exclusion = Exclusion(strength=3.0, radius=0.35, group=_object, features=_centre, scale=size)
    mixture = Filter(
        model,
        moves=[
            Resample(group=_object),
            Propagate(),
            *([exclusion] if len(boxes) > 1 else []),
            learn,
            Merge(None, max_distance=0.25, patience=10, **apart),
            Prune(least_share=1e-15, group=_object),
            Split(4.0, min_distance=0.5, min_share=0.05, sample_size=None, **apart),
        ],
        num_particles=num_particles,
        num_components=num_components,
        # Each particle in the component of its object, as a start for hypotheses about it.
        initial_moves=[GroupBy(_object)],
    )
    alone = Filter(model, moves=[Resample(), Propagate(), learn], num_particles=num_particles)
    return {"pf": alone, "mpf": mixture}


def with_one_reference(model: ColourModel) -> ColourModel:
    """The model with the mean of all boxes as the one reference, as the paper has one B_ref."""
    references, places = model.references, model.reference_boxes
    references = jnp.broadcast_to(references.mean(0, keepdims=True), references.shape)
    places = places.at[:, 2:].set(places[:, 2:].mean(0, keepdims=True))
    return dataclasses.replace(model, references=references, reference_boxes=places)


def _model_of_boxes(kind: type[ColourModel], frame: Any, boxes: Any, steps: Any, walk: Any) -> Any:
    """A model in which each box is a reference."""
    model = kind.from_frame(
        frame, boxes, colours=RGBColours(16), sigma=0.2, deviations=steps, dynamics=walk,
        num_parts=8, weigh_colours=True,
    )  # fmt: skip
    return dataclasses.replace(model, contrast=0.25)


def most_components(num_objects: int) -> int:
    """The most components of `objects_filters`: three hypotheses about each of many objects."""
    return max(MAX_COMPONENTS, HYPOTHESES * num_objects)


def _steps(boxes: np.ndarray) -> np.ndarray:
    """Deviations of the random walk: 0.4 widths, 0.08 heights of each box; sizes hardly change."""
    still = np.full(len(boxes), 0.01)
    return np.stack([0.4 * boxes[:, 2], 0.08 * boxes[:, 3], still, still], axis=1)


def _apart(size: np.ndarray) -> dict[str, Any]:
    """Features in which particles of different references are never near each other."""
    return {"features": _centre_and_reference, "scale": (*size, 1e-5)}


PRESETS = {"default": default_filters, "objects": objects_filters, "paper": paper_filters}


def _centre(states: BoxState) -> Array:
    return states.box[:, :2]


def _object(states: BoxState) -> Array:
    return states.reference


def _reference(states: BoxState) -> Array:
    return states.reference[:, None].astype(states.box.dtype)


def _centre_and_reference(states: BoxState) -> Array:
    return jnp.concatenate([_centre(states), _reference(states)], axis=1)


# --- one track for each box --------------------------------------------------------------------


@checked
def follow_boxes(
    frames: Iterable[UInt8[np.ndarray, "..."] | None],
    boxes: Boxes,
    *,
    key: Key[Array, ""] | None = None,
    first: Count = 1,
) -> Generator[Tracks, None, None]:
    """Follow boxes (x, y, w, h) of the first frame by their colours: yields `Tracks`, k rows each.

    Row j has the identity j + 1. It is the most probable position of box j under the preset
    "objects" of `PRESETS`: the mean of the heaviest of the components that represent it. An object
    without any component left has the identity 0. There are no detections: `confirmed` reports
    whether the object has a component, and `unseen` is 0.

    - `frames`: as for `track`; the boxes, top-left corner first, in pixels, are in the first. A
      frame that is None is predicted.
    - `key`: of the random numbers; None is `jax.random.key(0)`.
    - `first`: the number of the first frame.

    Raises `ValueError` for no boxes, for boxes without area or outside the first frame, and for
    frames as `track` does. Use it if no detector finds the objects, and a user draws boxes around
    them.
    """
    stills = of_one_kind(frames, first)
    initial: Any = next(stills, None)
    if initial is None:
        raise ValueError("frames: there is no first one, in which the boxes are")
    boxes, key = to_rows(4, "boxes", boxes), jax.random.key(0) if key is None else key
    filter = objects_filters(initial, boxes)["mpf"]
    model: Any = filter.model
    # It runs once, and takes longer to compile than to run.
    little = in_little_memory(soon=True)
    mixture = jit_with(little, Filter.init)(filter, key)
    # With XLA's newer emitters it takes longer to compile, and half the time to run.
    count = jit_with(cpu_options(soon=True), LearnedColourModel.prepare_observation)
    advance = jit_with(little, _advance_boxes)
    for t, still in enumerate(itertools.chain([initial], stills)):
        # An array: each new Python number would compile anew.
        counted = None if still is None else count(model, still)
        about = filter, len(boxes), key, np.asarray(t), mixture, counted
        mixture, boxes_now, growth = advance(*about)
        means, exists = jax.device_get(with_densities(boxes_now, growth))
        none, names = np.zeros(len(boxes), int), np.where(exists, 1 + np.arange(len(boxes)), 0)
        yield Tracks(
            means, names, exists, none, False, shown=exists, detections=none - 1,
            probabilities=0.0 * none, classes=none, scores=1.0 + none, number=first + t,
        )  # fmt: skip


def _advance_boxes(filter, num_objects, key, t, mixture, counted):
    step_keys = split(jax.random.fold_in(key, t), len(filter.moves))
    mixture, info = filter._step(step_keys, mixture, counted)
    best, exists = best_components(mixture, num_objects)
    means = mixture.component_expectations(filter.model.boxes(mixture.particles))
    return mixture, (means[best], exists), info.log_likelihood_increment
