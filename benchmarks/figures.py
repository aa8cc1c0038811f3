"""Figures of the papers, and of what the benchmarks measure; no command."""

import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator

from mpfjax.plotting import COLOURS as COLOURS
from mpfjax.plotting import MARKERS as MARKERS

_MOST_TICKS = 6


@dataclass(frozen=True)
class ParticleHistory:
    """The particles of one run over time, (t, n), of a scalar state."""

    positions: np.ndarray
    occupied: np.ndarray
    component_indicators: np.ndarray
    score: float


def draw_typical_run(
    histories: Mapping[str, ParticleHistory],
    truth: np.ndarray,
    observations: np.ndarray,
    labels: Mapping[str, str],
) -> Figure:
    """Figure 1 of Vermaak et al. (2003): the data, and every filter's particles over time."""
    num_rows = 1 + len(histories)
    figure = Figure(figsize=(7.0, 1.6 + 2.1 * len(histories)), layout="constrained")
    axes = figure.subplots(
        num_rows, 1, sharex=True, squeeze=False, height_ratios=[1.3] + [2.0] * len(histories)
    )[:, 0]
    times = np.arange(1, len(truth) + 1)
    axes[0].plot(times, truth, color="black", label="true state $x^*_t$")
    axes[0].plot(times, observations, ".", color=COLOURS[4], ms=4, label="observations $y_t$")
    axes[0].set_ylabel("data")
    axes[0].legend(loc="lower left", fontsize=8, ncols=2, framealpha=0.9)
    for axis, (name, history) in zip(axes[1:], histories.items(), strict=True):
        _draw_history(axis, history, truth)
        num_particles = history.positions.shape[1]
        axis.set_title(
            f"{labels[name]}, N = {num_particles}: both modes at"
            f" {100 * history.score:.0f}% of the steps",
            fontsize=10,
        )
    axes[-1].set_xlabel("time step $t$")
    return figure


def _draw_history(axis: Axes, history: ParticleHistory, truth: np.ndarray) -> None:
    times = np.broadcast_to(np.arange(1, len(truth) + 1)[:, None], history.positions.shape)
    for component in np.unique(history.component_indicators):
        chosen = history.occupied & (history.component_indicators == component)
        axis.plot(
            times[chosen], history.positions[chosen], MARKERS[component % len(MARKERS)], ms=2.0,
            mew=0, alpha=0.5, color=COLOURS[component % len(COLOURS)],
            label=f"particles of component {component + 1}",
        )  # fmt: skip
    for sign in (1, -1):
        axis.plot(
            np.arange(1, len(truth) + 1), sign * truth, color="black", lw=0.9,
            ls="-" if sign == 1 else "--",
            label=r"mode at $x^*_t$" if sign == 1 else r"mode at $-x^*_t$",
        )  # fmt: skip
    axis.set_ylabel("state $x_t$")
    axis.set_ylim(-2.9, 3.6)  # the legend stands above the modes
    axis.legend(
        loc="upper center", bbox_to_anchor=(0.5, 0.985), fontsize=7, ncols=4, markerscale=2.5,
        framealpha=0.9, borderpad=0.3, columnspacing=1.0,
    )  # fmt: skip


def draw_scores(results: Sequence[Mapping[str, Any]], labels: Mapping[str, str]) -> Figure:
    """Figure 2 of Vermaak et al. (2003), and the error of the modes' mass beside it."""
    entries: list[dict[str, Any]] = []
    for entry in sorted(results, key=lambda entry: list(labels).index(entry["filter"])):
        mean, std = np.mean(entry["scores"]), np.std(entry["scores"])
        weight, spread = entry["weight_mean"], entry["weight_std"]
        entries.append({
            "label": labels[entry["filter"]], **entry, "weight_low": weight - spread,
            "weight_high": weight + spread,
            # A score lies in [0, 1]: the bars end there too.
            "score": mean, "low": max(mean - std, 0), "high": min(mean + std, 1),
        })  # fmt: skip
    mixtures = [entry for entry in entries if entry["filter"] != "pf"]
    at, x, limits = ("label", "particles"), "number of particles $N$", (-0.03, 1.06)
    panels = [
        Panel(
            f"score, mean ± std of {len(results[0]['scores'])} runs", x,
            "share of steps with both modes",
            lines_of(entries, *at, "score", "low", "high"), limits,
        ),
        Panel(
            "weight of component one, mean ± std", x, r"mixture weight $\pi_1$",
            lines_of(mixtures, *at, "weight_mean", "weight_low", "weight_high"), limits,
        ),
        Panel(
            "RMS error of the upper mode's mass", x,
            r"error of $P(x_t > 0 \mid y_1 \ldots y_t)$",
            lines_of(entries, *at, "mode_mass_error"), (0, None),
        ),
    ]  # fmt: skip
    return draw_panels([panels], ("log", "linear"))


def draw_contact_sheet(
    rows: Sequence[tuple[str, Sequence[np.ndarray]]], titles: Sequence[str]
) -> Figure:
    """Figure 3 of Vermaak et al. (2003): a named row of pictures for each filter.

    Each row is a name and its RGB pictures, all of one size, one for each of the `titles`, which
    stand above the pictures.
    """
    height, width, _ = rows[0][1][0].shape
    panel = 3.2
    figure = Figure(
        figsize=(panel * len(titles), (panel * height / width + 0.3) * len(rows)),
        layout="constrained",
    )
    axes = figure.subplots(len(rows), len(titles), squeeze=False)
    for row, (name, pictures) in zip(axes, rows, strict=True):
        row[0].set_ylabel(name, fontsize=13)
        for axis, picture, title in zip(row, pictures, titles, strict=True):
            axis.imshow(picture)
            axis.set(xticks=[], yticks=[])
            axis.set_title(title, fontsize=12)
    return figure


def region(points: np.ndarray, sizes: np.ndarray, shape: Sequence[int]) -> tuple[slice, slice]:
    """The rows and columns of a frame that hold points, with room for boxes of these sizes."""
    margin = 1.2 * sizes.max(axis=0)
    left, top = (points.min(axis=0) - margin).astype(int)
    right, bottom = (points.max(axis=0) + margin).astype(int)
    return slice(max(top, 0), min(bottom, shape[0])), slice(max(left, 0), min(right, shape[1]))


def draw_curves(
    curves: Mapping[str, np.ndarray], first: int, *, xlabel: str, ylabel: str, title: str
) -> Figure:
    """Named curves over frames, (seeds, t) each: the mean over seeds, and a band of one std."""
    figure = Figure(figsize=(7.0, 3.4), layout="constrained")
    axis = figure.subplots()
    for index, (name, values) in enumerate(curves.items()):
        frames, mean, spread = first + np.arange(values.shape[1]), values.mean(0), values.std(0)
        axis.plot(
            frames, mean, label=name, lw=1.4, color=COLOURS[index], marker=MARKERS[index],
            markevery=(3 * index, 12), ms=5,
        )  # fmt: skip
        axis.fill_between(
            frames, mean - spread, mean + spread, color=COLOURS[index], alpha=0.15, lw=0
        )
    axis.set(xlabel=xlabel, ylabel=ylabel)
    axis.set_ylim(bottom=0)
    axis.set_title(title, fontsize=10)
    axis.grid(alpha=0.25)
    axis.legend(fontsize=8, ncols=len(curves), loc="upper right")
    return figure


def draw_object_bars(rows: Mapping[str, Sequence[np.ndarray]], titles: Sequence[str]) -> Figure:
    """Figures 4 and 8 of Smith and Gatica-Perez (2004): a bar for each object.

    There is a row for each filter, by name, with a panel for each of the `titles`. A panel shows an
    array of one value for each object. Panels below each other share their axes.
    """
    figure = Figure(figsize=(3.1 * len(titles), 0.4 + 1.5 * len(rows)), layout="constrained")
    axes = figure.subplots(len(rows), len(titles), squeeze=False, sharex=True, sharey="col")
    for row, (name, panels) in zip(axes, rows.items(), strict=True):
        row[0].set_ylabel(
            textwrap.fill(name.replace(" {", "\n{"), 20, replace_whitespace=False), fontsize=8
        )
        for index, (axis, values) in enumerate(zip(row, panels, strict=True)):
            objects = np.arange(1, len(values) + 1)
            bars = axis.bar(objects, values, color=COLOURS[index], width=0.7)
            axis.bar_label(bars, fmt="%.0f", fontsize=7)
            axis.set_xticks(objects)
            axis.margins(y=0.18)
    for axis, title in zip(axes[0], titles, strict=True):
        axis.set_title(title, fontsize=9)
    for axis in axes[-1]:
        axis.set_xlabel("object")
    return figure


def draw_optimisations(
    sigmas_x: np.ndarray,
    sigmas_y: np.ndarray,
    log_likelihood: np.ndarray,
    paths: Sequence[np.ndarray],
    best: np.ndarray,
) -> Figure:
    """Paths of a tuning, (steps, 2) each, on the log marginal likelihood of σ_x and σ_y.

    `log_likelihood` has a row for each σ_y; `best` is the exact maximum.
    """
    figure = Figure(figsize=(6.2, 5.0), layout="constrained")
    axis = figure.subplots()
    below = np.max(log_likelihood) - log_likelihood
    levels = [0.5, 2, 5, 10, 20, 50, 100, 200, 500, 1000]
    lines = axis.contour(sigmas_x, sigmas_y, below, levels, colors="0.7", linewidths=0.8)
    axis.clabel(lines, fmt="-%g", fontsize=7)
    for index, path in enumerate(paths):
        colour = COLOURS[index % len(COLOURS)]
        axis.plot(path[:, 0], path[:, 1], color=colour, lw=1.0, alpha=0.8)
        axis.plot(*path[0], MARKERS[index % len(MARKERS)], color=colour, ms=4)
    axis.plot(*best, "*", color="black", ms=13, label="exact maximum", zorder=3)
    axis.set(xscale="log", yscale="log", xlabel=r"$\sigma_x$", ylabel=r"$\sigma_y$")
    for one, sigmas in ((axis.xaxis, sigmas_x), (axis.yaxis, sigmas_y)):
        ticks = [tick for tick in (0.03, 0.05, 0.1, 0.2, 0.5) if sigmas[0] <= tick <= sigmas[-1]]
        one.set_ticks(ticks, labels=[str(tick) for tick in ticks])
    axis.minorticks_off()
    axis.set_title(
        "log marginal likelihood below its maximum, and optimisations to it", fontsize=10
    )
    axis.legend(fontsize=8, loc="lower left")
    return figure


def standard_error(values: np.ndarray) -> np.ndarray:
    """s / √n of runs, (n, ...), with n - 1 in s²; NaN, which draws nothing, where n is 1."""
    if len(values) < 2:
        return np.full(values.shape[1:], np.nan)
    return np.asarray(values.std(axis=0, ddof=1) / np.sqrt(len(values)))


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
    figure = Figure(figsize=(3.9 * num_columns, 3.3 * len(rows) + 0.5), layout="constrained")
    axes = figure.subplots(len(rows), num_columns, squeeze=False, sharey=shared)
    names = list(dict.fromkeys(name for row in rows for panel in row for name in panel.lines))
    for row_axes, row in zip(axes, rows, strict=True):
        for axis in row_axes[len(row) :]:
            axis.set_axis_off()
        for axis, panel in zip(row_axes, row, strict=False):
            _draw_panel(axis, panel, names, scales)
    handles = {
        label: handle
        for axis in axes.ravel()
        for handle, label in zip(*axis.get_legend_handles_labels(), strict=True)
    }
    # In inches, of a name and its marker at this size of letters: a wider legend would be cut off.
    column = 0.55 + 0.07 * max(map(len, names))
    figure.legend(
        [handles[name] for name in names], names, loc="outside upper center", fontsize=8,
        ncols=max(1, min(len(names), 2 * num_columns, int(figure.get_figwidth() / column))),
    )  # fmt: skip
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
            "marker": MARKERS[index % len(MARKERS)],
        }  # fmt: skip
        x, y, *ends = np.array(sorted(points)).T
        if ends:
            # Shifted a little, so that intervals at the same place do not cover each other.
            shift = index - (len(names) - 1) / 2
            x = x * 1.04**shift if scales[0] == "log" else x + 0.06 * step * shift
            reach = np.maximum([y - ends[0], ends[1] - y], 0)
            axis.errorbar(x, y, reach, capsize=3, **style)
        else:
            axis.plot(x, y, **style)
    axis.set(xscale=scales[0], yscale=scales[1], xlabel=panel.xlabel, ylabel=panel.ylabel)
    axis.set_title(textwrap.fill(panel.title, 50), fontsize=10)
    if len(ticks) <= _MOST_TICKS:
        whole = [f"{tick:,.0f}".replace(",", "\u2009") for tick in ticks]
        labels = [
            name if tick == int(tick) else f"{tick:g}"
            for name, tick in zip(whole, ticks, strict=True)
        ]
        axis.set_xticks(ticks, labels, fontsize=8)
    else:  # times, of which every point has its own
        axis.xaxis.set_major_locator(LogLocator(subs=(1.0, 3.0)))
        axis.xaxis.set_major_formatter("{x:g}")
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
