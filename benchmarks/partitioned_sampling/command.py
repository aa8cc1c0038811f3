"""What the command does: find the scenes, run every filter on them, write and print the tables."""

import argparse
import time
from collections.abc import Iterable, Iterator
from typing import Any

from tqdm import tqdm

from benchmarks.partitioned_sampling import scenes as scene_files
from benchmarks.partitioned_sampling import sensitivity
from benchmarks.partitioned_sampling.events import Event, find_events
from benchmarks.partitioned_sampling.pictures import write_pictures
from benchmarks.partitioned_sampling.scenes import MOST_TRIED, Scene
from benchmarks.partitioned_sampling.study import filters, num_rows, study
from benchmarks.partitioned_sampling.tables import Measured, content_of, measure_row
from benchmarks.partitioned_sampling.text import print_tables
from mpfjax.console import write_json
from mpfjax.vision.files.frames import parse_range


def run(options: argparse.Namespace) -> None:
    """All tables; what is there is written after every scene."""
    if options.sensitivity:
        keys = range(MOST_TRIED)
        sensitivity.run_sensitivity(
            options.out, sensitivity.CASES, keys, options.scenes, options.particles, options.runs,
            options.seed,
        )  # fmt: skip
        return
    synthetic = not options.sequence
    cycles = synthetic and "ps" in options.methods
    passed_over: list[Any] = []
    settings: dict[str, Any] = {
        "orders": "objects in the order in which they move, counted from 1",
        "num_particles": options.particles,
        "runs": options.runs,
        "seed": options.seed,
        "lambdas": options.lambdas,
    }
    settings["passed_over"] = passed_over
    path = options.out / "partitioned_sampling.json"
    scenes: list[Scene] = []
    measured: list[Measured] = []
    started = time.perf_counter()
    for number, (name, scene) in enumerate(_scenes(options)):
        if scene is None:
            passed_over.append(name)
            continue
        # Numbers that do not fit come to light here, before anything compiles.
        filters(scene, options.lambdas[0], options.particles, options.methods)
        scenes.append(scene)
        total = num_rows(scene, options.lambdas, options.methods, cycles)
        made = study(
            scene, number, options.lambdas, options.particles, options.methods, options.runs,
            options.seed, cycles=cycles,
        )  # fmt: skip
        for row in tqdm(made, desc=scene.name, total=total, unit="row", disable=None):
            measured.append(measure_row(scene, row, synthetic))
        settings["seconds"] = round(time.perf_counter() - started, 1)
        content = content_of(scenes, measured)
        write_json(path, {"settings": settings} | content)
    if not scenes:
        raise ValueError("--keys: the posterior keeps the scene of none of them")
    print_tables(content)
    write_pictures(options.out, scenes, [row for row, _ in measured], content)
    if passed_over:
        print(f"\n{len(passed_over)} keys were passed over: {passed_over}")
    print(f"{settings['seconds']} s; written to {options.out}")


def _scenes(options: argparse.Namespace) -> Iterable[tuple[Any, Scene | None]]:
    """Every scene by name, or None in place of one that is not kept."""
    if options.sequence:
        return _real_scenes(options)
    if options.scene >= 0:
        return [(options.scene, scene_files.synthetic_scene(options.scene))]
    if options.keys:
        return scene_files.synthetic_scenes(options.keys)
    return scene_files.synthetic_scenes(range(MOST_TRIED), options.scenes)


def _real_scenes(options: argparse.Namespace) -> Iterator[tuple[str, Scene]]:
    if options.ids or options.frames:
        ids = tuple(dict.fromkeys(options.ids or ()))
        (folder,) = options.sequence
        events = [(folder, Event(ids, parse_range(options.frames, "--frames")))]
    else:
        events = [(folder, event) for folder in options.sequence for event in find_events(folder)]
    if options.event:
        if options.event > len(events):
            raise ValueError(f"--event: {options.event} of {len(events)}")
        events = [events[options.event - 1]]
    for folder, event in events:
        scene = scene_files.real_scene(folder, event)
        yield scene.name, scene
