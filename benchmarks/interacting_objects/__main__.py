"""Beyond partitioned sampling: joint filters of objects that are lost, distracted, or cross.

Random scenes with a likelihood that stands in for colour histograms, at the same number of
likelihood evaluations for every filter. `python -m benchmarks.interacting_objects`; `--help`
lists the options.
"""

import argparse
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
from tqdm import tqdm

import mpfjax
from benchmarks.interacting_objects.methods import ESTIMATES, METHODS, REPULSION, run_method
from benchmarks.interacting_objects.model import BOX, DEVIATION, MOMENTUM, REACH, SHARPNESS
from benchmarks.interacting_objects.results import NUM_LAST, as_table, draw, entries
from benchmarks.interacting_objects.scenes import (
    DISTRACTED,
    JUMP,
    LEAD,
    LIKENESS,
    LOST,
    MISSED,
    NUM_FRAMES,
    PASSING,
    SCENES,
    UNLIKE,
)
from mpfjax.console import seed, whole, write_figure, write_json


def main(arguments: list[str] | None = None) -> int:
    """Run the study, print its tables, and write its results and figure."""
    options = parse(arguments)
    out = Path(options.out)
    cells = [(scene, method) for scene in options.scenes for method in options.methods]
    results: list[dict[str, Any]] = []
    with ThreadPoolExecutor(max_workers=2) as pool:  # one compiles while another runs
        futures = [
            pool.submit(run_method, method, SCENES[scene], options.runs, options.seed)
            for scene, method in cells
        ]
        try:
            for (scene, method), future in zip(
                cells, tqdm(futures, disable=not sys.stderr.isatty(), unit="cell"), strict=True
            ):
                results += entries(scene, method, future.result(), options.runs)
                content = {"settings": settings_of(options), "results": results}
                write_json(out / "interacting_objects.json", content)
        except KeyboardInterrupt:
            pool.shutdown(wait=False, cancel_futures=True)
            print(f"interrupted: {len(results)} lines are in {out}", file=sys.stderr)
            return 130
    for estimate in ESTIMATES:
        print(as_table(results, estimate), end="\n\n")
    for scene in options.scenes:
        print(f"{scene}: {SCENES[scene].title}; N = {SCENES[scene].num_particles}")
    write_figure(out / "interacting_objects.png", draw(results), dpi=150)
    print(f"results and figure: {out}/")
    return 0


def parse(arguments: list[str] | None) -> argparse.Namespace:
    """The options, or a message that names the one that cannot be run."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.interacting_objects")
    parser.add_argument("--runs", type=whole(), default=200, help="random scenes, one run in each")
    parser.add_argument("--seed", type=seed, default=0, help="of the scenes and the runs")
    parser.add_argument("--scenes", nargs="+", choices=list(SCENES), default=list(SCENES))
    parser.add_argument("--methods", nargs="+", choices=list(METHODS), default=list(METHODS))
    parser.add_argument("--out", default="results/interacting_objects", metavar="DIR")
    return parser.parse_args(arguments)


def settings_of(options: argparse.Namespace) -> dict[str, Any]:
    """Everything that a second run needs to be the same."""
    return {
        "runs": options.runs,
        "seed": options.seed,
        "particles": {scene: SCENES[scene].num_particles for scene in options.scenes},
        "box": BOX,
        "frames": NUM_FRAMES,
        "momentum": MOMENTUM,
        "deviation": DEVIATION,
        "lambda": SHARPNESS,
        "reach": REACH,
        "unlike": UNLIKE,
        "repulsion": REPULSION,
        "lost": [LOST.start, LOST.stop],
        "jump": JUMP,
        "distracted": [DISTRACTED.start, DISTRACTED.stop],
        "lead": LEAD,
        "likeness": LIKENESS,
        "missed": MISSED,
        "passing": list(PASSING),
        "last_frames": NUM_LAST,
        "jax": jax.__version__,
        "mpfjax": mpfjax.__version__,
    }


if __name__ == "__main__":
    sys.exit(main())
