"""Smith and Gatica-Perez (2004), tables 1 to 4 and figures 4 and 8: does the order matter?

    python -m benchmarks.partitioned_sampling                  # tables 1 and 2, figure 4
    python -m benchmarks.partitioned_sampling --scene 9        # of one key, kept or not
    python -m benchmarks.partitioned_sampling --keys 100:107   # of the scenes among these keys
    python -m benchmarks.partitioned_sampling --sensitivity    # what both tables hang on
    python -m benchmarks.partitioned_sampling --sequence DIR [DIR ...]     # tables 3 and 4
    python -m benchmarks.partitioned_sampling --sequence DIR --ids 4 3 5 --frames 1:63

A joint particle filter ("Non-PS"), partitioned sampling in every circular order and in a sample of
others, distributed partitioned sampling with both reassemblies, independent filters and clusters,
all with the same model and the same number of likelihoods a frame, 50 runs each. Synthetic scenes
are rendered from the keys 0, 1, 2, ..., and kept where the posterior of object 1, by 20 000
particles on it alone, leaves it and is back at frame 11 or later. In folders with img/ and gt.txt,
the events are those in which an object is hidden by another and comes out elsewhere; or the first
of --ids is the hidden one. Into --out DIR go partitioned_sampling.json, the figures, and an
animation of a PS run that fails beside a DPS run that recovers. Objects are counted from 1.
"""

import time
from argparse import ArgumentTypeError
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any

from tqdm import tqdm

from benchmarks.harness import Count, Natural, Positive, Seed, command, data, settings_of
from benchmarks.partitioned_sampling import scenes as scene_files
from benchmarks.partitioned_sampling import tables
from benchmarks.partitioned_sampling.pictures import write_pictures
from benchmarks.partitioned_sampling.scenes import MOST_TRIED, Event, Scene, find_events
from benchmarks.partitioned_sampling.sensitivity import CASES, run_sensitivity
from benchmarks.partitioned_sampling.study import METHODS, filters, study
from mpfjax.console import seed as read_seed
from mpfjax.vision.files.frames import parse_range


def key_range(text: str) -> range:
    """The keys A to B of A:B."""
    first, colon, last = text.partition(":")
    low, high = read_seed(first), read_seed(last) if colon else -1
    if high < low:
        raise ArgumentTypeError(f"{text!r} is not A:B with A no more than B")
    return range(low, high + 1)


@command(scenes=1, runs=2, particles=20, lambdas=[20.0], methods=["joint", "ps", "dps"])
def main(
    *,
    scenes: Count = 8,
    scene: Seed | None = None,
    keys: Annotated[range, key_range] | None = None,
    sensitivity: bool = False,
    sequence: Sequence[Path] = (),
    event: Count | None = None,
    ids: Sequence[Natural] = (),
    frames: str | None = None,
    runs: Count = 50,
    particles: Count | None = None,
    lambdas: Sequence[Positive] = (),
    methods: Sequence[Annotated[str, (*METHODS,)]] = (*METHODS,),
    seed: Seed = 0,
    out: Path = Path("results/partitioned_sampling"),
) -> None:
    """All tables; what is there is written after every scene.

    - `scenes`: how many synthetic ones.
    - `scene`: that of this key alone, kept or not.
    - `keys`: A:B, the scenes among the keys A to B.
    - `sensitivity`: size, speed and momentum; at λ = 20.
    - `sequence`: folders with img/ and gt.txt.
    - `event`: only so many-th of the sequences.
    - `ids`: of gt.txt, the hidden one first.
    - `frames`: A:B, frames A to B, counted from 1, both in.
    - `runs`: of each filter and scene.
    - `particles`: 300 on synthetic scenes, or 200.
    - `lambdas`: 20 30 40 50 on synthetic scenes, or 20.
    - `seed`: of the filters.
    """
    chosen = {"--scene": scene, "--keys": keys, "--sensitivity": sensitivity or None}
    given = [name for name, value in {**chosen, "--sequence": sequence or None}.items()
             if value is not None]  # fmt: skip
    if len(given) > 1:
        raise ValueError(f"{given[0]}: not with {given[1]}")
    if (ids or frames) and len(sequence) != 1:
        raise ValueError("--ids, --frames: of one --sequence")
    size = particles or (200 if sequence else 300)
    if sensitivity:
        run_sensitivity(out, CASES, range(MOST_TRIED), scenes, size, runs, seed)
        return
    if sequence:
        found = _real_scenes(sequence, event, ids, frames)
    elif scene is not None:
        found = [(scene, scene_files.synthetic_scene(scene))]
    else:
        among, most = (range(MOST_TRIED), scenes) if keys is None else (keys, None)
        found = scene_files.synthetic_scenes(among, most)
    lambdas = list(dict.fromkeys(lambdas or ((20.0,) if sequence else (20.0, 30.0, 40.0, 50.0))))
    settings = settings_of({
        "orders": "objects in the order in which they move, counted from 1", "runs": runs,
        "num_particles": size, "seed": seed, "lambdas": lambdas,
    })  # fmt: skip
    run(found, settings, list(dict.fromkeys(methods)), not sequence, out)


def run(
    found: Iterable[tuple[Any, Scene | None]], settings: dict[str, Any], methods: list[str],
    synthetic: bool, out: Path,
) -> None:  # fmt: skip
    """Every filter on every scene; those that are None were not kept."""
    cycles = synthetic and "ps" in methods
    size, lambdas = settings["num_particles"], settings["lambdas"]
    scenes: list[Scene] = []
    measured: list[tables.Measured] = []
    passed_over: list[Any] = []
    started = time.perf_counter()
    for number, (name, scene) in enumerate(found):
        if scene is None:
            passed_over.append(name)
            continue
        # Numbers that do not fit come to light here, before anything compiles.
        filters(scene, lambdas[0], size, methods)
        scenes.append(scene)
        made = study(
            scene, number, lambdas, size, methods, settings["runs"], settings["seed"],
            cycles=cycles,
        )  # fmt: skip
        for row in tqdm(made, desc=scene.name, unit="row", disable=None):
            measured.append(tables.measure_row(scene, row, synthetic))
        settings["seconds"] = round(time.perf_counter() - started, 1)
        settings["passed_over"] = passed_over
        content = tables.content_of(scenes, measured)
        data(out / "partitioned_sampling.json", settings=settings, **content)
    if not scenes:
        raise ValueError("--keys: the posterior keeps the scene of none of them")
    tables.print_tables(content)
    write_pictures(out, scenes, [row for row, _ in measured], content)
    if passed_over:
        print(f"\n{len(passed_over)} keys were passed over: {passed_over}")
    print(f"{settings['seconds']} s; written to {out}")


def _real_scenes(
    folders: Sequence[Path], event: int | None, ids: Sequence[int], span: str | None
) -> Iterator[tuple[str, Scene]]:
    if ids or span:
        frames = parse_range(span, "--frames")
        events = [(folders[0], Event(tuple(dict.fromkeys(ids)), frames))]
    else:
        events = [(folder, found) for folder in folders for found in find_events(folder)]
    if event is not None:
        if event > len(events):
            raise ValueError(f"--event: {event} of {len(events)}")
        events = [events[event - 1]]
    for folder, found in events:
        scene = scene_files.real_scene(folder, found)
        yield scene.name, scene


if __name__ == "__main__":
    raise SystemExit(main())
