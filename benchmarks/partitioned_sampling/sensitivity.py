"""What tables 1 and 2 depend on: the size of objects, the distracter's speed, the momentum."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

from benchmarks import figures as plotting
from benchmarks import harness
from benchmarks.partitioned_sampling.scenes import DEFAULT, synthetic_scenes
from benchmarks.partitioned_sampling.study import study
from benchmarks.partitioned_sampling.tables import content_of

LAMBDA = 20.0
FILTERS = {"joint": "joint PF", "ps": "PS, mean of orders", "dps": "DPS"}
PAIRS = {"DPS − PS": ("dps", "ps"), "PS − joint PF": ("ps", "joint")}
# What changes, by name and value.
AXES: dict[str, dict[float, dict[str, Any]]] = {
    "objects' size [px]": {side: {"size": (side, side)} for side in (20, 24, 26, 28, 32)},
    "distracter's speed [px/frame]": {speed: {"speed": speed} for speed in (0.0, 2.0, 4.0, 6.0)},
    "tracker's momentum": {share: {"momentum": share} for share in (0.0, 0.5, 0.75, 1.0)},
}
COLUMNS = {
    "what": "{axis}", "value": "{value:g}", "filter": "{filter}", "success": "{success:.0%}",
    "recovery": "{recovery:.0%}", "precision": "{precision:.0%}",
    "interval of recovery": "[{recovery_interval[0]:.0%}, {recovery_interval[1]:.0%}]",
    "scenes of keys": "{scenes} of {keys_tried}",
}  # fmt: skip
PAIRED_COLUMNS = {
    "what": "{axis}", "value": "{value:g}", "paired difference of recovery": "{filter}",
    "mean": "{difference:+.0%}",
    "interval": "[{difference_interval[0]:+.0%}, {difference_interval[1]:+.0%}]",
}  # fmt: skip


def run_sensitivity(
    out: Path, keys: Sequence[int], num_scenes: int, num_particles: int, num_runs: int, seed: int
) -> None:
    """Every case on its own scenes, into sensitivity.json and sensitivity.png.

    Scenes are judged anew in every case, but for the tracker's momentum. Where the keys hold fewer
    than `num_scenes`, those there are; a case without any is left out, and said to be.
    """
    entries: list[dict[str, Any]] = []
    differences: list[dict[str, Any]] = []
    done: dict[str, tuple[list[dict[str, Any]], list[dict[str, Any]]]] = {}
    settings = harness.settings_of({
        "lambda": LAMBDA, "num_particles": num_particles, "runs": num_runs, "seed": seed,
        "keys": [keys[0], keys[-1]],
    })  # fmt: skip
    cases = [(axis, value) for axis, values in AXES.items() for value in values]
    for ((axis, value),) in harness.grid("setting", cases):
        setting = DEFAULT | AXES[axis][value]
        if str(setting) not in done:
            scenes = synthetic_scenes(keys, num_scenes, setting)
            done[str(setting)] = _run_case(scenes, num_particles, num_runs, seed)
        head = {"axis": axis, "value": value, "setting": setting}
        of_filters, of_pairs = done[str(setting)]
        entries += [head | entry for entry in of_filters]
        differences += [head | entry for entry in of_pairs]
        if not of_filters:
            print(f"{axis} {value:g}: no key to {keys[-1]} makes a scene")
        content = {"entries": entries, "differences": differences}
        harness.data(out / "sensitivity.json", settings=settings, **content)
    print(harness.table(COLUMNS, entries), harness.table(PAIRED_COLUMNS, differences), sep="\n\n")
    harness.figures(out, dpi=110, sensitivity=draw_sensitivity(entries, differences))


def _run_case(
    candidates: Any, num_particles: int, num_runs: int, seed: int
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Success and precision of objects 2 to 7 and recovery of object 1, for each filter.

    And, for each of the `PAIRS`, the difference of their recoveries in the same scenes.
    """
    scenes, rows, tried = [], [], 0
    for number, (_, scene) in enumerate(candidates):
        tried = number + 1
        if scene is not None:
            scenes.append(scene)
            rows += study(scene, number, [LAMBDA], num_particles, list(FILTERS), num_runs, seed)
    if not scenes:
        return [], []
    content = content_of(scenes, rows)
    means = content["means"]
    of_hard = {(entry["method"], entry["order"]): entry for entry in means["2"]}
    entries = []
    for easy in sorted(means["1"], key=lambda entry: list(FILTERS).index(entry["method"])):
        if easy["order"] in (None, "mean"):
            hard = of_hard[easy["method"], easy["order"]]
            recovery = {name: hard[name] for name in ("recovery", "recovery_interval")}
            head = {"filter": FILTERS[easy["method"]], "keys_tried": tried}
            entries.append(easy | recovery | head)
    return entries, _paired(content["tables"]["2"] + content["summary"]["2"])


def _paired(entries: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Mean differences of recovery over scenes, with Student's 95% intervals."""
    recovery = {
        method: np.array([entry["recovery"] for entry in entries
                          if entry["method"] == method and entry["order"] in (None, "mean")])
        for method in FILTERS
    }  # fmt: skip
    paired = []
    for name, (first, second) in PAIRS.items():
        of_scenes = recovery[first] - recovery[second]
        mean, reach = float(of_scenes.mean()), 0.0
        if len(of_scenes) > 1:
            quantile = float(stats.t.ppf(0.975, len(of_scenes) - 1))
            reach = quantile * harness.mean_and_error(of_scenes)[1]
        ends = [mean - reach, mean + reach]
        paired.append({"filter": name, "difference": mean, "difference_interval": ends})
    return paired


def draw_sensitivity(
    entries: Sequence[dict[str, Any]], differences: Sequence[dict[str, Any]]
) -> Any:
    """Small multiples: a column for each thing that changes, a row for each measure.

    Recoveries of one scene have much in common, so that intervals are shown of their paired
    differences only. A dotted line marks the setting of the tables.
    """
    rows = (
        (entries, "recovery", "recovery of object 1", (-0.03, 1.03), False),
        (differences, "difference", "paired difference\nof recovery", None, True),
        (entries, "precision", "precision of objects 2-7", (-0.03, 1.03), True),
    )
    chosen = {axis: value for axis, values in AXES.items() for value, changed in values.items()
              if DEFAULT | changed == DEFAULT}  # fmt: skip

    def panel(
        axis: str, source: Sequence[dict[str, Any]], rate: str, label: str, limits: Any, bars: bool
    ) -> plotting.Panel:
        rows = [entry for entry in source if entry["axis"] == axis]
        ends = [lambda e, i=i: e[f"{rate}_interval"][i] for i in (0, 1) if bars]
        lines = plotting.lines_of(rows, "filter", "value", rate, *ends)
        return plotting.Panel("", axis, label, lines, limits, chosen[axis])

    shown = [name for name in chosen if any(entry["axis"] == name for entry in entries)]
    panels = [[panel(name, *row) for name in shown] for row in rows]
    figure = plotting.draw_panels(panels, ("linear", "linear"))
    for axis in figure.axes[len(shown) : 2 * len(shown)]:
        axis.axhline(0.0, color="0.3", lw=0.8)
    return figure
