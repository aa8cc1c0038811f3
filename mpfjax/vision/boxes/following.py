"""Boxes drawn in the first frame, followed: one track for each, or snapshots of any filter."""

import itertools
from collections.abc import Generator, Iterable, Iterator
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key, UInt8

from mpfjax.checks import CountOrZero, checked, to_rows
from mpfjax.filter import Filter, with_densities
from mpfjax.models.observations import one_observation
from mpfjax.operations.compiling import cpu_options, in_little_memory, jit_with
from mpfjax.operations.random import split_once
from mpfjax.vision.boxes.hypotheses import LearnedColourModel, best_components, component_references
from mpfjax.vision.boxes.recipes import objects_filters
from mpfjax.vision.files import boxes as box_files
from mpfjax.vision.files.frames import of_one_kind
from mpfjax.vision.tracking.state import Tracks

_END = object()


class Snapshot(NamedTuple):
    """The state of several runs in one frame; for a single run, without the leading axis.

    - `means`: (runs, m, 4), the mean box of each component, centre and size in pixels.
    - `active`: (runs, m), which components are alive.
    - `points`: (runs, n, 2), the centres of the particles.
    - `labels`: (runs, n), the component of each particle, -1 in an empty slot.
    - `references`: (runs, m), which of the given boxes each component is compared with
      (`BoxState.reference`, its mean over the component); None where particles carry none.
    """

    means: Any
    active: Any
    points: Any
    labels: Any
    references: Any = None


@checked
def follow(
    keys: Key[Array, " runs"], filter: Filter, frames: Iterable[UInt8[np.ndarray, "h w 3"]]
) -> Iterator[Snapshot]:
    """Run a filter of boxes online, once for each key, and yield a snapshot for each frame.

    The filter's model has a method `boxes(states)`, as `ColourModel` does. A frame is read only
    after the frame before it is done, so that frames may come from a camera. Raises `ValueError`
    for anything but a filter and a stack of keys. Use it with the `PRESETS`, and `track_rows` to
    make tracks of the snapshots.
    """
    mixtures = jax.vmap(filter.init)(keys)
    for t, frame in enumerate(frames):
        step = jnp.asarray(t)  # an array: a new Python number would compile again
        mixtures, snapshot, increments = _advance(
            keys, filter, step, mixtures, jnp.asarray(one_observation(frame))
        )
        yield jax.tree.map(np.asarray, with_densities(snapshot, jnp.max(increments)))


@eqx.filter_jit
def _advance(keys, filter, t, mixtures, frame):
    def step(key, mixture):
        step_key = jax.random.fold_in(key, t)
        mixture, info = filter._step(step_key, mixture, frame)
        places = filter.model.boxes(mixture.particles)
        labels = jnp.where(mixture.occupied, mixture.component_indicators, -1)
        means = mixture.component_averages(places)
        carried = hasattr(mixture.particles, "reference")
        references = component_references(mixture) if carried else None
        snapshot = Snapshot(means, mixture.active, places[:, :2], labels, references)
        return mixture, snapshot, info.log_likelihood_increment

    # The frame is not mapped over, so its histogram is built once for all runs.
    return jax.vmap(step)(keys, mixtures)


@checked
def track_rows(
    snapshots: list[Snapshot],
    run: CountOrZero = 0,
    *,
    first: CountOrZero = 1,
    by_reference: bool = False,
) -> Float[np.ndarray, "rows 6"]:
    """Rows (frame, id, x, y, w, h) of one run: an id for each life of each component.

    (x, y) is the top-left corner in pixels, as `write_tracks` takes it; the first snapshot is of
    frame `first`. With `by_reference` the id is 1 for all components of the first given box, 2 for
    those of the second and so on. Then an id may have several rows in a frame, one for each
    hypothesis. Raises `ValueError` for a run or a frame that is not a whole number from 0 on, and
    where snapshots have no references.
    """
    if by_reference and any(snapshot.references is None for snapshot in snapshots):
        raise ValueError("by_reference: the snapshots are of particles without a reference")
    rows, alive, next_id = [], {}, 1
    for frame, snapshot in enumerate(snapshots, first):
        for m, (mean, active) in enumerate(
            zip(snapshot.means[run], snapshot.active[run], strict=True)
        ):
            if not active:
                alive.pop(m, None)
                continue
            if by_reference:
                alive[m] = 1 + int(snapshot.references[run][m])
            elif m not in alive:
                alive[m], next_id = next_id, next_id + 1
            rows.append([frame, alive[m], *box_files.top_left(mean[None])[0]])
    # Rounded as in the file, so that scores from the file are the same.
    return np.round(np.array(rows, float).reshape(-1, 6), 3)


@checked
def follow_boxes(
    frames: Iterable[UInt8[np.ndarray, "..."] | None],
    boxes: Float[np.ndarray, "k 4"],
    *,
    key: Key[Array, ""] | None = None,
) -> Generator[Tracks, None, None]:
    """Follow boxes (x, y, w, h) of the first frame by their colours: yields `Tracks`, k rows each.

    Row j has the identity j + 1. It is the most probable place of box j under the recipe "objects"
    of `PRESETS`: the mean of the heaviest of the components that stand for it. An object without
    any component left has the identity 0. There are no detections: `confirmed` says whether the
    object has a component, and `unseen` is 0.

    - `frames`: as for `track`; the boxes, top-left corner first, in pixels, lie in the first. One
      that is None is predicted.
    - `key`: of the random numbers; None takes `jax.random.key(0)`.

    Raises `ValueError` for no boxes, for boxes without area or outside the first frame, and for
    frames as `track` does. Use it if no detector finds the objects, and a user draws boxes around
    them.
    """
    stills = of_one_kind(frames)
    first: Any = next(stills, _END)
    if first is _END:
        return
    if first is None:
        raise ValueError("frames: the first, in which the boxes are, is None")
    boxes, key = to_rows(4, "boxes", boxes), jax.random.key(0) if key is None else key
    filter = objects_filters(first, boxes)["mpf"]
    model: Any = filter.model
    # It runs once, and takes longer to compile than to run.
    little = in_little_memory(soon=True)
    mixture = jit_with(little, Filter.init)(filter, key)
    # With XLA's newer emitters it takes longer to compile, and half the time to run.
    count = jit_with(cpu_options(soon=True), LearnedColourModel.prepare_observation)
    advance = jit_with(little, _advance_boxes)
    for t, still in enumerate(itertools.chain([first], stills)):
        # An array: each new Python number would compile anew.
        counted = None if still is None else count(model, still)
        mixture, tracks, growth = advance(filter, len(boxes), key, np.asarray(t), mixture, counted)
        yield jax.device_get(with_densities(tracks, growth))


def _advance_boxes(filter, num_objects, key, t, mixture, counted):
    step_keys = split_once(jax.random.fold_in(key, t), len(filter.moves))
    mixture, info = filter._step(step_keys, mixture, counted)
    best, held = best_components(mixture, num_objects)
    means = mixture.component_averages(filter.model.boxes(mixture.particles))
    identities = jnp.where(held, jnp.arange(1, num_objects + 1, dtype=jnp.int32), 0)
    unseen = jnp.zeros(num_objects, jnp.int32)
    none, never = jnp.full(num_objects, -1, jnp.int32), jnp.zeros(num_objects)
    full = jnp.zeros((), bool)
    told = full, held, none, never, unseen, jnp.ones(num_objects)
    tracks = Tracks(means[best], identities, held, unseen, *told)
    return mixture, tracks, info.log_likelihood_increment
