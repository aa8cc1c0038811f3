"""Figures 4 and 8, recovery against λ, what runs look like, and the sensitivity's multiples."""

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import jax
import numpy as np
from matplotlib.figure import Figure

from benchmarks import figures as plotting
from benchmarks.partitioned_sampling.scenes import Kept, Scene
from benchmarks.partitioned_sampling.study import Order, Row
from benchmarks.partitioned_sampling.tables import label
from benchmarks.partitioned_sampling.text import TITLES
from mpfjax.console import write_figure
from mpfjax.vision.files import drawing, frames

ANIMATION_RATE, MOST_DRAWN = 5.0, 100  # frames a second, particles


def write_pictures(
    out: Path, scenes: Sequence[Scene], rows: Sequence[Row], content: dict[str, Any]
) -> None:
    """All figures, and an animation of a PS run that fails beside a DPS run that recovers."""
    write_figure(out / "uniqueness.png", draw_impoverishment(scenes[0], rows, content), dpi=110)
    write_figure(out / "recovery.png", draw_recovery(content), dpi=110)
    scene, runs = pair_of_runs(scenes, rows)
    if not runs:
        return
    shown = np.linspace(2, len(scene.stills) - 1, 4).round().astype(int).clip(0)
    sheet = [(name, [annotate(scene, kept, t) for t in shown]) for name, kept in runs]
    titles = [f"frame {scene.first + t}" for t in shown]
    write_figure(out / "contact_sheet.png", plotting.draw_contact_sheet(sheet, titles), dpi=90)
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
    lines: dict[str, list[tuple[float, float, float, float]]] = {}
    for entry in content["means"][table]:
        if entry["order"] in ends:
            name = str(TITLES.get(entry["method"], entry["method"])) + ends[entry["order"]]
            point = (entry["lambda"], entry["recovery"], *entry["recovery_interval"])
            lines.setdefault(name, []).append(point)
    num = len(content["scenes"])
    what = f"mean of {num} scenes" if num > 1 else content["scenes"][0]["source"]
    return plotting.draw_rates(
        lines, xlabel=r"$\lambda$", ylabel="recovery rate",
        title=f"the distracted or hidden object, {what}, 95% intervals",
    )  # fmt: skip


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


TURNED = "the paper's order does not hold"


def draw_sensitivity(entries: Sequence[dict[str, Any]], chosen: dict[str, Any]) -> Figure:
    """Small multiples: a column for each thing that changes, a row for each rate.

    `entries` hold `axis`, `value`, `filter` and the rates with intervals; `chosen` is the value
    of each axis in the tables, at the dotted line. Grey is where the first row does not rise from
    filter to filter as the paper's does, joint below PS below DPS.
    """
    axes_names = [name for name in chosen if any(entry["axis"] == name for entry in entries)]
    panels = [("recovery", "recovery of object 1"), ("precision", "precision of objects 2-7")]
    figure = Figure(figsize=(3.4 * len(axes_names), 5.4), layout="constrained")
    axes = figure.subplots(len(panels), len(axes_names), squeeze=False, sharex="col", sharey="row")
    filters = list(dict.fromkeys(entry["filter"] for entry in entries))
    for column, axis_name in enumerate(axes_names):
        for row, (rate, ylabel) in enumerate(panels):
            axis = axes[row, column]
            axis.axvline(chosen[axis_name], color="0.6", ls=":", lw=1.2)
            own = [e for e in entries if e["axis"] == axis_name]
            places = sorted({entry["value"] for entry in own})
            step = min(np.diff(places), default=1.0)
            for index, name in enumerate(filters):
                points = [e for e in own if e["filter"] == name]
                points.sort(key=lambda entry: entry["value"])
                values = np.array([entry[rate] for entry in points])
                ends = np.array([entry[f"{rate}_interval"] for entry in points]).T
                shift = 0.06 * step * (index - (len(filters) - 1) / 2)
                axis.errorbar(
                    [entry["value"] + shift for entry in points], values,
                    np.maximum([values - ends[0], ends[1] - values], 0), label=name,
                    color=plotting.COLOURS[index], marker=plotting.MARKERS[index], ms=5, lw=1.3,
                    capsize=3,
                )  # fmt: skip
            for low, high in _turned(own, filters) if row == 0 else []:
                axis.axvspan(low, high, color="0.9", lw=0, zorder=0, label=TURNED)
            axis.set_xticks(places)
            axis.grid(alpha=0.25)
            axis.set_ylim(*((-0.03, 1.03) if rate == "recovery" else (0.5, 1.0)))
            if column == 0:
                axis.set_ylabel(ylabel)
        axes[-1, column].set_xlabel(axis_name)
    labelled = [axis.get_legend_handles_labels() for axis in axes[0]]
    legend = {
        name: handle
        for handles, names in labelled
        for handle, name in zip(handles, names, strict=True)
    }
    figure.legend(
        list(legend.values()), list(legend), loc="outside upper center", ncols=len(legend),
        fontsize=9,
    )  # fmt: skip
    return figure


def _turned(entries: Sequence[dict[str, Any]], filters: Sequence[str]) -> list[tuple[float, float]]:
    """Around each value at which recovery does not rise from filter to filter: from, to."""
    places = sorted({entry["value"] for entry in entries})
    middles = [(a + b) / 2 for a, b in pairwise(places)]
    ends = [places[0] - 0.04 * (places[-1] - places[0]), *middles,
            places[-1] + 0.04 * (places[-1] - places[0])]  # fmt: skip
    found = {(entry["value"], entry["filter"]): entry["recovery"] for entry in entries}
    spans = []
    for index, place in enumerate(places):
        rates = [found[place, name] for name in filters if (place, name) in found]
        if rates != sorted(rates):
            spans.append((ends[index], ends[index + 1]))
    return spans
