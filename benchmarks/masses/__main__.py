"""How far the masses of several modes, and log Ẑ, can be believed; and at what price.

    python -m benchmarks.masses                       # all scenes
    python -m benchmarks.masses --scenes corridor --particles 400 4000 --seeds 100

Every filter runs on the same observations with the same keys. `mass_rmse` is the root of the mean
squared error of the regions' masses at the last step, `lost` the share of runs that leave the true
region less than a hundredth, `log_z_sd` the standard deviation of log Ẑ over the runs and
`log_z_rmse` the root of its mean squared error, `ms` the milliseconds of a step of one run alone.
Masses are judged by symmetry (corridor, mirror) or a grid (jumps), and log Z, where there is no
grid, by a plain filter of a million particles.

The last columns set each filter beside the first one of --filters: by how many standard errors of
the paired differences it is worse in the masses, in log Ẑ and in lost modes. --keys chooses other
keys of the runs for the same scenes.

Into --out DIR go masses.json and masses.png.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import mpfjax
from benchmarks import figures as plotting
from benchmarks import harness
from benchmarks.harness import AtLeast2, Seed, command
from benchmarks.masses.filters import FILTERS
from benchmarks.masses.scenes import SCENES, Scene

# Runs of the filter that estimates log Z; a mode with less mass is lost.
REFERENCE_RUNS, LOST = 8, 0.01
COLUMNS = {
    "filter": "{filter}",
    "N": "{N}",
    "RMSE of weights": "{mass_rmse:.3f} ± {mass_rmse_error:.3f}",
    "lost": "{lost:.2f} ± {lost_error:.2f}",
    "sd of log Ẑ": "{log_z_sd:.3f} ± {log_z_sd_error:.3f}",
    "RMSE of log Ẑ": "{log_z_rmse:.3f} ± {log_z_rmse_error:.3f}",
    "largest weight": "{largest_mass:.2f}",
    "ms a step": "{ms:.3f}",
    "worse: weights": "{masses_worse:+.1f}",
    "log Ẑ": "{log_z_worse:+.1f}",
    "lost modes": "{lost_worse:+.1f}",
}


@command(scenes=["jumps"], filters=["PF", "MPF"], particles=[40], seeds=3, steps=3)
def main(
    *,
    scenes: Sequence[Annotated[str, (*SCENES,)]] = (*SCENES,),
    filters: Sequence[Annotated[str, (*FILTERS,)]] = (*FILTERS,),
    particles: Sequence[AtLeast2] = (400, 1000, 4000),
    seeds: AtLeast2 = 100,
    steps: AtLeast2 | None = None,
    reference: AtLeast2 = 1_000_000,
    seed: Seed = 0,
    keys: Seed | None = None,
    out: Path = Path("results/masses"),
) -> None:
    """Scene by scene; what is finished is written.

    - `steps`: of every scene; each has its own.
    - `reference`: particles of the filter that estimates log Z.
    - `seed`: of the scenes.
    - `keys`: a seed of the filters' runs; by default that of scenes.
    """
    settings, rows, truths = harness.settings_of(locals()), [], {}
    for name in scenes:
        make, num_steps = SCENES[name]
        scene = make(steps or num_steps, seed)
        answer = truth(scene, reference, seed + 1)
        truths[name] = answer._asdict()
        scene_rows = []
        for size in particles:
            by_name = {each: FILTERS[each](scene, size) for each in filters}
            for row in measure(scene, answer, by_name, seeds, seed if keys is None else keys):
                scene_rows.append({"scene": name, "N": size, **row})
            harness.data(
                out / "masses.json", settings=settings, truth=truths, rows=rows + scene_rows
            )
        rows += scene_rows
        masses = ", ".join(f"{mass:.3f}" for mass in answer.masses)
        print(f"\n{name}: weights {masses}, log Z {answer.log_z:.2f} ± {answer.log_z_error:.2f}")
        scene_rows.sort(key=lambda row: row["N"])
        print(harness.table(COLUMNS, scene_rows))
        # Programs keep memory maps, of which a process has 65 530, and no other scene needs these.
        jax.clear_caches()
    harness.figures(out, dpi=130, masses=picture(rows))
    print(f"written to {out}")


class Known(NamedTuple):
    """What is true; the error of log Z is zero where a grid tells it."""

    masses: np.ndarray
    log_z: float
    log_z_error: float


class Found(NamedTuple):
    """What the runs of a filter say: the masses of the regions, and log Ẑ."""

    masses: np.ndarray  # (runs, regions)
    log_z: np.ndarray  # (runs,)


def truth(scene: Scene, num_particles: int, seed: int) -> Known:
    """The exact masses, and log Z, by the plain filter of so many particles without a grid."""
    masses, exact_log_z = scene.exact
    if exact_log_z is not None:
        return Known(masses, exact_log_z, 0.0)
    filter = mpfjax.particle_filter(scene.model, num_particles)
    logs = []
    for key in jax.random.split(jax.random.key(seed), REFERENCE_RUNS):
        run = mpfjax.run_filter(key, filter, scene.observations, harness.nothing)
        logs.append(float(run.log_marginal_likelihood))
    weights = np.exp(np.array(logs) - max(logs))
    log_z = float(max(logs) + np.log(weights.mean()))
    return Known(masses, log_z, float(weights.std(ddof=1) / weights.mean() / np.sqrt(len(weights))))


def measure(
    scene: Scene, answer: Known, filters: Mapping[Any, mpfjax.Filter], seeds: int, seed: int
) -> list[dict[str, Any]]:
    """Errors and time of each filter, and how much worse it is than the first one."""
    observations, key = jnp.asarray(scene.observations), jax.random.key(seed)

    def once(filter: mpfjax.Filter) -> jax.Array:
        run = mpfjax.run_filter(key, filter, observations, harness.nothing)
        return run.log_marginal_likelihood

    runs = {name: lambda _, filter=filter: once(filter) for name, filter in filters.items()}
    times = {
        name: 1e3 * float(np.median(seconds)) / len(observations)
        for name, seconds in harness.turns(runs, 5).items()
    }
    rows, first = [], {}
    for name, filter in filters.items():
        result = results(scene, filter, seeds, seed)
        errors = losses(result, answer, scene.truth)
        row = {"filter": name, **summary(result, errors, scene.truth), "ms": times[name]}
        row |= {f"{what}_worse": harness.worse(errors[what], first[what]) for what in first}
        rows, first = [*rows, row], first or errors
    return rows


def results(scene: Scene, filter: mpfjax.Filter, seeds: int, seed: int) -> Found:
    """Of `seeds` runs of the filter, whose keys are split from that of `seed`."""
    keys = jax.random.split(jax.random.key(seed), seeds)
    run = mpfjax.monte_carlo(keys, filter, scene.observations, harness.nothing)
    masses = jax.vmap(scene.masses)(run.final)
    return Found(np.asarray(masses), np.asarray(run.log_marginal_likelihood))


def losses(result: Found, answer: Known, region: int) -> dict[str, np.ndarray]:
    """Of each run: squared errors of the masses and of log Ẑ, and whether the mode is lost."""
    return {
        "masses": np.mean((result.masses - answer.masses) ** 2, axis=1),
        "log_z": (result.log_z - answer.log_z) ** 2,
        "lost": (result.masses[:, region] < LOST).astype(float),
    }


def summary(result: Found, errors: dict[str, np.ndarray], region: int) -> dict[str, float]:
    """Errors of the masses and of log Ẑ, with standard errors.

    `lost` is the share of runs that leave the true `region` less than a hundredth of the mass.
    """
    rmse, rmse_error = harness.rms_and_error(errors["masses"])
    log_rmse, log_rmse_error = harness.rms_and_error(errors["log_z"])
    lost, runs, deviation = errors["lost"].mean(), len(errors["lost"]), result.log_z.std(ddof=1)
    return {
        "mass_of_truth": float(result.masses[:, region].mean()),
        "lost": float(lost), "lost_error": float(np.sqrt(lost * (1 - lost) / runs)),
        "log_z_rmse": log_rmse, "log_z_rmse_error": log_rmse_error,
        "mass_rmse": rmse, "mass_rmse_error": rmse_error,
        "largest_mass": float(np.median(result.masses.max(axis=1))),
        "log_z_sd": float(deviation),
        "log_z_sd_error": float(deviation / np.sqrt(2 * (runs - 1))),
    }  # fmt: skip


def picture(rows: list[dict[str, Any]]) -> Any:
    """For each scene the errors of the masses, and of log Ẑ below."""

    def panel(scene: str, what: str, label: str) -> plotting.Panel:
        scene_rows = [row for row in rows if row["scene"] == scene]
        ends = (lambda row, k=k: row[what] + k * row[what + "_error"] for k in (-2, 2))
        lines = plotting.lines_of(
            scene_rows, "N = {N}, ± 2 standard errors".format_map, "filter", what, *ends
        )
        return plotting.Panel(scene, label, "", lines, (0, None))

    measures = {"mass_rmse": "RMSE of the mixture weights", "log_z_rmse": r"RMSE of $\log \hat{Z}$"}
    scenes = dict.fromkeys(row["scene"] for row in rows)
    return plotting.draw_dots([[panel(s, *each) for s in scenes] for each in measures.items()], 2.7)


if __name__ == "__main__":
    raise SystemExit(main())
