"""Recovery rates with their intervals, in a table and a figure."""

from textwrap import fill
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool
from matplotlib.figure import Figure

from benchmarks.interacting_objects.methods import ESTIMATES, METHODS
from benchmarks.interacting_objects.scenes import SCENES, Setting
from mpfjax.console import format_table
from mpfjax.metrics.tracking_quality import recovery_rate

NUM_LAST = 3  # frames at the end in which who has recovered is tracked


def summarise(tracked: Bool[np.ndarray, "orders runs t objects"], setting: Setting) -> list[float]:
    """The recovery rate of the objects in question, all at once, for each order."""
    together = jnp.asarray(tracked[..., list(setting.hard)].all(axis=-1))
    return [float(recovery_rate(states, num_last=NUM_LAST)) for states in together]


def wilson(rate: float, num_runs: int) -> list[float]:
    """The 95% interval of a rate (Wilson 1927)."""
    z = 1.96
    middle = (rate + z**2 / (2 * num_runs)) / (1 + z**2 / num_runs)
    half = z * np.sqrt(rate * (1 - rate) / num_runs + z**2 / (4 * num_runs**2))
    half /= 1 + z**2 / num_runs
    return [float(max(middle - half, 0.0)), float(min(middle + half, 1.0))]


def entries(
    scene: str, method: str, tracked: dict[str, np.ndarray], num_runs: int
) -> list[dict[str, Any]]:
    """The lines of the results that a method makes of a scene; PS its best and its mean order."""
    setting, label = SCENES[scene], METHODS[method][0]
    rates = {name: summarise(tracked[name], setting) for name in ESTIMATES}
    if method != "ps":
        return [entry(scene, method, label, {k: v[0] for k, v in rates.items()}, num_runs, rates)]
    best = {name: max(values) for name, values in rates.items()}
    mean = {name: float(np.mean(values)) for name, values in rates.items()}
    num = setting.num_objects * num_runs
    return [
        entry(scene, "ps_best", "PS, best order", best, num_runs, rates),
        entry(scene, "ps_mean", "PS, mean of orders", mean, num, rates),
    ]


def entry(
    scene: str,
    method: str,
    label: str,
    rates: dict[str, float],
    num_runs: int,
    by_order: dict[str, list[float]],
) -> dict[str, Any]:
    return {
        "scene": scene,
        "method": method,
        "label": label,
        "runs": num_runs,
        "recovery": {
            name: {"rate": rate, "interval": wilson(rate, num_runs), "by_order": by_order[name]}
            for name, rate in rates.items()
        },
    }


def as_table(results: list[dict[str, Any]], estimate: str) -> str:
    """Methods by scenes, each rate with its interval."""
    scenes = list(dict.fromkeys(line["scene"] for line in results))
    labels = list(dict.fromkeys(line["label"] for line in results))
    cells = {(line["label"], line["scene"]): line["recovery"][estimate] for line in results}

    def text(cell: dict[str, Any]) -> str:
        low, high = cell["interval"]
        return f"{cell['rate']:.3f} [{low:.2f}, {high:.2f}]"

    rows = [[label, *(text(cells[label, scene]) for scene in scenes)] for label in labels]
    return format_table([f"recovery, {estimate}", *scenes], rows)


def draw(results: list[dict[str, Any]]) -> Figure:
    """A panel for each scene: every method's rate and interval, by both estimates."""
    scenes = list(dict.fromkeys(line["scene"] for line in results))
    columns = min(len(scenes), 3)
    num_rows = -(-len(scenes) // columns)
    figure = Figure(figsize=(2.3 * columns + 1.8, 3.7 * num_rows), layout="constrained")
    panels = figure.subplots(num_rows, columns, sharey=True, squeeze=False).ravel()
    for panel in panels[len(scenes) :]:
        panel.set_axis_off()
    for panel, scene in zip(panels, scenes, strict=False):
        lines = [line for line in results if line["scene"] == scene]
        for estimate, shift, colour in (("median", -0.13, "C0"), ("mean", 0.13, "C1")):
            cells = [line["recovery"][estimate] for line in lines]
            rates = np.array([cell["rate"] for cell in cells])
            ends = np.array([cell["interval"] for cell in cells])
            at = np.arange(len(lines)) + shift
            panel.hlines(at, ends[:, 0], ends[:, 1], colors=colour, linewidth=2)
            panel.plot(rates, at, "o", color=colour, markersize=4, label=estimate)
        panel.set_title(fill(f"{scene}: {SCENES[scene].title}", 28), fontsize=9)
        panel.set_xlim(-0.03, 1.03)
        panel.grid(axis="x", alpha=0.3)
        panel.set_yticks(range(len(lines)), [line["label"] for line in lines])
        panel.set_xlabel("recovery rate")
    panels[0].invert_yaxis()
    panels[0].legend(fontsize=8, loc="lower left")
    return figure
