"""How far the masses of several modes, and log Ẑ, can be believed; and at what price.

    python -m benchmarks.masses                       # all scenes
    python -m benchmarks.masses --scenes corridor --particles 400 4000 --seeds 100

Every filter runs on the same observations with the same keys. `mass_rmse` is the root of the mean
squared error of the regions' masses at the last step, `lost` the share of runs that leave the true
region less than a hundredth, `log_z_sd` the standard deviation of log Ẑ over the runs and
`log_z_rmse` the root of its mean squared error, `ms` the milliseconds of a step of one run alone.
Masses are judged by symmetry (corridor, mirror), a grid (quadratic, jumps), or a plain filter of a
million particles, as is log Z without a grid.

A second table sets each filter beside the first one of --filters: by how many standard errors of
the paired differences it is worse. --keys chooses other keys of the runs for the same scenes.

Into --out DIR go masses.json and masses.png.
"""

import argparse
import importlib.util
import sys
from pathlib import Path
from typing import Any

import jax
import numpy as np

from benchmarks import figures as plotting
from benchmarks.masses import measure
from benchmarks.masses.filters import FILTERS
from benchmarks.masses.scenes import SCENES, Scene
from mpfjax.console import exit_status, format_table, seed, whole, write_figure, write_json
from mpfjax.models.base import starts_from_noise

# A reference of so many particles where the likelihood of a particle is that of its pixels.
_FEWER = {"look-alikes": 10}
# A picture has room for as many lines as there are colours.
_IN_THE_TABLE_ONLY = (
    "APF", "APF, rqmc", "MPF, 4 draws", "MPF, tempered", "MPF, look-ahead",
    "MPF, rqmc, look-ahead", "MPF, learned look-ahead",
    "MPF, pilot look-ahead", "MPF, rqmc, no look-ahead",
)  # fmt: skip


def parse_arguments(arguments: list[str] | None = None) -> argparse.Namespace:
    """The arguments, each checked."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.masses",
        description="Errors of modes' masses and of log Ẑ, by filter and number of particles.",
    )
    parser.add_argument("--scenes", nargs="+", choices=list(SCENES), default=list(SCENES))
    parser.add_argument("--filters", nargs="+", choices=list(FILTERS), default=list(FILTERS))
    parser.add_argument(
        "--particles", type=whole(2), nargs="+", default=[400, 1000, 4000], metavar="N"
    )
    parser.add_argument("--seeds", type=whole(2), default=100)
    parser.add_argument("--steps", type=whole(2), help="of every scene; each has its own")
    parser.add_argument(
        "--reference", type=whole(2), default=1_000_000, metavar="N",
        help="particles of the filter that says what is true, a tenth of it for look-alikes",
    )  # fmt: skip
    parser.add_argument("--seed", type=seed, default=0, help="of the scenes")
    parser.add_argument(
        "--keys", type=seed, metavar="SEED", help="of the filters' runs; by default that of scenes"
    )
    parser.add_argument("--out", type=Path, default=Path("results/masses"))
    return parser.parse_args(arguments)


def run(options: argparse.Namespace) -> None:
    """Scene by scene; what is finished is written."""
    options.out.mkdir(parents=True, exist_ok=True)
    settings = {name: value for name, value in vars(options).items() if name != "out"}
    rows: list[dict[str, Any]] = []
    truths: dict[str, Any] = {}
    with_particles = importlib.util.find_spec("particles") is not None
    if not with_particles:
        print("particles is not installed: pip install particles")
    for name in options.scenes:
        make, num_steps = SCENES[name]
        scene = make(options.steps or num_steps, options.seed)
        reference = max(options.reference // _FEWER.get(name, 1), 2)
        known = measure.truth(scene, reference, options.seed + 1)
        truths[name] = {
            "masses": known.masses.tolist(), "standard_errors": known.errors.tolist(),
            "log_z": known.log_z, "log_z_error": known.log_z_error,
        }  # fmt: skip
        for num_particles in options.particles:
            rows += _rows(name, scene, known, num_particles, options, with_particles)
            write_json(
                options.out / "masses.json", {"settings": settings, "truth": truths, "rows": rows}
            )
        sure = f"known to within {known.errors.max():.4f}; log Z {known.log_z:.2f}"
        print(f"\n{name}: masses {_numbers(known.masses)}, {sure} ± {known.log_z_error:.2f}")
        of_scene = [row for row in rows if row["scene"] == name]
        print(table(of_scene))
        if len(options.filters) > 1:
            print(f"\nworse than {options.filters[0]} by so many standard errors:")
            print(table_of_differences(of_scene))
        # Programs keep memory maps, of which a process has 65 530, and no other scene needs these.
        jax.clear_caches()
    write_figure(options.out / "masses.png", picture(rows), dpi=130)
    print(f"written to {options.out}")


def _rows(
    name: str,
    scene: Scene,
    known: measure.Known,
    num_particles: int,
    options: argparse.Namespace,
    with_particles: bool,
) -> list[dict[str, Any]]:
    keys = options.seed if options.keys is None else options.keys
    filters = {each: FILTERS[each](scene, num_particles) for each in options.filters}
    times = measure.milliseconds(scene, filters, keys)
    found = {
        each: measure.results(scene, filter, options.seeds, keys)
        for each, filter in filters.items()
    }
    if with_particles and starts_from_noise(scene.model):
        from benchmarks.masses import through_particles

        found[through_particles.SQMC], times[through_particles.SQMC] = (
            through_particles.results_and_time(scene, num_particles, options.seeds, keys)
        )
    first = options.filters[0]
    rows: list[dict[str, Any]] = [
        {"scene": name, "filter": each, "N": num_particles}
        | measure.summary(of_runs, known, scene.truth) | {"ms": times[each]}
        for each, of_runs in found.items()
    ]  # fmt: skip
    for row in rows[1:]:
        row |= measure.worse(found[row["filter"]], found[first], known, scene.truth)
    return rows


def table(rows: list[dict[str, Any]]) -> str:
    """A line for each filter and N."""
    return format_table(
        [
            "filter",
            "N",
            "error of masses",
            "lost",
            "sd of log Ẑ",
            "RMSE of log Ẑ",
            "largest mass",
            "ms a step",
        ],
        [
            [
                row["filter"],
                str(row["N"]),
                f"{row['mass_rmse']:.3f} ± {row['mass_rmse_error']:.3f}",
                f"{row['lost']:.2f} ± {row['lost_error']:.2f}",
                f"{row['log_z_sd']:.3f} ± {row['log_z_sd_error']:.3f}",
                f"{row['log_z_rmse']:.3f} ± {row['log_z_rmse_error']:.3f}",
                f"{row['largest_mass']:.2f}",
                f"{row['ms']:.3f}",
            ]
            for row in sorted(rows, key=lambda row: row["N"])
        ],
    )


def table_of_differences(rows: list[dict[str, Any]]) -> str:
    """A line for each filter but the first, and N."""
    return format_table(
        ["filter", "N", "masses", "log Ẑ", "lost"],
        [
            [row["filter"], str(row["N"])]
            + [f"{row[what]:+.1f}" for what in ("masses_worse", "log_z_worse", "lost_worse")]
            for row in sorted(rows, key=lambda row: row["N"])
            if "masses_worse" in row
        ],
    )


def picture(rows: list[dict[str, Any]]) -> Any:
    """For each scene the error of masses, and of log Ẑ beside it, against the time of a step."""
    panels = []
    for scene in dict.fromkeys(row["scene"] for row in rows):
        line = []
        for what, label in (("mass_rmse", "RMS error of masses"), ("log_z_sd", "sd of log Ẑ")):
            lines: dict[str, list[tuple[float, float]]] = {}
            for row in rows:
                if row["scene"] == scene and row["filter"] not in _IN_THE_TABLE_ONLY:
                    lines.setdefault(row["filter"], []).append((row["ms"], row[what]))
            line.append(plotting.CostPanel(scene, "milliseconds a step", label, lines))
        panels.append(line)
    return plotting.draw_costs(panels)


def _numbers(values: np.ndarray) -> str:
    return ", ".join(f"{value:.3f}" for value in values)


def main(arguments: list[str] | None = None) -> int:
    """Run the benchmark; bad input is one line on the error stream and exit status 2."""
    return exit_status(lambda: run(parse_arguments(arguments)), arguments)


if __name__ == "__main__":
    sys.exit(main())
