"""Lin et al. (2012), figures 1 to 6 and table 1: PF, GPF, MPF and GM-MPF on two targets.

    python -m benchmarks.gm_mpf                       # pets09_s2l1, or a rendered scene
    python -m benchmarks.gm_mpf --sequence DIR --ids 3 5 --frames 1:80

All four have the same model and start from the same boxes: HSV histograms (eqs. 1 to 3) and
second-order dynamics (eq. 4); boxes are cut into three bands and colours weighed against the
surround, as the paper does not, since a whole box's histogram loses small pedestrians to the
pavement whatever the filter. Those with one component hold both targets in it; the mixtures have
one component for each target, which never meet but in their weights, as the paper's intervals.
Into --out DIR go gm_mpf.json and the figures.
"""

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from benchmarks.gm_mpf import sizes
from benchmarks.gm_mpf.filters import NAMES
from benchmarks.gm_mpf.pictures import draw_effective_sample_sizes, draw_errors, draw_migration
from benchmarks.gm_mpf.runs import Step, errors_by_size, held, reference_estimates, study, summary
from benchmarks.gm_mpf.tables import study_table, timing_table
from benchmarks.gm_mpf.targets import open_targets
from benchmarks.gm_mpf.timing import profile, time_filters, time_quadratic
from mpfjax.console import exit_status, format_table, seed, whole, write_figure, write_json


def parse_arguments(arguments: list[str] | None = None) -> argparse.Namespace:
    """The arguments, each checked as far as it can be without the frames."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.gm_mpf",
        description="PF, GPF, MPF and GM-MPF on two targets (Lin et al. 2012, figures and table).",
    )
    parser.add_argument("--sequence", type=Path, metavar="DIR", help="img/ and gt.txt")
    parser.add_argument("--ids", type=whole(0), nargs=2, metavar="ID", help="two objects of gt.txt")
    parser.add_argument("--frames", metavar="A:B", help="frames A to B, counted from 1, both in")
    parser.add_argument("--filters", nargs="+", choices=list(NAMES), default=list(NAMES))
    parser.add_argument(
        "--particles", type=whole(2), nargs="+", default=[100, 200, 300], metavar="N"
    )
    parser.add_argument("--seeds", type=whole(), default=20)
    parser.add_argument("--seed", type=seed, default=0)
    parser.add_argument("--out", type=Path, default=Path("results/gm_mpf"))
    return parser.parse_args(arguments)


def run(options: argparse.Namespace) -> None:
    """The study, then the times; results are written as soon as they are there."""
    targets = open_targets(options)
    options.out.mkdir(parents=True, exist_ok=True)
    settings = {
        "source": targets.name,
        "frames": [targets.first, targets.first + len(targets.stills) - 1],
        "seeds": options.seeds,
        "seed": options.seed,
        "timed_particles": sizes.TIMED_PARTICLES,
        "timed_frames": sizes.TIMED_FRAMES,
    }
    # In the order of the table, the PF first: the others are measured against it.
    names = [name for name in NAMES if name in options.filters]
    timing = time_filters(targets, options.seed, names)
    cheap = time_quadratic(options.seed, names)
    parts = profile(targets, options.seed)
    print(f"time with colour histograms, {sizes.TIMED_PARTICLES} particles (table 1)")
    print(timing_table(timing, paper=True))
    print(f"\ntime on the quadratic model, {sizes.TIMED_PARTICLES} particles")
    print(timing_table(cheap, paper=False))
    print("\nwhere the time of one frame goes")
    print(format_table(["part", "ms"], [[k, f"{v:.3f}"] for k, v in parts.items()]))
    content: dict[str, Any] = {
        "settings": settings,
        "timing": {name: float(np.mean(times)) for name, times in timing.items()},
        "timing_std": {name: float(np.std(times)) for name, times in timing.items()},
        "timing_quadratic": {name: float(np.mean(times)) for name, times in cheap.items()},
        "profile": parts,
    }
    write_json(options.out / "gm_mpf.json", content)
    with tqdm(total=len(names) * len(options.particles), unit="study", disable=None) as bar:
        found = study(targets, options.particles, options.seeds, options.seed, bar.update, names)
    mixtures = [name for name in names if name in ("mpf", "gm_mpf")]
    references = reference_estimates(targets, options.seed, mixtures)
    least = options.particles[0]
    content |= {
        "rmse": _by_size(found, lambda step: summary(step, targets)[0].tolist()),
        "rmse_std": _by_size(found, lambda step: summary(step, targets)[1].tolist()),
        "monte_carlo_error": {
            name: {
                str(size): error.mean(axis=0).tolist()
                for size, error in errors_by_size(found[name], truth).items()
            }
            for name, truth in references.items()
        },
        "n_eff": {
            name: by_size[least].effective_sample_size.mean(axis=0).tolist()
            for name, by_size in found.items()
        },
        "both_held": {
            name: float(held(by_size[least], targets.truth).mean())
            for name, by_size in found.items()
        },
    }
    write_json(options.out / "gm_mpf.json", content)
    print(f"\ntwo targets of {targets.name}, {options.seeds} seeds")
    print(study_table(found, targets, references))
    figures = {
        "particle_migration": draw_migration(found, least, targets),
        "effective_sample_size": draw_effective_sample_sizes(found, least, targets.first),
        "rmse": draw_errors(found, targets, references),
    }
    for name, figure in figures.items():
        write_figure(options.out / f"{name}.png", figure, dpi=130)
    print(f"written to {options.out}")


def _by_size(
    found: dict[str, dict[int, Step]], measure: Callable[[Step], list[float]]
) -> dict[str, dict[str, list[float]]]:
    return {
        name: {str(size): measure(step) for size, step in by_size.items()}
        for name, by_size in found.items()
    }


def main(arguments: list[str] | None = None) -> int:
    """Run the benchmark; bad input is one line on the error stream and exit status 2."""
    return exit_status(lambda: run(parse_arguments(arguments)), arguments)


if __name__ == "__main__":
    sys.exit(main())
