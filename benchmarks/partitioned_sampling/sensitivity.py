"""What tables 1 and 2 hang on: the size of objects, the distracter's speed, the momentum."""

import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from tqdm import tqdm

from benchmarks.partitioned_sampling.pictures import draw_sensitivity
from benchmarks.partitioned_sampling.rates import Rates, measure, over_scenes, pool
from benchmarks.partitioned_sampling.scenes import DEFAULT, Scene, Setting, synthetic_scenes
from benchmarks.partitioned_sampling.study import Row, study
from mpfjax.console import format_table, write_figure, write_json

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
    started = time.perf_counter()
    for case in tqdm(cases, unit="setting", disable=None):
        if case.setting not in done:
            done[case.setting] = _run_case(
                case.setting, keys, num_scenes, num_particles, num_runs, seed
            )
        head = {"axis": case.axis, "value": case.value, "setting": case.setting._asdict()}
        entries += [head | entry for entry in done[case.setting]]
        if not done[case.setting]:
            without.append(head)
        settings = {
            "lambda": LAMBDA, "num_particles": num_particles, "runs": num_runs, "seed": seed,
            "keys": [keys[0], keys[-1]], "seconds": round(time.perf_counter() - started, 1),
        }  # fmt: skip
        content = {"settings": settings, "entries": entries, "without_scenes": without}
        write_json(out / "sensitivity.json", content)
    print(sensitivity_text(entries))
    for head in without:
        print(
            f"{head['axis']} {head['value']:g}: no key from {keys[0]} to {keys[-1]} makes a scene"
        )
    drawn = [entry for entry in entries if entry["axis"] in CHOSEN]
    if drawn:
        write_figure(out / "sensitivity.png", draw_sensitivity(drawn, CHOSEN), dpi=110)


def sensitivity_text(entries: Sequence[dict[str, Any]]) -> str:
    """A line for each case and filter."""
    rates = ("success", "recovery", "precision")
    lines = [
        [entry["axis"], f"{entry['value']:g}", entry["filter"],
         *[f"{100 * entry[rate]:.0f}" for rate in rates],
         "[{:.0f}, {:.0f}]".format(*(100 * end for end in entry["recovery_interval"])),
         f"{entry['scenes']} of {entry['keys_tried']}"]
        for entry in entries
    ]  # fmt: skip
    header = ["what", "value", "filter", *rates, "interval of recovery", "scenes of keys"]
    return format_table(header, lines)


def _run_case(
    setting: Setting, keys: Sequence[int], num_scenes: int, num_particles: int, num_runs: int,
    seed: int,
) -> list[dict[str, Any]]:  # fmt: skip
    """Success and precision of objects 2 to 7 and recovery of object 1, for each filter."""
    found: dict[str, list[dict[str, Any]]] = {name: [] for name in FILTERS}
    tried = 0
    for number, scene in _first_scenes(setting, keys, num_scenes):
        tried = number + 1
        if scene is None:
            continue
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


def _first_scenes(
    setting: Setting, keys: Sequence[int], num_scenes: int
) -> Iterator[tuple[int, Scene | None]]:
    """The number and scene of each key until there are enough scenes, or no more keys."""
    kept = 0
    for number, (_, scene) in enumerate(synthetic_scenes(keys, setting=setting)):
        kept += scene is not None
        yield number, scene
        if kept == num_scenes:
            return


def _pooled(rows: Sequence[Row], scene: Scene, objects: list[int]) -> Rates:
    measured = [measure(row.kept.boxes[:, :, objects], scene.truth[:, objects]) for row in rows]
    return pool(measured)
