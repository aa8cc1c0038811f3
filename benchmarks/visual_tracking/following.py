"""Snapshots of several runs of a filter of boxes, frame by frame, and the tracks that they make."""

from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key, UInt8

from mpfjax.filter import Filter
from mpfjax.vision.boxes.hypotheses import component_references
from mpfjax.vision.files import boxes as box_files


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


def follow(
    keys: Key[Array, " runs"], filter: Filter, frames: Iterable[UInt8[np.ndarray, "h w 3"]]
) -> Iterator[Snapshot]:
    """Run a filter of boxes online, once for each key, and yield a snapshot for each frame.

    The filter's model has a method `boxes(states)`, as `ColourModel` does. A frame is read only
    after the frame before it is done.
    """
    mixtures = jax.vmap(filter.init)(keys)
    for t, frame in enumerate(frames):
        step = jnp.asarray(t)  # an array: a new Python number would compile again
        mixtures, snapshot = _advance(keys, filter, step, mixtures, jnp.asarray(frame))
        yield jax.tree.map(np.asarray, snapshot)


@eqx.filter_jit
def _advance(keys, filter, t, mixtures, frame):
    def step(key, mixture):
        mixture, _ = filter.step(jax.random.fold_in(key, t), mixture, frame)
        places = filter.model.boxes(mixture.particles)
        labels = jnp.where(mixture.occupied, mixture.component_indicators, -1)
        means = mixture.component_expectations(places)
        references = component_references(mixture)
        snapshot = Snapshot(means, mixture.active, places[:, :2], labels, references)
        return mixture, snapshot

    # The frame is not mapped over, so its histogram is built once for all runs.
    return jax.vmap(step)(keys, mixtures)


def track_rows(
    snapshots: list[Snapshot],
    run: int = 0,
    *,
    first: int = 1,
    by_reference: bool = False,
) -> Float[np.ndarray, "rows 6"]:
    """Rows (frame, id, x, y, w, h) of one run: an id for each life of each component.

    (x, y) is the top-left corner in pixels, as `write_tracks` takes it; the first snapshot is of
    frame `first`. With `by_reference` the id is 1 for all components of the first given box, 2 for
    those of the second and so on. Then an id may have several rows in a frame, one for each
    hypothesis.
    """
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
