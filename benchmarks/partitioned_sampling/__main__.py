"""Smith and Gatica-Perez (2004), tables 1 to 4 and figures 4 and 8: does the order matter?

    python -m benchmarks.partitioned_sampling                  # tables 1 and 2, figure 4
    python -m benchmarks.partitioned_sampling --scene 9        # of one key, kept or not
    python -m benchmarks.partitioned_sampling --keys 100:107   # of the scenes among these keys
    python -m benchmarks.partitioned_sampling --sensitivity    # what both tables hang on
    python -m benchmarks.partitioned_sampling --sequence DIR [DIR ...]     # tables 3 and 4

A joint particle filter ("Non-PS"), partitioned sampling in every circular order and in a sample of
others, distributed partitioned sampling with both reassemblies, independent filters and clusters,
all with the same model and the same number of likelihoods a frame, 50 runs each. Synthetic scenes
are rendered from the keys 0, 1, 2, ..., and kept where the posterior of object 1, by 20 000
particles on it alone, leaves it and is back at frame 11 or later. In folders with img/ and gt.txt,
the events are those in which an object is hidden by another and comes out elsewhere. Into --out DIR
go partitioned_sampling.json and figure 4 or 8. Objects are counted from 1.
"""

import time
from argparse import ArgumentTypeError
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from benchmarks.harness import Count, Positive, Seed, command, data, figures, settings_of
from benchmarks.partitioned_sampling import scenes as scene_files
from benchmarks.partitioned_sampling import tables
from benchmarks.partitioned_sampling.scenes import DEFAULT, MOST_TRIED
from benchmarks.partitioned_sampling.sensitivity import run_sensitivity
from benchmarks.partitioned_sampling.study import METHODS, study
from mpfjax.console import seed as read_seed


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
    - `runs`: of each filter and scene.
    - `particles`: 300 on synthetic scenes, or 200.
    - `lambdas`: 20 30 40 50 on synthetic scenes, or 20.
    - `seed`: of the filters.
    """
    chosen = {"--scene": scene, "--keys": keys, "--sensitivity": sensitivity or None}
    options = [name for name, value in {**chosen, "--sequence": sequence or None}.items()
             if value is not None]  # fmt: skip
    if len(options) > 1:
        raise ValueError(f"{options[0]}: not with {options[1]}")
    size = particles or (200 if sequence else 300)
    if sensitivity:
        run_sensitivity(out, range(MOST_TRIED), scenes, size, runs, seed)
        return
    if sequence:
        candidates = scene_files.real_scenes(sequence)
    elif scene is not None:
        candidates = [(scene, scene_files.synthetic_scene(scene, **DEFAULT))]
    else:
        among, most = (range(MOST_TRIED), scenes) if keys is None else (keys, None)
        candidates = scene_files.synthetic_scenes(among, most)
    lambdas = list(dict.fromkeys(lambdas or ((20.0,) if sequence else (20.0, 30.0, 40.0, 50.0))))
    methods = list(dict.fromkeys(methods))
    settings = settings_of({
        "orders": "objects in the order in which they move, counted from 1", "runs": runs,
        "num_particles": size, "seed": seed, "lambdas": lambdas,
    })  # fmt: skip
    accepted, rows, passed_over, started = [], [], [], time.perf_counter()
    cycles = not sequence and "ps" in methods
    for number, (name, one) in enumerate(candidates):
        if one is None:
            passed_over.append(name)
            continue
        accepted.append(one)
        rows += study(one, number, lambdas, size, methods, runs, seed, cycles=cycles)
        seconds = round(time.perf_counter() - started, 1)
        content = tables.content_of(accepted, rows)
        settings |= {"seconds": seconds, "passed_over": passed_over}
        data(out / "partitioned_sampling.json", settings=settings, **content)
    if not accepted:
        raise ValueError("--keys: the posterior keeps the scene of none of them")
    tables.print_tables(content)
    if content["figure_4"]:
        figures(out, dpi=110, uniqueness=tables.draw_impoverishment(content["figure_4"]))
    if passed_over:
        print(f"\n{len(passed_over)} keys were passed over: {passed_over}")
    print(f"{seconds} s; written to {out}")


if __name__ == "__main__":
    raise SystemExit(main())
