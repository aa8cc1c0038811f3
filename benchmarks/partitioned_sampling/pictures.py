"""Figures 4 and 8, recovery against λ, and what runs look like."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from benchmarks import figures as plotting
from benchmarks.harness import figures
from benchmarks.partitioned_sampling.scenes import Kept, Scene
from benchmarks.partitioned_sampling.study import Order, Row
from benchmarks.partitioned_sampling.tables import TITLES, label
from mpfjax.vision.files import drawing, frames

ANIMATION_RATE, MOST_DRAWN = 5.0, 100  # frames a second, particles


def write_pictures(
    out: Path, scenes: Sequence[Scene], rows: Sequence[Row], content: dict[str, Any]
) -> None:
    """All figures, and an animation of a PS run that fails beside a DPS run that recovers."""
    drawn = draw_impoverishment(scenes[0], rows, content), draw_recovery(content)
    figures(out, dpi=110, uniqueness=drawn[0], recovery=drawn[1])
    scene, runs = pair_of_runs(scenes, rows)
    if not runs:
        return
    shown = np.linspace(2, len(scene.stills) - 1, 4).round().astype(int).clip(0)
    sheet = [(name, [annotate(scene, kept, t) for t in shown]) for name, kept in runs]
    titles = [f"frame {scene.first + t}" for t in shown]
    figures(out, dpi=90, contact_sheet=plotting.draw_contact_sheet(sheet, titles))
    between = np.full((scene.stills.shape[1], 4, 3), 255, np.uint8)

    def beside(t: int) -> np.ndarray:
        parts = [part for _, kept in runs for part in (annotate(scene, kept, t), between)]
        return np.concatenate(parts[:-1], axis=1)

    pictures = (beside(t) for t in range(len(scene.stills)))
    frames.write_video(out / "recovery.gif", pictures, ANIMATION_RATE)


def title(method: str, order: Order) -> str:
    """What a picture calls a filter."""
    name = TITLES.get(method, method)
    return name if order is None else f"{name} {{{'→'.join(str(j + 1) for j in order)}}}"


def draw_impoverishment(scene: Scene, rows: Sequence[Row], content: dict[str, Any]) -> Any:
    """Figures 4 and 8: uniqueness and effective dynamics of each object, in per cent.

    Of the orders only those with the hard object first and last.
    """
    chosen = {}
    for row in rows:
        if row.scene != scene.key or row.kept.uniqueness is None:
            continue
        if row.order is not None and scene.hard not in (row.order[0], row.order[-1]):
            continue
        name = label(row.method, row.order)
        dynamics = content["effective_dynamics"][name]
        values = (content["uniqueness"][name], dynamics["u"], dynamics["v"])
        chosen[title(row.method, row.order)] = [100 * np.array(value) for value in values]
    names = ["uniqueness U/N [%]", "effective dynamics in u [%]", "effective dynamics in v [%]"]
    return plotting.draw_object_bars(chosen, names)


def draw_recovery(content: dict[str, Any]) -> Any:
    """The hard object's recovery rate by every filter against λ, means over scenes."""
    (table,) = [name for name in content["means"] if name != "1"]
    ends: dict[str | None, str] = {None: "", "mean": ", mean of orders", "worst": ", worst order"}
    lines = plotting.lines_of(
        [entry for entry in content["means"][table] if entry["order"] in ends],
        lambda entry: str(TITLES.get(entry["method"], entry["method"])) + ends[entry["order"]],
        "lambda", "recovery", *(lambda e, i=i: e["recovery_interval"][i] for i in (0, 1)),
    )  # fmt: skip
    num = len(content["scenes"])
    what = f"mean of {num} scenes" if num > 1 else content["scenes"][0]["source"]
    title = f"the distracted or hidden object, {what}, 95% intervals"
    panel = plotting.Panel(title, r"$\lambda$", "recovery rate", lines, (-0.03, 1.03))
    return plotting.draw_panels([[panel]], ("linear", "linear"))


def pair_of_runs(
    scenes: Sequence[Scene], rows: Sequence[Row]
) -> tuple[Scene, list[tuple[str, Kept]]]:
    """A PS run that fails and a DPS run that recovers, on the first scene that has both.

    Where there is no such pair, any runs of the first scene take their place.
    """

    def first(scene: Scene, method: str, recovers: bool) -> tuple[str, Kept] | None:
        own = [row for row in rows if (row.scene, row.method) == (scene.key, method) and row.shown]
        having = [row for row in own if row.shown[recovers] is not None]
        if not own:
            return None
        row = (having or own)[0]
        run = row.shown[recovers] if having else 0
        outcome = "recovers" if recovers == bool(having) else "fails"
        kept = jax.tree.map(lambda leaf: leaf[run], row.kept._replace(centres=None))
        name = f"{title(method, row.order)} {outcome}"
        return name, kept._replace(centres=row.kept.centres[0 if recovers else 1])

    for scene in [*scenes, scenes[0]]:
        found = [first(scene, "ps", False), first(scene, "dps", True)]
        pair = [entry for entry in found if entry is not None]
        wanted = [entry for entry, end in zip(found, ("fails", "recovers"), strict=True)
                  if entry is not None and entry[0].endswith(end)]  # fmt: skip
        if len(wanted) == 2:
            break
    return scene, pair  # of the first scene again where none has both


def annotate(scene: Scene, kept: Kept, t: int) -> np.ndarray:
    """A frame with the particles and mean boxes of one run; the hard object's true box in white."""
    canvas, palette = scene.stills[t].astype(float), drawing.PALETTE
    for j in range(scene.num_objects):
        centres = kept.centres[t, :: 1 + kept.centres.shape[1] // MOST_DRAWN, j]
        drawing.draw_points(canvas, centres, np.broadcast_to(palette[j], (len(centres), 3)), 1.2)
    drawing.draw_box(canvas, scene.truth[t, scene.hard], np.full(3, 255.0), 1.5)
    for j in range(scene.num_objects):
        drawing.draw_box(canvas, kept.boxes[t, j], palette[j], 2.0)
    return np.clip(canvas, 0, 255).astype(np.uint8)
