"""The loop over frames for boxes drawn in the first frame: one track for each box, in order."""

import itertools
from collections.abc import Generator, Iterable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key, UInt8

from mpfjax.checks import check_key, check_type, to_rows
from mpfjax.filter import Filter, step_and_faults
from mpfjax.mixture import ParticleMixture
from mpfjax.observations import Fault, raise_faults
from mpfjax.operations.compiling import cpu_options, in_little_memory, jit_with
from mpfjax.operations.random import split_once
from mpfjax.vision.boxes.learned_colours import LearnedColourModel
from mpfjax.vision.boxes.object_moves import best_components
from mpfjax.vision.boxes.recipes import objects_filters
from mpfjax.vision.colour.histograms import IntegralHistogram
from mpfjax.vision.files.frames import of_one_kind
from mpfjax.vision.tracking.state import Tracks


def follow_boxes(
    frames: Iterable[UInt8[np.ndarray, "..."]],
    boxes: Float[np.ndarray, "k 4"],
    *,
    key: Key[Array, ""] | None = None,
) -> Generator[Tracks, None, None]:
    """Follow boxes (x, y, w, h) of the first frame by their colours: yields `Tracks`, k rows each.

    Row j has the identity j + 1. It is the most probable place of box j under the recipe "objects"
    of `PRESETS`: the mean of the heaviest of the components that stand for it. An object without
    any component left has the identity 0. There are no detections: `confirmed` says whether the
    object has a component, and `unseen` is 0.

    - `frames`: as for `track`; the boxes, top-left corner first, in pixels, lie in the first.
    - `key`: of the random numbers; None takes `jax.random.key(0)`.

    Raises `ValueError` for no boxes, for boxes without area or outside the first frame, and for
    frames as `track` does. Use it if no detector finds the objects, and a user draws boxes around
    them.
    """
    check_type(Iterable, "frames one after the other", frames=frames)
    boxes = to_rows(4, "boxes", boxes)
    if len(boxes) == 0:
        raise ValueError("boxes: there are none")
    key = jax.random.key(0) if key is None else key
    check_key(key)
    return _followed(of_one_kind(frames), boxes, key)


def _followed(
    stills: Iterator[np.ndarray], boxes: np.ndarray, key: Array
) -> Generator[Tracks, None, None]:
    first = next(stills, None)
    if first is None:
        return
    filter = objects_filters(first, boxes)["mpf"]
    model: Any = filter.model
    # It runs once, and takes longer to compile than to run.
    little = in_little_memory(soon=True)
    mixture = jit_with(little, _begin)(filter, key)
    # With XLA's newer emitters it takes longer to compile, and half the time to run.
    count = jit_with(cpu_options(soon=True), _counted)
    advance = jit_with(little, _advance)
    for t, still in enumerate(itertools.chain([first], stills)):
        # An array: each new Python number would compile anew.
        counted = count(model, still)
        mixture, tracks, faults = advance(filter, len(boxes), key, np.asarray(t), mixture, counted)
        yield jax.device_get(raise_faults(tracks, faults))


def _begin(filter: Filter, key: Array) -> ParticleMixture:
    return filter.init(key)


def _counted(model: LearnedColourModel, frame: Array) -> IntegralHistogram:
    return model.prepare_observation(frame, soon=True)


def _advance(
    filter: Filter,
    num_objects: int,
    key: Array,
    t: Array,
    mixture: ParticleMixture,
    counted: IntegralHistogram,
) -> tuple[ParticleMixture, Tracks, tuple[Fault, ...]]:
    step_keys = split_once(jax.random.fold_in(key, t), len(filter.moves))
    model: Any = filter.model
    mixture, _, faults = step_and_faults(filter, step_keys, mixture, counted)
    best, held = best_components(mixture, num_objects)
    means = mixture.component_averages(model.boxes(mixture.particles))
    identities = jnp.where(held, jnp.arange(1, num_objects + 1, dtype=jnp.int32), 0)
    unseen = jnp.zeros(num_objects, jnp.int32)
    none, never = jnp.full(num_objects, -1, jnp.int32), jnp.zeros(num_objects)
    full = jnp.zeros((), bool)
    tracks = Tracks(means[best], identities, held, unseen, full, held, none, never)
    return mixture, tracks, faults
