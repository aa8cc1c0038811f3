"""Figures of the papers, and of what the benchmarks measure; no command."""

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

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
    figure = Figure(figsize=(10.5, 3.7), layout="constrained")
    score, weight, mass = figure.subplots(1, 3)
    names = [name for name in labels if any(entry["filter"] == name for entry in results)]
    for index, name in enumerate(names):
        entries = sorted(
            (entry for entry in results if entry["filter"] == name),
            key=lambda entry: entry["particles"],
        )
        style = {"color": COLOURS[index], "marker": MARKERS[index], "ms": 4, "label": labels[name]}
        sizes = np.array([entry["particles"] for entry in entries])
        means = np.array([np.mean(entry["scores"]) for entry in entries])
        stds = np.array([np.std(entry["scores"]) for entry in entries])
        # A score lies in [0, 1]: the bars end there too.
        bars = np.minimum(stds, [means, 1 - means])
        # Shifted by a few per cent, so that bars at the same N do not cover each other.
        score.errorbar(sizes * 1.04 ** (index - 1), means, yerr=bars, capsize=2, **style)
        mass.plot(sizes, [entry["mode_mass_error"] for entry in entries], **style)
        if name != "pf":
            mean = np.array([entry["weight_mean"] for entry in entries])
            std = np.array([entry["weight_std"] for entry in entries])
            weight.plot(sizes, mean, **style)
            for sign in (1, -1):
                weight.plot(sizes, mean + sign * std, ls="--", lw=1, color=COLOURS[index])
    all_sizes = sorted({entry["particles"] for entry in results})
    for axis in (score, weight, mass):
        axis.set_xscale("log")
        axis.set_xticks(all_sizes, [str(size) for size in all_sizes])
        axis.minorticks_off()
        axis.set_xlabel("number of particles $N$")
        axis.grid(alpha=0.25)
    num_seeds = len(results[0]["scores"])
    score.set_ylabel("share of steps with both modes")
    score.set_title(f"score, mean ± std of {num_seeds} runs", fontsize=10)
    score.set_ylim(-0.03, 1.06)
    weight.set_ylabel(r"mixture weight $\pi_1$")
    weight.set_title("weight of component one, mean ± std", fontsize=10)
    weight.set_ylim(-0.03, 1.06)
    mass.set_ylabel(r"error of $P(x_t > 0 \mid y_1 \ldots y_t)$")
    mass.set_title("RMS error of the upper mode's mass", fontsize=10)
    mass.set_ylim(bottom=0)
    # Above the axes: in the first panel every corner holds bars, at some N.
    handles, texts = mass.get_legend_handles_labels()
    figure.legend(handles, texts, loc="outside upper center", ncols=len(names), fontsize=8)
    return figure


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


def draw_curves(
    curves: Mapping[str, np.ndarray], first: int, *, xlabel: str, ylabel: str, title: str
) -> Figure:
    """Named curves over frames, (seeds, t) each: the mean over seeds, and a band of one std."""
    figure = Figure(figsize=(7.0, 3.4), layout="constrained")
    axis = figure.subplots()
    for index, (name, values) in enumerate(curves.items()):
        frames = first + np.arange(values.shape[1])
        mean, std = values.mean(axis=0), values.std(axis=0)
        style = {"color": COLOURS[index], "marker": MARKERS[index], "markevery": (3 * index, 12)}
        axis.plot(frames, mean, label=name, lw=1.4, ms=5, **style)
        axis.fill_between(frames, mean - std, mean + std, color=COLOURS[index], alpha=0.15, lw=0)
    axis.set(xlabel=xlabel, ylabel=ylabel)
    axis.set_ylim(bottom=0)
    axis.set_title(title, fontsize=10)
    axis.grid(alpha=0.25)
    axis.legend(fontsize=8, ncols=len(curves), loc="upper right")
    return figure


def draw_errors_by_size(
    panels: Sequence[tuple[str, Mapping[str, Mapping[int, np.ndarray]]]], ylabel: str
) -> Figure:
    """Figures 5 and 6 of Lin et al. (2012): errors of several runs against N, two panels a row.

    Each panel has a title and, for each filter by name, the errors of its runs by N. A filter has
    the same colour in all of them, by its place in the first.
    """
    num_rows = -(-len(panels) // 2)
    figure = Figure(figsize=(7.8, 2.9 * num_rows + 0.4), layout="constrained")
    axes = figure.subplots(num_rows, 2, squeeze=False, sharex=True, sharey="row")
    names = list(panels[0][1])
    for axis, (title, lines) in zip(axes.ravel(), panels, strict=False):
        for name, by_size in lines.items():
            index = names.index(name)
            sizes = np.array(sorted(by_size))
            mean = np.array([by_size[size].mean() for size in sizes])
            error = np.array([standard_error(by_size[size]) for size in sizes])
            # Shifted a little, so that bars of equal heights do not cover each other.
            shift = 1 + 0.012 * (index - (len(names) - 1) / 2)
            axis.errorbar(
                sizes * shift, mean, error, label=name, color=COLOURS[index],
                marker=MARKERS[index], ms=5, lw=1.4, capsize=3,
            )  # fmt: skip
            axis.set_xticks(sizes)
        axis.set_yscale("log")
        axis.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 3.0, 5.0, 7.0)))
        axis.yaxis.set_major_formatter("{x:g}")
        axis.yaxis.set_minor_locator(NullLocator())
        axis.set_title(title, fontsize=10)
        axis.grid(alpha=0.25)
    for axis in axes[-1]:
        axis.set_xlabel("number of particles $N$")
    for axis in axes[:, 0]:
        axis.set_ylabel(ylabel)
    axes[0, -1].legend(fontsize=8)
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


def draw_rates(
    lines: Mapping[str, Sequence[tuple[float, float, float, float]]],
    *,
    xlabel: str,
    ylabel: str,
    title: str,
) -> Figure:
    """Named lines of rates, each point (x, rate, low, high) with its interval's ends."""
    figure = Figure(figsize=(7.0, 3.8), layout="constrained")
    axis = figure.subplots()
    places = sorted({point[0] for points in lines.values() for point in points})
    step = min(np.diff(places), default=1.0)
    for index, (name, points) in enumerate(lines.items()):
        x, rate, low, high = np.array(sorted(points)).T
        # Shifted a little, so that intervals at the same place do not cover each other.
        x = x + 0.06 * step * (index - (len(lines) - 1) / 2)
        axis.errorbar(
            x, rate, np.maximum([rate - low, high - rate], 0), label=name,
            color=COLOURS[index % len(COLOURS)], marker=MARKERS[index % len(MARKERS)], ms=5,
            lw=1.2, capsize=3,
        )  # fmt: skip
    axis.set_xticks(places)
    axis.set(xlabel=xlabel, ylabel=ylabel, ylim=(-0.03, 1.03))
    axis.set_title(title, fontsize=10)
    axis.grid(alpha=0.25)
    axis.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
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


def draw_overlaps(panels: Sequence[tuple[str, Mapping[str, np.ndarray], int]]) -> Figure:
    """A panel for each sequence: its name, overlaps by kind, (runs, t), and their first frame.

    Lines are means over runs, bands one standard error of them.
    """
    figure = Figure(figsize=(7.0, 2.2 * len(panels)), layout="constrained")
    axes = figure.subplots(len(panels), squeeze=False)[:, 0]
    for axis, (title, curves, first) in zip(axes, panels, strict=True):
        for index, (name, values) in enumerate(curves.items()):
            frames = first + np.arange(values.shape[1])
            mean, error = values.mean(axis=0), standard_error(values)
            axis.plot(frames, mean, label=name, lw=1.4, color=COLOURS[index])
            axis.fill_between(frames, mean - error, mean + error, color=COLOURS[index], alpha=0.2)
        axis.set(ylabel="overlap", ylim=(0, 1))
        axis.set_title(title, fontsize=10)
        axis.grid(alpha=0.25)
    axes[0].legend(fontsize=8, loc="lower left")
    axes[-1].set_xlabel("frame")
    return figure


@dataclass(frozen=True)
class CostPanel:
    """Named lines of what something costs, each of points (size, cost), on logarithmic axes."""

    title: str
    xlabel: str
    ylabel: str
    lines: Mapping[str, Sequence[tuple[float, float]]]


def draw_costs(rows: Sequence[Sequence[CostPanel]]) -> Figure:
    """Panels of costs, which share their axis of costs along a row, or else down a column.

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
            _draw_cost_panel(axis, panel, names)
            _set_cost_ticks(axis)
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


def _draw_cost_panel(axis: Axes, panel: CostPanel, names: Sequence[str]) -> None:
    sizes = set()
    for name, points in panel.lines.items():
        index = names.index(name)
        x, y = np.array(sorted(points)).T
        axis.plot(
            x, y, label=name, lw=1.4, ms=5, color=COLOURS[index % len(COLOURS)],
            marker=MARKERS[index % len(MARKERS)],
        )  # fmt: skip
        sizes |= set(x.tolist())
    axis.set(xscale="log", yscale="log", xlabel=panel.xlabel, ylabel=panel.ylabel)
    axis.set_title(panel.title, fontsize=10)
    ticks = sorted(sizes)
    if len(ticks) <= _MOST_TICKS:
        labels = [f"{tick:,.0f}".replace(",", "\u2009") for tick in ticks]
        axis.set_xticks(ticks, labels, fontsize=8)
    else:  # times, of which every point has its own
        axis.xaxis.set_major_locator(LogLocator(subs=(1.0, 3.0)))
        axis.xaxis.set_major_formatter("{x:g}")
    axis.xaxis.set_minor_locator(NullLocator())
    axis.grid(alpha=0.25)


def _set_cost_ticks(axis: Axes) -> None:
    """Ticks at every decade, and between where there are few of them."""
    low, high = axis.get_ylim()
    axis.yaxis.set_major_locator(LogLocator(subs=(1.0,) if high > 1000 * low else (1.0, 2.0, 5.0)))
    axis.yaxis.set_major_formatter("{x:g}")
    axis.yaxis.set_minor_locator(NullLocator())
