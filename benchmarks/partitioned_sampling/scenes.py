"""What the filters run on: synthetic scenes that a rule has chosen, and stretches of real ones.

A stretch is where one object is hidden by another and comes out elsewhere, by the boxes alone: in
six successive frames or more, the box of another object that reaches farther down the image, and so
is nearer to the camera, covers at least half of the object's box; the object has a box in the frame
before and in the frame after; and between those two its centre moves by at least half the width
that it went in with. The rule says nothing of looks, and no filter has run.
"""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import mpfjax
from benchmarks.partitioned_sampling import posterior
from benchmarks.partitioned_sampling.posterior import Verdict, judge
from benchmarks.scenes import NoPath, boxes_over_time, cover, distracter_scene
from mpfjax import vision
from mpfjax.vision.boxes.joint_colour import PAPER_DEVIATIONS, object_boxes

PAPER_WIDTH = 360  # the frames in which a step deviates by two pixels
MOST_TRIED = 100  # keys, before there are too few scenes


class Scene(NamedTuple):
    """Frames, the objects in them, and what the filters know of both.

    The first object is the hard one, which is distracted or hidden.
    """

    key: int | str  # what the rows of the tables call it
    name: str
    stills: np.ndarray  # (t, h, w, 3)
    first: int  # the number of the first frame
    truth: np.ndarray  # (t, objects, 4), top-left corner first, NaN where there is none
    observations: Any
    model_at: Callable[[float], mpfjax.MultiObjectModel]  # of λ
    boxes_of: Callable[[Any, Any], Any]  # of the model and particles, (n, objects, 4)
    deviations: np.ndarray  # of a step in u and v
    tables: dict[str, slice]  # the objects of each table
    verdict: Verdict | None = None  # of 20 000 particles on the hard object alone


# --- synthetic --------------------------------------------------------------------------------

# What `distracter_scene` leaves open, and the tracker's momentum, which the paper prints.
DEFAULT: dict[str, Any] = {"size": (24, 24), "speed": 0.0, "momentum": 0.5}


def synthetic_scenes(
    keys: Sequence[int], most: int | None = None, setting: dict[str, Any] = DEFAULT
) -> Iterator[tuple[int, Scene | None]]:
    """Each key with its scene, or None: no path, or the posterior of object 1 speaks against it.

    It ends with the scene that makes them `most`, or with the keys. No filter has run by then.
    """
    number = 0
    for key in keys:
        try:
            scene = synthetic_scene(key, only_if_kept=True, **setting)
        except NoPath:
            scene = None
        number += scene is not None
        yield key, scene
        if number == most:
            return


def synthetic_scene(
    key: int, *, momentum: float, size: tuple[int, int], speed: float, only_if_kept: bool = False
) -> Scene | None:
    """The seven objects of section 3.2 and their distracter; None where not to be kept."""
    drawn = distracter_scene(jax.random.key(key), size=size, speed=speed)
    starts = drawn.boxes[0, :, :2] + drawn.boxes[0, :, 2:] / 2
    learned = vision.joint_colour_model(
        drawn.frames[0], drawn.boxes[0], templates={0: drawn.template}
    )
    # Of one reference and one channel each: (objects, parts, bins).
    references = np.asarray(learned.object_model.references)[:, 0, :, 0]  # pyright: ignore
    bins = np.asarray(_bins(jnp.asarray(drawn.frames)))
    steps = PAPER_DEVIATIONS[:2]

    def maps_of(objects: slice) -> np.ndarray:
        return np.stack([posterior.distance_maps(one, references[objects], size) for one in bins])

    first = maps_of(slice(0, 1))
    means = posterior.particle_means(first, starts[0], size, steps)
    verdict = judge(means, drawn.boxes[:, 0])
    if only_if_kept and not posterior.keeps(verdict, len(bins)):
        return None
    maps = np.concatenate([first, maps_of(slice(1, None))], axis=1)
    return Scene(
        key, f"synthetic sequence of key {key}", drawn.frames, 1, drawn.boxes, jnp.asarray(maps),
        lambda lambda_: posterior.mapped_model(starts, size, lambda_, momentum, steps),
        posterior.mapped_boxes, np.array(steps), {"1": slice(1, None), "2": slice(0, 1)}, verdict,
    )  # fmt: skip


@jax.jit
@jax.vmap
def _bins(frame):
    """The colour of every pixel."""
    return vision.HSVColours().bins(frame)[:, :, 0]


# --- real -------------------------------------------------------------------------------------

LEAST_FRAMES, LEAST_COVER, LEAST_WAY = 6, 0.5, 0.5
AROUND = 10  # frames that are shown before and after
MOST_OBJECTS = 4  # of a joint filter, as in the paper's largest


Event = tuple[list[int], int, int]  # the ids, the hidden one first, and the frames


def real_scenes(folders: Sequence[Path]) -> Iterator[tuple[str, Scene]]:
    """Every event of the sequences in the order of objects and frames, by name.

    Its objects are the hidden one, those that hide it, and, up to four, the others with a box in
    every frame, in the order of their ids. It starts ten frames before, or when all who hide it
    are there, and ends ten frames after, or with the object; who comes only to hide it is none of
    its objects. Raises `ValueError` for a sequence without any.
    """
    candidates = []
    for folder in folders:
        if not folder.is_dir():
            raise ValueError(f"--sequence: {folder} is not a folder")
        rows = vision.read_truth(folder / "gt.txt").objects
        ids = sorted({int(id) for id in rows[:, 1]})
        boxes = boxes_over_time(rows, ids, 0, int(rows[:, 0].max()) + 1)
        events = [event for j in range(len(ids)) for event in _events_of(j, ids, boxes)]
        if not events:
            raise ValueError(
                f"--sequence: in {folder.name} no object is covered for {LEAST_FRAMES} frames and"
                " comes out elsewhere"
            )
        candidates += [(folder, rows, *event) for event in events]
    for event in candidates:
        scene = _real_scene(*event)
        yield scene.name, scene


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
        events.append(([ids[k] for k in chosen[:MOST_OBJECTS]], start, stop))
    return events


def _real_scene(folder: Path, rows: np.ndarray, ids: list[int], first: int, last: int) -> Scene:
    """A stretch of a sequence; steps deviate in proportion to the frame's width."""
    stills = np.stack(list(vision.read_frames(folder, first, last)))
    truth = boxes_over_time(rows, ids, first, len(stills))
    deviations = np.array(PAPER_DEVIATIONS)
    deviations[:2] *= stills.shape[2] / PAPER_WIDTH
    steps = tuple(deviations.tolist())

    def model_at(lambda_: float) -> mpfjax.MultiObjectModel:
        return vision.joint_colour_model(stills[0], truth[0], lambda_=lambda_, deviations=steps)

    span = f"{first}-{first + len(stills) - 1}"
    name = f"{folder.name}, objects {', '.join(map(str, ids))}, frames {span}"
    return Scene(
        f"{folder.name} {ids[0]} {span}", name, stills, first, truth, jnp.asarray(stills),
        model_at, object_boxes, deviations[:2], {"3": slice(0, 1)},
    )  # fmt: skip
