"""Tracking without a drawn box: detections, and mixtures whose components are born of them."""

import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from tqdm import tqdm

import mpfjax
from benchmarks.visual_tracking.source import Source
from mpfjax.vision import (
    BackgroundSubtraction,
    Detections,
    ObjectTracker,
    Tracks,
    offline_rows,
)
from mpfjax.vision.boxes.snapshots import Snapshot
from mpfjax.vision.tracking.state import TrackerState

MAX_DETECTIONS, MAX_OBJECTS, PARTICLES = 32, 24, 200
# Standard deviations along (x, y, log w, log h), in boxes.
ERRORS, START_VELOCITY = (0.1, 0.06, 0.12, 0.08), (0.1, 0.05, 0.02, 0.02)
PLACE_NOISE, VELOCITY_NOISE = (0.03, 0.02, 0.03, 0.02), (0.01, 0.006, 0.0005, 0.0005)


class Detected(NamedTuple):
    """The boxes (k, 4) of every frame, top-left corner first, and the seconds that each took."""

    boxes: list[np.ndarray]
    seconds: list[float]


def detect_all(source: Source) -> Detected:
    """What moves in each frame; the background is learned on the way. Reading is timed too."""
    detector = BackgroundSubtraction()
    boxes, seconds = [], []
    start = time.perf_counter()
    for still in tqdm(source.read(), total=source.num_frames, desc="Detection", disable=None):
        boxes.append(detector.detect(still))
        seconds.append(time.perf_counter() - start)
        start = time.perf_counter()
    return Detected(boxes, seconds)


def make_mixtures() -> dict[str, mpfjax.Filter]:
    """Each component's filter: with resampling, and with Gaussian regeneration.

    A component is an object, so that the components of a mixture have the same weight and are
    filters side by side. Place (x, y, log w, log h) and velocity are in boxes.
    """
    place, velocity = np.array(PLACE_NOISE), np.array(VELOCITY_NOISE)
    model = mpfjax.LinearGaussianModel(
        A=np.kron([[1.0, 1.0], [0.0, 1.0]], np.eye(4)),
        Q=np.diag(np.concatenate([place, velocity]) ** 2),
        H=np.eye(4, 8),
        R=np.diag(np.array(ERRORS) ** 2),
        m0=np.zeros(8),
        P0=np.diag(np.concatenate([ERRORS, START_VELOCITY]) ** 2),
    )
    # Of the model's own transition most particles would miss a detection's sharp likelihood.
    guided = mpfjax.GaussNewtonProposal(model, num_iterations=1, inflation=1.0)
    return {
        "mpf": mpfjax.particle_filter(model, PARTICLES, proposal=guided),
        "gm_mpf": mpfjax.gaussian_particle_filter(model, PARTICLES, proposal=guided),
    }


class Born(NamedTuple):
    """A mixture whose components are born and ended by the detections of a tracker.

    `identities` and `units` are of the object of each component; `clouds` are its particles, with
    axes for runs and components.
    """

    tracked: TrackerState
    identities: Int[Array, " m"]
    units: Float[Array, "m 4"]
    clouds: mpfjax.ParticleMixture


def track_detected(
    filter: mpfjax.Filter, keys: Array, source: Source, detected: Detected
) -> tuple[Callable, Callable]:
    """What yields the frames of the runs of a mixture, and what makes tracks of them.

    The seconds of a frame are those of reading, detecting and tracking.
    """
    kept: list[Tracks] = []
    tracker = ObjectTracker(MAX_OBJECTS)

    def frames_of_run(bar: tqdm) -> Iterator[tuple[Snapshot, float]]:
        none, runs = jnp.zeros(MAX_OBJECTS, jnp.int32), (len(keys), MAX_OBJECTS)
        clouds = jax.tree.map(
            lambda leaf: jnp.broadcast_to(leaf, (*runs, *leaf.shape)), filter.init(keys[0])
        )
        born = Born(tracker.init(), none, jnp.ones((MAX_OBJECTS, 4)), clouds)
        for t, (still, boxes) in enumerate(zip(source.read(), detected.boxes, strict=True)):
            start = time.perf_counter()
            found = Detections.from_boxes(boxes, MAX_DETECTIONS)
            seen = tracker.look(still, found)
            born, tracks, snapshot = _advance(
                tracker, filter, keys, jnp.asarray(t), born, seen, found
            )
            kept.append(jax.tree.map(np.asarray, tracks))
            snapshot = jax.tree.map(np.asarray, snapshot)
            bar.update()
            yield snapshot, time.perf_counter() - start + detected.seconds[t]

    def rows_of_run(snapshots: list[Snapshot]) -> list[np.ndarray]:
        tracked = list(zip(kept, snapshots, strict=False))
        return [
            offline_rows((now._replace(boxes=of.means[run]) for now, of in tracked), source.first)
            for run in range(len(keys))
        ]

    return frames_of_run, rows_of_run


@eqx.filter_jit
def _advance(tracker, filter, keys, t, born: Born, seen, found):
    tracked, tracks = tracker.step(None, born.tracked, seen, found)
    mine = found.rows[None] == tracks.detections[:, None]
    boxes = found.boxes[jnp.argmax(mine, axis=1)]
    there = tracks.detections >= 0
    new = tracks.identities != born.identities
    sizes = jnp.concatenate([boxes[:, 2:], jnp.ones_like(boxes[:, 2:])], axis=1)
    units = jnp.where(there[:, None], sizes, born.units)
    ratios = jnp.tile(born.units / units, 2)
    places = boxes.at[:, 2:].set(jnp.log(boxes[:, 2:])) / units

    def component(key, cloud, ratio, place, there, new):
        cloud = cloud.replace(particles=cloud.particles * ratio[None])
        begun = filter.init(key)
        begun = begun.replace(particles=begun.particles.at[:, :4].add(place[None]))
        updated, predicted = filter.step(key, cloud, place)[0], filter.predict(key, cloud)[0]
        moved = jax.tree.map(partial(jnp.where, there), updated, predicted)
        return jax.tree.map(partial(jnp.where, new), begun, moved)

    def run(key, clouds):
        split = jax.random.split(jax.random.fold_in(key, t), len(units))
        return jax.vmap(component)(split, clouds, ratios, places, there, new)

    clouds = jax.vmap(run)(keys, born.clouds)
    if any(isinstance(move, mpfjax.GaussianRegeneration) for move in filter.moves):
        clouds = _redrawn(jax.random.fold_in(keys[0], t), clouds, tracked.objects, units)
    weights = jax.nn.softmax(clouds.log_weights, axis=-1)
    means = jnp.sum(weights[..., None] * clouds.particles[..., :4], axis=2) * units[None]
    means = means.at[..., 2:].set(jnp.exp(means[..., 2:]))
    runs, m, n = weights.shape
    points = clouds.particles[..., :2] * units[None, :, None, :2]
    owners = jnp.where(tracks.identities > 0, jnp.arange(m, dtype=jnp.int32), -1)
    labels = jnp.broadcast_to(owners[None, :, None], (runs, m, n)).reshape(runs, -1)
    shown = jnp.broadcast_to(tracks.shown[None], (runs, m))
    snapshot = Snapshot(means, shown, points.reshape(runs, -1, 2), labels)
    return Born(tracked, tracks.identities, units, clouds), tracks, snapshot


def _redrawn(key, clouds, gaussian, units):
    """Particles drawn anew from the Gaussian of each component, about its mean."""
    noise = jax.random.normal(key, (*clouds.particles.shape[:-1], 4))
    noise -= jnp.mean(noise, axis=2, keepdims=True)
    places = gaussian.place[None, :, None] + jnp.sqrt(gaussian.var_place)[None, :, None] * noise
    particles = clouds.particles.at[..., :4].set(places / units[None, :, None])
    drawn = particles, jnp.zeros_like(clouds.log_weights)
    return eqx.tree_at(lambda mixture: (mixture.particles, mixture.log_weights), clouds, drawn)
