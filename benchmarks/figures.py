"""Figures of the papers, and of what the benchmarks measure; no command."""

import textwrap
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, NullLocator

from mpfjax.plotting import COLOURS, MARKERS
from mpfjax.vision.files.drawing import PALETTE


def draw_typical_run(
    histories: Mapping[str, Mapping[str, Any]],
    truth: np.ndarray,
    observations: np.ndarray,
    labels: Mapping[str, str],
) -> Figure:
    """Figure 1 of Vermaak et al. (2003): the data, and every filter's particles over time.

    A history has the particles of one run, `positions`, `occupied` and `component_indicators`
    (t, n), and its `score`.
    """
    figure = Figure(figsize=(7.0, 1.6 + 2.1 * len(histories)), layout="constrained")
    axes = figure.subplots(
        1 + len(histories), sharex=True, height_ratios=[1.3] + [2.0] * len(histories)
    )
    times = np.arange(1, len(truth) + 1)
    axes[0].plot(times, truth, color="black", label="true state $x^*_t$")
    axes[0].plot(times, observations, ".", color=COLOURS[4], ms=4, label="observations $y_t$")
    axes[0].set_ylabel("data")
    axes[0].legend(loc="lower left", fontsize=8, ncols=2, framealpha=0.9)
    for axis, (name, history) in zip(axes[1:], histories.items(), strict=True):
        _draw_history(axis, history, truth)
        title = f"{labels[name]}, N = {history['positions'].shape[1]}: both modes at"
        axis.set_title(f"{title} {100 * history['score']:.0f}% of the steps", fontsize=10)
    axes[-1].set_xlabel("time step $t$")
    return figure


def _draw_history(axis: Axes, history: Mapping[str, Any], truth: np.ndarray) -> None:
    positions, owners = history["positions"], history["component_indicators"]
    steps = np.arange(1, len(truth) + 1)
    times = np.broadcast_to(steps[:, None], positions.shape)
    for component in np.unique(owners):
        chosen = history["occupied"] & (owners == component)
        axis.plot(
            times[chosen], positions[chosen], MARKERS[component % len(MARKERS)], ms=2.0,
            mew=0, alpha=0.5, color=COLOURS[component % len(COLOURS)],
            label=f"particles of component {component + 1}",
        )  # fmt: skip
    for sign, line, name in ((1, "-", "$x^*_t$"), (-1, "--", "$-x^*_t$")):
        axis.plot(steps, sign * truth, color="black", lw=0.9, ls=line, label=f"mode at {name}")
    axis.set_ylabel("state $x_t$")
    axis.set_ylim(-2.9, 3.6)  # the legend stands above the modes
    axis.legend(
        loc="upper center", bbox_to_anchor=(0.5, 0.985), fontsize=7, ncols=4, markerscale=2.5,
        framealpha=0.9, borderpad=0.3, columnspacing=1.0,
    )  # fmt: skip


def draw_scores(results: Sequence[Mapping[str, Any]], labels: Mapping[str, str]) -> Figure:
    """Figure 2 of Vermaak et al. (2003), and the error of the modes' mass beside it.

    The mass is that of the upper mode, which is 1/2 by symmetry.
    """
    entries = sorted(results, key=lambda entry: list(labels).index(entry["filter"]))

    def score(entry: Mapping[str, Any], k: int) -> float:
        # A score lies in [0, 1]: the bars end there too.
        return float(np.clip(np.mean(entry["scores"]) + k * np.std(entry["scores"]), 0, 1))

    scores = [lambda e, k=k: score(e, k) for k in (0, -1, 1)]
    at = (lambda e: labels[e["filter"]], "particles")
    x = "number of particles $N$"
    panels = [
        Panel(
            f"score, mean ± std of {len(results[0]['scores'])} runs", x,
            "share of steps with both modes",
            lines_of(entries, *at, *scores), (-0.03, 1.06),
        ),
        Panel(
            "probability of the upper mode", x, r"RMS error of $P(x_t > 0 \mid y_1 \ldots y_t)$",
            lines_of(entries, *at, "mode_mass_error"), (0, None),
        ),
    ]  # fmt: skip
    return draw_panels([panels], ("log", "linear"))


def draw_contact_sheet(
    columns: Sequence[tuple[str, Sequence[np.ndarray]]],
    titles: Sequence[str],
    legend: Mapping[str, int],
) -> Figure:
    """Figure 3 of Vermaak et al. (2003): a named column of pictures for each filter.

    Each column is a name and its RGB pictures, all of one size, one for each of the `titles`, which
    stand beside the pictures. `legend` says what is drawn in the colour of which number.
    """
    height, width, _ = columns[0][1][0].shape
    panel = 10.0 / len(columns)
    figure = Figure(
        figsize=(10.0, (panel * height / width + 0.1) * len(titles) + 0.7), layout="constrained"
    )
    axes = figure.subplots(len(titles), len(columns), squeeze=False)
    for column, (name, pictures) in zip(axes.T, columns, strict=True):
        column[0].set_title(name, fontsize=13)
        for axis, picture in zip(column, pictures, strict=True):
            axis.imshow(picture)
            axis.set(xticks=[], yticks=[])
    for axis, title in zip(axes[:, 0], titles, strict=True):
        axis.set_ylabel(title, fontsize=12)
    marks = [
        Line2D([], [], ls="", marker="s", ms=8, mec="black", mfc=np.divide(PALETTE[number], 255))
        for number in legend.values()
    ]
    figure.legend(marks, legend, loc="outside upper center", ncols=len(marks), fontsize=12)
    return figure


def region(points: np.ndarray, sizes: np.ndarray, shape: Sequence[int]) -> tuple[slice, slice]:
    """The rows and columns of a frame that hold points, with room for boxes of these sizes."""
    margin = 1.2 * sizes.max(axis=0)
    left, top = (points.min(axis=0) - margin).astype(int)
    right, bottom = (points.max(axis=0) + margin).astype(int)
    return slice(max(top, 0), min(bottom, shape[0])), slice(max(left, 0), min(right, shape[1]))


class Panel(NamedTuple):
    """Named lines of points (x, y), or (x, y, low, high) with the ends of an interval.

    - `at`: where a dotted line stands.
    """

    title: str
    xlabel: str
    ylabel: str
    lines: Mapping[str, Sequence[tuple[float, ...]]]
    ylim: tuple[float, float | None] | None = None
    at: float | None = None


def lines_of(
    entries: Sequence[Mapping[str, Any]], name: str | Callable[[Any], str], *axes: Any
) -> dict[str, list[tuple[float, ...]]]:
    """The lines of a panel: of each name, a point for each entry.

    `name` and `axes`, which are x, y and perhaps low and high, are names of values, or functions.
    """
    lines: dict[str, list[tuple[float, ...]]] = {}
    for entry in entries:
        read: list[Any] = [e(entry) if callable(e) else entry[e] for e in (name, *axes)]
        lines.setdefault(read[0], []).append(tuple(read[1:]))
    return lines


def draw_panels(
    rows: Sequence[Sequence[Panel]], scales: tuple[str, str] = ("log", "log")
) -> Figure:
    """Panels, which share their second axis along a row, or else down a column.

    A name has the same colour and marker in all of them.
    """
    shared = "row" if len({panel.ylabel for panel in rows[0]}) == 1 else "col"
    num_columns = max(len(row) for row in rows)
    figure = Figure(figsize=(3.1 * num_columns, 2.9 * len(rows) + 0.5), layout="constrained")
    axes = figure.subplots(len(rows), num_columns, squeeze=False, sharey=shared)
    names = list(dict.fromkeys(name for row in rows for panel in row for name in panel.lines))
    for row_axes, row in zip(axes, rows, strict=True):
        for axis in row_axes[len(row) :]:
            axis.set_axis_off()
        for axis, panel in zip(row_axes, row, strict=False):
            _draw_panel(axis, panel, names, scales)
    legends = [axis.get_legend_handles_labels() for axis in axes.flat]
    handles = {label: handle for each in legends for handle, label in zip(*each, strict=True)}
    # In inches, of a name and its marker at this size of letters: a wider legend would be cut off.
    column = 0.55 + 0.07 * max(map(len, names))
    figure.legend(
        [handles[name] for name in names], names, loc="outside upper center", fontsize=8,
        ncols=max(1, min(len(names), 2 * num_columns, int(figure.get_figwidth() / column))),
    )  # fmt: skip
    return figure


def draw_dots(rows: Sequence[Sequence[Panel]], width: float) -> Figure:
    """Panels of points (name, x, low, high), where each name has a row."""
    names = {point[0] for points in rows[0][0].lines.values() for point in points}
    size = 1.9 + width * len(rows[0]), 0.4 + (0.9 + 0.21 * len(names)) * len(rows)
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots(len(rows), len(rows[0]), sharey=True, squeeze=False)
    for axis, panel in zip(axes.flat, (panel for row in rows for panel in row), strict=True):
        for k, (label, points) in enumerate(panel.lines.items()):
            at, x, low, high = zip(*points, strict=True)
            style: Any = {"fmt": MARKERS[k], "color": COLOURS[k], "ms": 4, "label": label}
            axis.errorbar(x, at, xerr=(np.subtract(x, low), np.subtract(high, x)), **style)
        axis.set(xlabel=panel.xlabel, xlim=panel.ylim)
        axis.set_title(textwrap.fill(panel.title, int(11 * width)), fontsize=9)
        axis.grid(alpha=0.25)
    axes[0, 0].set_ylim(len(names) - 0.5, -0.5)
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=3)
    return figure


def _draw_panel(axis: Axes, panel: Panel, names: Sequence[str], scales: tuple[str, str]) -> None:
    ticks = sorted({point[0] for points in panel.lines.values() for point in points})
    step = min(np.diff(ticks), default=1.0)
    if panel.at is not None:
        axis.axvline(panel.at, color="0.6", ls=":", lw=1.2)
    for name, points in panel.lines.items():
        index = names.index(name)
        style: dict[str, Any] = {
            "label": name, "color": COLOURS[index % len(COLOURS)], "lw": 1.4, "ms": 5,
            "marker": MARKERS[index % len(MARKERS)], "markevery": 1 + len(points) // 12,
        }  # fmt: skip
        x, y, *ends = np.array(sorted(points)).T
        if ends and len(points) > 12:
            axis.plot(x, y, **style)
            axis.fill_between(x, *ends, color=style["color"], alpha=0.2, lw=0)
        elif ends:
            # Shifted a little, so that intervals at the same place do not cover each other.
            shift = list(panel.lines).index(name) - (len(panel.lines) - 1) / 2
            beside = x * 1.04**shift if scales[0] == "log" else x + 0.06 * step * shift
            axis.vlines(beside, *ends, color=style["color"], lw=style["lw"])
            axis.plot(x, y, **style)
        else:
            axis.plot(x, y, **style)
    axis.set(xscale=scales[0], yscale=scales[1], xlabel=panel.xlabel, ylabel=panel.ylabel)
    axis.set_title(textwrap.fill(panel.title, 36), fontsize=9)
    if len(ticks) <= 6:
        labels = [f"{tick:,.10g}".replace(",", "\u2009") for tick in ticks]
        axis.set_xticks(ticks, labels, fontsize=8)
    axis.xaxis.set_minor_locator(NullLocator())
    if panel.ylim is not None:
        axis.set_ylim(*panel.ylim)
    if scales[1] == "log":  # ticks at every decade, and between where there are few of them
        low, high = axis.get_ylim()
        subs = (1.0,) if high > 1000 * low else (1.0, 2.0, 5.0)
        axis.yaxis.set_major_locator(LogLocator(subs=subs))
        axis.yaxis.set_major_formatter("{x:g}")
        axis.yaxis.set_minor_locator(NullLocator())
    axis.grid(alpha=0.25)


def draw_points(
    draw: Any,
    points: Float[np.ndarray, "n 2"],
    numbers: Int[np.ndarray, " n"],
    radius: float = 1.5,
) -> None:
    """Draw a dot at each (x, y), with a dark rim so that it is visible on any background."""
    for (x, y), number in zip(points.tolist(), numbers.tolist(), strict=True):
        for reach, ink in ((radius + 1, (0, 0, 0)), (radius, PALETTE[number % len(PALETTE)])):
            ends = (round(x - reach), round(y - reach), round(x + reach), round(y + reach))
            draw.rectangle(ends, fill=ink)
