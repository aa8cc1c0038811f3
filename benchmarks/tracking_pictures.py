"""What the benchmarks that track objects in video keep of a run, and the pictures of it."""

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mpfjax.plotting import draw_contact_sheet
from mpfjax.vision import boxes as box_files
from mpfjax.vision import drawing, frames

NAMES = {
    "pf": "Particle filter",
    "mpf": "Mixture particle filter",
    "gm_mpf": "Gaussian mixture particle filter",
}
KEY_FRAMES = 4


class Source(NamedTuple):
    """Where the frames come from, and what is known of the objects in them."""

    name: str
    read: Callable[[], Iterable[np.ndarray]]
    first: int  # the number of the first frame
    num_frames: int | None  # None where only reading on will tell
    boxes: np.ndarray  # (k, 4), where the objects start
    truth: np.ndarray | None  # rows of the objects to score against
    all_labelled: bool  # whether the truth knows every object that was started


class Snapshot(NamedTuple):
    """What one run keeps of one frame, and the same with a leading axis of runs."""

    means: Any  # (m, 4), mean box of each component, centre and size
    active: Any  # (m,)
    points: Any  # (n, 2), centres of the particles
    labels: Any  # (n,), the component of each, -1 in an empty slot


def annotate(
    still: np.ndarray,
    snapshot: Snapshot,
    zoom: int,
    crop: tuple[slice, slice] = (slice(None), slice(None)),
) -> np.ndarray:
    """A frame, cropped and enlarged, with one run's particles and mean boxes.

    Both are drawn in the colour of their component.
    """
    canvas = still[crop].repeat(zoom, axis=0).repeat(zoom, axis=1).astype(float)
    corner = np.array([crop[1].start or 0, crop[0].start or 0], float)
    labels, palette = snapshot.labels[0], drawing.PALETTE
    for m in np.flatnonzero(snapshot.active[0]):
        box = box_files.top_left(snapshot.means[0][m][None])[0] - [*corner, 0, 0]
        drawing.draw_box(canvas, zoom * box, palette[m % len(palette)], thickness=2)
    filled = labels >= 0
    points = zoom * (snapshot.points[0][filled] - corner)
    drawing.draw_points(canvas, points, palette[labels[filled] % len(palette)], 0.9 * zoom)
    return np.clip(canvas, 0, 255).astype(np.uint8)


def write_video(path: Path, source: Source, tracked: dict[str, list[Snapshot]]) -> None:
    """The annotated frames of the filters side by side, PF to the left."""
    frames.write_video(path, _panels(source, tracked))


def _panels(source: Source, tracked: dict[str, list[Snapshot]]) -> Iterator[np.ndarray]:
    for still, *snapshots in zip(source.read(), *tracked.values(), strict=False):
        zoom = _zoom(still)
        yield np.concatenate([annotate(still, s, zoom) for s in snapshots], axis=1)


def write_contact_sheet(path: Path, source: Source, tracked: dict[str, list[Snapshot]]) -> None:
    """Key frames in the manner of the paper's figure 3: a row for each filter, cropped to both."""
    length = min(len(snapshots) for snapshots in tracked.values())
    chosen = np.unique(np.linspace(0, length - 1, KEY_FRAMES).round().astype(int))
    stills = {
        t: still for t, still in zip(range(length), source.read(), strict=False) if t in chosen
    }
    shown = [snapshots[t] for snapshots in tracked.values() for t in chosen]
    crop = _region(shown, source.boxes, stills[0].shape)
    zoom = max(1, round(900 / (crop[1].stop - crop[1].start)))
    rows = [
        (
            NAMES[name].replace(" ", "\n", 1),
            [annotate(stills[t], snapshots[t], zoom, crop) for t in chosen],
        )
        for name, snapshots in tracked.items()
    ]
    titles = [f"frame {source.first + t}" for t in chosen]
    draw_contact_sheet(rows, titles).savefig(path, dpi=110)


def _region(shown: list[Snapshot], boxes: np.ndarray, shape: tuple) -> tuple[slice, slice]:
    """The rows and columns of the frame in which anything happens, with room around."""
    points = np.concatenate([s.points[0][s.labels[0] >= 0] for s in shown])
    centres = np.concatenate([points, box_files.centred(boxes)[:, :2]])
    margin = 1.2 * boxes[:, 2:].max(axis=0)
    low, high = centres.min(axis=0) - margin, centres.max(axis=0) + margin
    (left, top), (right, bottom) = low.astype(int), high.astype(int)
    height, width, _ = shape
    return slice(max(top, 0), min(bottom, height)), slice(max(left, 0), min(right, width))


def _zoom(still: np.ndarray) -> int:
    return max(1, round(640 / still.shape[1]))
