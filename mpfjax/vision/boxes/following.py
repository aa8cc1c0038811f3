"""Boxes drawn in the first frame and followed: one track each."""

import itertools
from collections.abc import Generator, Iterable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key, UInt8

from mpfjax.arrays import (
    to_rows,
)
from mpfjax.checks import Count, checked
from mpfjax.filter import Filter
from mpfjax.operations.compiling import cpu_options, in_little_memory, jit_with
from mpfjax.operations.random import split_once
from mpfjax.report import with_densities
from mpfjax.vision.boxes.hypotheses import LearnedColourModel, best_components
from mpfjax.vision.boxes.recipes import objects_filters
from mpfjax.vision.files.frames import of_one_kind
from mpfjax.vision.tracking.state import Tracks

_END = object()


@checked
def follow_boxes(
    frames: Iterable[UInt8[np.ndarray, "..."] | None],
    boxes: Float[np.ndarray, "k 4"],
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
    initial: Any = next(stills, _END)
    if initial is _END:
        return
    if initial is None:
        raise ValueError("frames: the first, in which the boxes are, is None")
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
        mixture, tracks, growth = advance(filter, len(boxes), key, np.asarray(t), mixture, counted)
        tracks = jax.device_get(with_densities(tracks, growth))
        yield tracks._replace(number=first + t)


def _advance_boxes(filter, num_objects, key, t, mixture, counted):
    step_keys = split_once(jax.random.fold_in(key, t), len(filter.moves))
    mixture, info = filter._step(step_keys, mixture, counted)
    best, exists = best_components(mixture, num_objects)
    means = mixture.component_expectations(filter.model.boxes(mixture.particles))
    identities = jnp.where(exists, jnp.arange(1, num_objects + 1, dtype=jnp.int32), 0)
    unseen = jnp.zeros(num_objects, jnp.int32)
    none, never = jnp.full(num_objects, -1, jnp.int32), jnp.zeros(num_objects)
    full = jnp.zeros((), bool)
    rest = full, exists, none, never, unseen, jnp.ones(num_objects)
    tracks = Tracks(means[best], identities, exists, unseen, *rest)
    return mixture, tracks, info.log_likelihood_increment
