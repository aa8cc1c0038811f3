"""What tables 1 and 2 hang on: the size of objects, the distracter's speed, the momentum."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from matplotlib.figure import Figure

from benchmarks import figures as plotting
from benchmarks import harness
from benchmarks.partitioned_sampling.rates import Rates, measure, over_scenes, pool
from benchmarks.partitioned_sampling.scenes import DEFAULT, Scene, Setting, synthetic_scenes
from benchmarks.partitioned_sampling.study import Row, study

LAMBDA = 20.0
FILTERS = {"joint": "joint PF", "ps": "PS, mean of orders", "dps": "DPS"}
SIZE, SPEED, MOMENTUM = "objects' size [px]", "distracter's speed [px/frame]", "tracker's momentum"
CHOSEN = {SIZE: DEFAULT.size[0], SPEED: DEFAULT.speed, MOMENTUM: DEFAULT.momentum}
OLD = "the scene whose distracter runs away"


class Case(NamedTuple):
    """A setting, and where it stands in the picture."""

    axis: str
    value: float
    setting: Setting


CASES = [
    *[Case(SIZE, side, DEFAULT._replace(size=(side, side))) for side in (20, 24, 26, 28, 32)],
    *[Case(SPEED, speed, DEFAULT._replace(speed=speed)) for speed in (0.0, 2.0, 4.0, 6.0)],
    *[Case(MOMENTUM, share, DEFAULT._replace(momentum=share)) for share in (0.0, 0.5, 0.75, 1.0)],
    Case(OLD, 0.0, Setting((32, 40), 6.0, 3.0, "colour")),
]


COLUMNS = {
    "what": "{axis}", "value": "{value:g}", "filter": "{filter}", "success": "{success:.0%}",
    "recovery": "{recovery:.0%}", "precision": "{precision:.0%}",
    "interval of recovery": "[{recovery_interval[0]:.0%}, {recovery_interval[1]:.0%}]",
    "scenes of keys": "{scenes} of {keys_tried}",
}  # fmt: skip


def run_sensitivity(
    out: Path, cases: Sequence[Case], keys: Sequence[int], num_scenes: int, num_particles: int,
    num_runs: int, seed: int,
) -> None:  # fmt: skip
    """Every case on its own scenes, into sensitivity.json and sensitivity.png.

    Scenes are judged anew in every case, but for the tracker's momentum. Where the keys hold fewer
    than `num_scenes`, those there are; a case without any is left out, and said to be.
    """
    entries: list[dict[str, Any]] = []
    done: dict[Setting, list[dict[str, Any]]] = {}
    without: list[dict[str, Any]] = []
    settings = harness.settings_of({
        "lambda": LAMBDA, "num_particles": num_particles, "runs": num_runs, "seed": seed,
        "keys": [keys[0], keys[-1]],
    })  # fmt: skip
    for (case,) in harness.grid("setting", cases):
        if case.setting not in done:
            done[case.setting] = _run_case(
                case.setting, keys, num_scenes, num_particles, num_runs, seed
            )
        head = {"axis": case.axis, "value": case.value, "setting": case.setting._asdict()}
        entries += [head | entry for entry in done[case.setting]]
        without += [] if done[case.setting] else [head]
        content = {"settings": settings, "entries": entries, "without_scenes": without}
        harness.data(out / "sensitivity.json", **content)
    print(harness.table(COLUMNS, entries))
    for head in without:
        print(f"{head['axis']} {head['value']:g}: no key to {keys[-1]} makes a scene")
    if drawn := [entry for entry in entries if entry["axis"] in CHOSEN]:
        harness.figures(out, dpi=110, sensitivity=draw_sensitivity(drawn, CHOSEN))


def _run_case(
    setting: Setting, keys: Sequence[int], num_scenes: int, num_particles: int, num_runs: int,
    seed: int,
) -> list[dict[str, Any]]:  # fmt: skip
    """Success and precision of objects 2 to 7 and recovery of object 1, for each filter."""
    found: dict[str, list[dict[str, Any]]] = {name: [] for name in FILTERS}
    tried = kept = 0
    for number, (_, scene) in enumerate(synthetic_scenes(keys, setting=setting)):
        if kept == num_scenes:
            break
        tried = number + 1
        if scene is None:
            continue
        kept += 1
        lean = scene._replace(collector=lambda _, scene=scene: scene.collector(False))
        rows = list(study(lean, number, [LAMBDA], num_particles, list(FILTERS), num_runs, seed))
        for name in FILTERS:
            own = [row for row in rows if row.method == name]
            easy = _pooled(own, scene, [j for j in range(scene.num_objects) if j != scene.hard])
            hard = _pooled(own, scene, [scene.hard])
            entry = easy.as_dict()
            entry["recovery"] = hard.as_dict()["recovery"]
            entry["recovery_interval"] = hard.as_dict()["recovery_interval"]
            found[name].append(entry)
    return [
        {"filter": FILTERS[name], "keys_tried": tried} | over_scenes(scenes)
        for name, scenes in found.items()
        if scenes
    ]


def _pooled(rows: Sequence[Row], scene: Scene, objects: list[int]) -> Rates:
    measured = [measure(row.kept.boxes[:, :, objects], scene.truth[:, objects]) for row in rows]
    return pool(measured)


def draw_sensitivity(entries: Sequence[dict[str, Any]], chosen: dict[str, Any]) -> Figure:
    """Small multiples: a column for each thing that changes, a row for each rate.

    `entries` hold `axis`, `value`, `filter` and the rates with intervals; `chosen` is the value
    of each axis in the tables, at the dotted line.
    """
    rows = (
        ("recovery", "recovery of object 1", (-0.03, 1.03)),
        ("precision", "precision of objects 2-7", (0.5, 1.0)),
    )

    def panel(name: str, rate: str, label: str, limits: tuple[float, float]) -> plotting.Panel:
        own = [entry for entry in entries if entry["axis"] == name]
        ends = (lambda e, i=i: e[f"{rate}_interval"][i] for i in (0, 1))
        lines = plotting.lines_of(own, "filter", "value", rate, *ends)
        return plotting.Panel("", name, label, lines, limits, chosen[name])

    shown = [name for name in chosen if any(entry["axis"] == name for entry in entries)]
    panels = [[panel(name, *row) for name in shown] for row in rows]
    return plotting.draw_panels(panels, ("linear", "linear"))
