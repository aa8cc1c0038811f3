"""The pictures of a run: an annotated video, and a contact sheet of its key frames."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.figures import draw_contact_sheet, draw_points, region
from benchmarks.harness import write_figure
from benchmarks.visual_tracking.following import Snapshot
from benchmarks.visual_tracking.source import Source
from mpfjax.vision.files import boxes as box_files
from mpfjax.vision.files import drawing, frames

NAMES = {
    "pf": "Particle filter",
    "mpf": "Mixture particle filter",
    "gm_mpf": "Gaussian mixture particle filter",
}
KEY_FRAMES = 4
WHOLE = (slice(None), slice(None))
LEGEND = {"particles": 1, "mean box of a component": 2}  # and the numbers of their colours


def write_video(path: Path, source: Source, tracked: dict[str, list[Snapshot]]) -> None:
    """The annotated frames of the filters side by side, PF to the left."""

    def beside(still: np.ndarray, snapshots: Sequence[Snapshot]) -> np.ndarray:
        zoom = max(1, round(640 / still.shape[1]))
        return np.concatenate([annotated(still, s, zoom) for s in snapshots], axis=1)

    shown = zip(source.read(), *tracked.values(), strict=False)
    frames.write_video(path, (beside(still, snapshots) for still, *snapshots in shown))


def write_contact_sheet(path: Path, source: Source, tracked: dict[str, list[Snapshot]]) -> None:
    """Key frames in the manner of the paper's figure 3, cropped to most of the particles."""
    length = min(len(snapshots) for snapshots in tracked.values())
    chosen = np.unique(np.linspace(0, length - 1, KEY_FRAMES).round().astype(int))
    stills = {
        t: still for t, still in zip(range(length), source.read(), strict=False) if t in chosen
    }
    shown = [snapshots[t] for snapshots in tracked.values() for t in chosen]
    held = [s.points[0][s.labels[0] >= 0] for s in shown]
    points = [np.quantile(each, (0.1, 0.9), axis=0) for each in held if len(each)]
    points = np.concatenate([*points, box_files.to_centre(source.boxes)[:, :2]])
    crop = region(points, source.boxes[:, 2:], stills[0].shape)
    zoom = max(1, round(900 / (crop[1].stop - crop[1].start)))
    columns = [
        (
            NAMES[name],
            [annotated(stills[t], snapshots[t], zoom, crop, [*LEGEND.values()]) for t in chosen],
        )
        for name, snapshots in tracked.items()
    ]
    titles = [f"frame {source.first + t}" for t in chosen]
    write_figure(path, draw_contact_sheet(columns, titles, LEGEND), dpi=110)


def annotated(
    still: np.ndarray,
    snapshot: Snapshot,
    zoom: int,
    crop: tuple[slice, slice] = WHOLE,
    colours: Sequence[int] | None = None,
) -> np.ndarray:
    """A crop with the particles and the mean boxes of the first run.

    Both have the colour of their component; with `colours` all particles have the first of these,
    and all boxes the second.
    """
    image, draw = drawing.canvas_of(still[crop].repeat(zoom, axis=0).repeat(zoom, axis=1))
    corner = np.array([crop[1].start or 0, crop[0].start or 0], float)
    filled, alive = snapshot.labels[0] >= 0, np.flatnonzero(snapshot.active[0])
    of_points, of_boxes = snapshot.labels[0][filled], alive
    if colours is not None:
        of_points, of_boxes = (
            np.full(len(each), colour)
            for each, colour in zip((of_points, of_boxes), colours, strict=True)
        )
    points = zoom * (snapshot.points[0][filled] - corner)
    draw_points(draw, points, of_points, 0.5 * zoom)
    for box, colour in zip(box_files.top_left(snapshot.means[0][alive]), of_boxes, strict=True):
        drawing.draw_box(draw, zoom * (box - [*corner, 0, 0]), int(colour))
    return np.asarray(image)
