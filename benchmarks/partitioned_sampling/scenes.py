"""What the filters run on: synthetic scenes that a rule has chosen, and stretches of real ones.

A stretch is where one object is hidden by another and comes out elsewhere, by the boxes alone: in
six successive frames or more, the box of another object that reaches farther down the image, and so
is nearer to the camera, covers at least half of the object's box; the object has a box in the frame
before and in the frame after; and between those two its centre moves by at least half the width
that it went in with. The rule says nothing of looks, and no filter has run.
"""

from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

import mpfjax
from benchmarks.partitioned_sampling import posterior
from benchmarks.partitioned_sampling.effective_dynamics import effective_dynamics
from benchmarks.partitioned_sampling.posterior import Verdict, Window, judge
from benchmarks.scenes import NoPath, boxes_over_time, distracter_scene
from mpfjax import vision
from mpfjax.metrics import uniqueness
from mpfjax.vision.boxes.joint_colour import PAPER_DEVIATIONS, object_boxes
from mpfjax.vision.files import boxes as box_files

PAPER_WIDTH = 360  # the frames in which a step deviates by two pixels
MOST_TRIED = 100  # keys, before there are too few scenes
Collector = Callable[[mpfjax.ParticleMixture], "Kept"]


class Kept(NamedTuple):
    """What is kept of every step of a run; only the boxes where that is all there is to show."""

    boxes: Any  # (objects, 4), of the mean state
    uniqueness: Any = None  # (objects,)
    dynamics: Any = None  # (objects, 2), variance of u and v over the particles
    centres: Any = None  # (n, objects, 2)


class Scene(NamedTuple):
    """Frames, the objects in them, and what the filters know of both."""

    key: int | str  # what the rows of the tables call it
    name: str
    stills: np.ndarray  # (t, h, w, 3)
    first: int  # the number of the first frame
    truth: np.ndarray  # (t, objects, 4), top-left corner first, NaN where there is none
    hard: int  # which object is distracted or occluded, from 0 on
    observations: Any
    model_at: Callable[[float], mpfjax.MultiObjectModel]  # of λ
    collector: Callable[[bool], Collector]  # of whether to keep everything, or the boxes
    deviations: np.ndarray  # of a step in u and v
    verdict: Verdict | None = None  # of 20 000 particles on the hard object alone
    exact: Verdict | None = None

    @property
    def num_objects(self) -> int:
        """J."""
        return self.truth.shape[1]


class Setting(NamedTuple):
    """What `distracter_scene` leaves open, and the tracker's momentum, which the paper prints."""

    size: tuple[int, int] = (24, 24)
    speed: float = 0.0
    deviation: float = 4.0
    noise: Literal["grey", "colour"] = "grey"
    momentum: float = 0.5


DEFAULT = Setting()

# --- synthetic --------------------------------------------------------------------------------


def synthetic_scenes(
    keys: Sequence[int], most: int | None = None, setting: Setting = DEFAULT
) -> Iterator[tuple[int, Scene | None]]:
    """Each key with its scene, or None: no path, or the posterior of object 1 speaks against it.

    No filter has run by then. Raises `ValueError` where the keys do not hold `most` scenes.
    """
    found = 0
    for key in keys:
        try:
            scene = synthetic_scene(key, setting, only_if_kept=True)
        except NoPath:
            scene = None
        found += scene is not None
        yield key, scene
        if found == most:
            return
    if most is not None:
        raise ValueError(
            f"--scenes: {most}, but of the {len(keys)} keys from {keys[0]} on the posterior"
            f" keeps {found}"
        )


def synthetic_scene(
    key: int, setting: Setting = DEFAULT, *, only_if_kept: bool = False
) -> Scene | None:
    """The seven objects of section 3.2 and their distracter; None where not to be kept."""
    drawn = distracter_scene(
        jax.random.key(key), size=setting.size, speed=setting.speed, deviation=setting.deviation,
        noise=setting.noise,
    )  # fmt: skip
    starts = drawn.boxes[0, :, :2] + drawn.boxes[0, :, 2:] / 2
    learned = vision.joint_colour_model(
        drawn.frames[0], drawn.boxes[0], templates={0: drawn.template}
    )
    # Of one reference and one channel each: (objects, parts, bins).
    references = np.asarray(learned.object_model.references)[:, 0, :, 0]  # pyright: ignore
    bins = np.asarray(_bins(jnp.asarray(drawn.frames)))
    sides = setting.size
    whole = Window.whole(bins[0], sides)

    def maps_of(objects: slice) -> np.ndarray:
        return np.stack(
            [posterior.distance_maps(one, references[objects], sides, whole) for one in bins]
        )

    first, steps = maps_of(slice(0, 1)), PAPER_DEVIATIONS[:2]
    means = posterior.particle_means(first[:, 0], starts[0], sides, steps)
    verdict = judge(means, drawn.boxes[:, 0])
    if only_if_kept and not verdict.keeps:
        return None
    exact = judge(
        posterior.posterior_means(bins, references[0], starts[0], sides), drawn.boxes[:, 0]
    )
    maps = np.concatenate([first, maps_of(slice(1, None))], axis=1)
    return Scene(
        key, f"synthetic sequence of key {key}", drawn.frames, 1, drawn.boxes, 0, jnp.asarray(maps),
        lambda lambda_: posterior.mapped_model(starts, sides, lambda_, setting.momentum, steps),
        lambda everything: _place_collector(sides, everything), np.array(steps), verdict, exact,
    )  # fmt: skip


@jax.jit
@jax.vmap
def _bins(frame):
    """The colour of every pixel."""
    return vision.HSVColours().bins(frame)[:, :, 0]


@lru_cache
def _place_collector(sides: tuple[int, int], everything: bool) -> Collector:
    """What to keep of places; the same function for all scenes, which then share a program."""

    def collect(mixture: mpfjax.ParticleMixture) -> Kept:
        mean = mixture.average(mixture.particles.place)
        size = jnp.broadcast_to(jnp.asarray(sides, mean.dtype), mean.shape)
        boxes = jnp.concatenate([mean - size / 2, size], axis=-1)
        if not everything:
            return Kept(boxes)
        dynamics = effective_dynamics(mixture).place
        return Kept(boxes, uniqueness(mixture), dynamics, mixture.particles.place)

    return collect


# --- real -------------------------------------------------------------------------------------

LEAST_FRAMES, LEAST_COVER, LEAST_WAY = 6, 0.5, 0.5
AROUND = 10  # frames that are shown before and after
MOST_OBJECTS = 4  # of a joint filter, as in the paper's largest


class Event(NamedTuple):
    """A part of a sequence in which the first of its objects is hidden and comes back.

    `hidden`: the first and the last frame of it, None where nobody has said.
    """

    ids: tuple[int, ...]
    frames: tuple[int, int | None]
    hidden: tuple[int, int] | None = None


def find_events(folder: Path) -> list[Event]:
    """Every event of a sequence in the order of objects and frames.

    Its objects are the hidden one, those that hide it, and, up to four, the others with a box in
    every frame, in the order of their ids. It starts ten frames before, or when all who hide it
    are there, and ends ten frames after, or with the object; who comes only to hide it is none of
    its objects. Raises `ValueError` for a sequence without any.
    """
    if not folder.is_dir():
        raise ValueError(f"--sequence: {folder} is not a folder")
    rows = vision.read_truth(folder / "gt.txt").objects
    ids = sorted({int(id) for id in rows[:, 1]})
    boxes = boxes_over_time(rows, ids, 0, int(rows[:, 0].max()) + 1)
    events = [event for j in range(len(ids)) for event in _events_of(j, ids, boxes)]
    if not events:
        raise ValueError(
            f"--sequence: in {folder.name} no object is covered for {LEAST_FRAMES} frames and comes"
            " out elsewhere; give --ids and --frames"
        )
    return events


def cover(
    box: Float[np.ndarray, "frames 4"], others: Float[np.ndarray, "frames objects 4"]
) -> Float[np.ndarray, "frames objects"]:
    """The share of a box that each other box before it covers, 0 where one is missing."""
    box = box[:, None]
    low = np.maximum(box[..., :2], others[..., :2])
    high = np.minimum(box[..., :2] + box[..., 2:], others[..., :2] + others[..., 2:])
    share = np.clip(high - low, 0, None).prod(axis=-1) / box[..., 2:].prod(axis=-1)
    is_before = others[..., 1] + others[..., 3] > box[..., 1] + box[..., 3]
    return np.where(is_before & np.isfinite(share), share, 0.0)


def _events_of(j: int, ids: list[int], boxes: np.ndarray) -> list[Event]:
    covers = cover(boxes[:, j], boxes)
    is_hidden = covers.max(axis=1) >= LEAST_COVER
    there = np.asarray(np.isfinite(boxes).all(axis=-1))
    edges = np.flatnonzero(np.diff(np.concatenate([[False], is_hidden, [False]]).astype(int)))
    events = []
    for first, end in edges.reshape(-1, 2):
        before, after = first - 1, end
        if end - first < LEAST_FRAMES or after >= len(boxes):
            continue
        if not (there[before, j] and there[after, j]):
            continue
        way = boxes[after, j, :2] - boxes[before, j, :2]
        way = way + (boxes[after, j, 2:] - boxes[before, j, 2:]) / 2
        if np.linalg.norm(way) < LEAST_WAY * boxes[before, j, 2]:
            continue
        hiding = covers[first:end].argmax(axis=1)
        hidden_by = list(dict.fromkeys(hiding[covers[first:end].max(axis=1) >= LEAST_COVER]))
        start = int(max(first - AROUND, 1))
        stop = int(min(end - 1 + AROUND, len(boxes) - 1))
        while not there[start, [j, *hidden_by]].all() and start < before:
            start += 1
        while not there[stop, j]:
            stop -= 1
        chosen = [k for k in [j, *hidden_by] if there[start, k]]
        whole = [k for k in range(len(ids)) if there[start : stop + 1, k].all()]
        chosen += [k for k in whole if k not in chosen]
        chosen = [ids[k] for k in chosen[:MOST_OBJECTS]]
        events.append(Event(tuple(chosen), (start, stop), (int(first), int(end) - 1)))
    return events


def real_scene(folder: Path, event: Event) -> Scene:
    """A stretch of a sequence with a gt.txt; steps deviate in proportion to the frame's width."""
    first, last = event.frames
    if not folder.is_dir():
        raise ValueError(f"--sequence: {folder} is not a folder")
    stills = np.stack(list(vision.read_frames(folder, first, last)))
    rows = vision.read_truth(folder / "gt.txt").objects
    started = box_files.boxes_of_frame(rows, first)
    ids = event.ids or tuple(sorted(started))
    missing = [id for id in ids if id not in started]
    if missing or not ids:
        raise ValueError(f"--ids: gt.txt has no box of {missing or 'any object'} in frame {first}")
    truth = boxes_over_time(rows, ids, first, len(stills))
    deviations = np.array(PAPER_DEVIATIONS)
    deviations[:2] *= stills.shape[2] / PAPER_WIDTH
    steps = tuple(deviations.tolist())

    def model_at(lambda_: float) -> mpfjax.MultiObjectModel:
        return vision.joint_colour_model(stills[0], truth[0], lambda_=lambda_, deviations=steps)

    model = model_at(1.0)
    span = f"{first}-{first + len(stills) - 1}"
    name = f"{folder.name}, objects {', '.join(map(str, ids))}, frames {span}"

    def collect_boxes(mixture: mpfjax.ParticleMixture) -> Kept:
        return Kept(mixture.average(object_boxes(model, mixture.particles)))

    def collect(mixture: mpfjax.ParticleMixture) -> Kept:
        return Kept(
            collect_boxes(mixture).boxes,
            uniqueness(mixture),
            effective_dynamics(mixture).box[:, :2],
            mixture.particles.box[:, :, :2],
        )

    return Scene(
        f"{folder.name} {ids[0]} {span}", name, stills, first, truth, 0, jnp.asarray(stills),
        model_at,
        lambda everything: collect if everything else collect_boxes, deviations[:2],
    )  # fmt: skip
