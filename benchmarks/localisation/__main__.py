"""Global localisation and recovery: which filters find the robot, and know when they are lost.

    python -m benchmarks.localisation                       # all scenes whose data are present
    python -m benchmarks.localisation --scenes office ring --particles 1000
    python -m benchmarks.localisation --scenes twelve --steps 40 --particles 5000

The folder that MPFJAX_DATA names, or ../shared/data, has laser logs of buildings, and the map of
TurtleBot3's world: `turtlebot`, the same with AMCL's sensor (`amcl`), and with boxes that are not
on the map (`boxes`). Drawn scenes are offices of nine and of ten rooms that are equal until a
pillar is visible at the end, one of twelve equal rooms, and a ring of 24 doors. Each scene has four
drives. The pose is unknown at first; at the end of a drive the robot is carried to the start of the
next drive without notice.

A run is localised where more than half of the distribution is within .6 m (in a building 1 m) and
.4 rad of the true pose. The columns of the table are

- `20 scans`, `end`: the fraction of runs that are localised then, in the first drive;
- `found again`: the fraction at the end of the second drive, and the median number of scans until
  then;
- `ROC`: the area under the ROC curve of the filter's own probability of not being localised, over
  all scans from the eighth on; for AMCL of its measure 1 - w_fast / w_slow;
- `in walls`: the largest probability, at any scan, of an occupied cell or a place off the map;
- `ms`: CPU time per scan, the median over runs, with starts and restarts;
- `sd of log Z`: of the first drive, between runs of the same drive.

Each of twelve equal rooms has probability 1/12 at all times. Another table has the root mean
squared error of these probabilities at the end of the first drive and 15 scans after the robot was
carried away, and the fraction of rooms with a probability below .001.

Into --out DIR go localisation.json and recovery.png.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import figures as plotting
from benchmarks import harness
from benchmarks.harness import AtLeast2, Natural, Seed, command
from benchmarks.localisation.filters import FILTERS, Runs, run
from benchmarks.localisation.scenes import ROOMS, SCENES, Scene, Stretch, with_people
from mpfjax import robots

COLUMNS = {
    "scene": "{scene}",
    "filter": "{filter}",
    "20 scans": "{early:.2f} ± {early_error:.2f}",
    "end": "{right:.2f} ± {right_error:.2f}",
    "found again": "{found:.2f} ± {found_error:.2f}, {steps:.0f}",
    "ROC": "{lost_area:.3f}",
    "in walls": "{in_walls:.3f}",
    "ms": "{milliseconds:.1f}",
    "sd of log Z": "{log_z_sd:.1f} ± {log_z_sd_error:.1f}",
}
OF_ROOMS = {
    "filter": "{filter}",
    "error at the end": "{masses_rmse:.3f} ± {masses_rmse_error:.3f}",
    "below .001": "{masses_lost:.2f}",
    "error after 15 scans": "{masses_after_rmse:.3f} ± {masses_after_rmse_error:.3f}",
    "below .001 then": "{masses_after_lost:.2f}",
}

EARLY = 20  # scans, one per second
SETTLED = 8  # scans, from which on a pose is asked for
LATER = 15  # scans after the robot was carried away, when masses are looked at

QUICK = ["particle filter", "AMCL", "mixture, with_restarts"]


@command(scenes=["ring"], filters=QUICK, seeds=2, particles=100, components=4, steps=5)
def main(
    *,
    scenes: Sequence[Annotated[str, (*SCENES,)]] = (*SCENES,),
    filters: Sequence[Annotated[str, (*FILTERS,)]] = (*FILTERS,),
    particles: AtLeast2 = 2000,
    components: AtLeast2 = 16,
    seeds: AtLeast2 = 8,
    steps: AtLeast2 | None = None,
    people: Natural = 0,
    seed: Seed = 0,
    out: Path = Path("results/localisation"),
) -> None:
    """Scene by scene; what is finished is written.

    - `components`: M, of the mixtures.
    - `seeds`: runs of each of the four drives.
    - `steps`: of a drive; each scene has its own.
    - `people`: the percentage of the beams that meet people, who are not on the map.
    - `seed`: of the drives and of the runs.
    """
    settings, rows = harness.settings_of(locals()), []
    for name in scenes:
        scene = SCENES[name](seed, steps)
        scene = with_people(scene, people / 100, seed) if people else scene
        # After each drive the robot is carried to the start of the next one.
        pairs = zip(scene.drives, scene.drives[1:] + scene.drives[:1], strict=True)
        drives = [Stretch(*map(np.concatenate, zip(*pair, strict=True))) for pair in pairs]
        for filter in filters:
            keys = [
                jax.random.split(jax.random.key(4 * seed + k), seeds) for k in range(len(drives))
            ]
            data = zip(keys, map(series_of, drives), strict=True)
            all_runs = run(filter, scene.model, particles, components, scene.near, data)
            found = [found_of(name, scene, *each) for each in zip(drives, all_runs, strict=True)]
            rows.append({"scene": name, "filter": filter, **summary(found, scene.carried)})
            harness.data(out / "localisation.json", settings=settings, rows=rows)
            print(f"{name}, {filter}: {COLUMNS['end'].format(**rows[-1])}")
        # Programs keep memory maps, of which a process has 65 530, and no other scene needs these.
        jax.clear_caches()
    print(f"\n{harness.table(COLUMNS, rows)}")
    if of_rooms := [row for row in rows if "masses_rmse" in row]:
        print(f"\n{harness.table(OF_ROOMS, of_rooms)}")
    harness.figures(out, recovery=picture(rows))
    print(f"written to {out}")


class Found(NamedTuple):
    """Of each run: whether it is right at each step, and log Ẑ of the first drive."""

    right: np.ndarray  # (runs, t)
    log_z: np.ndarray
    masses: np.ndarray | None
    """(runs, 2, rooms), of rooms without a pillar: at the end of the first drive, and later."""
    lost: np.ndarray | None
    """The filter's own measure at each step, (runs, t)."""
    in_walls: float
    """The most of the distribution in occupied cells or off the map."""
    milliseconds: np.ndarray


def found_of(name: str, scene: Scene, drive: Stretch, runs: Runs) -> Found:
    """Of the runs on a drive and on the next one: where the particles are."""
    poses, trace = drive.poses, runs.trace
    particles, logs = np.asarray(trace.particles), np.asarray(trace.log_weights)
    away = particles - poses[None, :, None].astype(particles.dtype)
    x, y, turn = np.moveaxis(away, -1, 0)
    turned = np.abs((turn + np.pi) % (2 * np.pi) - np.pi)
    near = (np.hypot(x, y) < scene.near) & (turned < 0.4)
    weights = np.exp(logs)
    right = np.sum(weights, axis=-1, where=near) > 0.5
    rooms, masses = ROOMS.get(name), None
    if rooms and not rooms.pillar:
        at = np.minimum([scene.carried - 1, scene.carried - 1 + LATER], len(poses) - 1)
        masses = rooms.masses(particles[:, at], weights[:, at])
    in_walls = 0.0
    if isinstance(scene.model, robots.RobotModel):
        grid = scene.model.grid
        walls = np.asarray(grid.at(jnp.asarray(particles[..., :2]), grid.occupied, True))
        in_walls = float(np.max(np.sum(weights, axis=-1, where=walls)))
    log_z = np.sum(runs.increments[:, : scene.carried], axis=1)
    return Found(right, log_z, masses, runs.lost, in_walls, runs.milliseconds)


def series_of(drive: Stretch) -> tuple[Any, Any]:
    """Scans, and the motions with their deviations."""
    motion, deviations, _, seen = (jnp.asarray(part, jnp.float32) for part in drive)
    return seen, (motion, deviations)


def area(scores: np.ndarray, is_lost: np.ndarray) -> float | None:
    """Under the ROC curve: the probability that the score of a lost robot is above another's."""
    lost, others = scores[is_lost], np.sort(scores[~is_lost])
    if not lost.size or not others.size:
        return None
    below, upto = (np.searchsorted(others, lost, side) for side in ("left", "right"))
    return float(np.mean(below + upto) / (2 * others.size))


def summary(found: list[Found], carried: int) -> dict[str, Any]:
    """Over all runs, with standard errors; `by_step` is the share of runs that are right."""
    right = np.concatenate([each.right for each in found]).astype(float)
    deviation = float(np.sqrt(np.mean([each.log_z.var(ddof=1) for each in found])))
    runs, by_step = len(right), right.mean(axis=0)
    errors = np.sqrt(by_step * (1 - by_step) / runs)
    after, early = right[:, carried:] > 0, min(EARLY, carried) - 1
    scored = [each for each in found if each.lost is not None]
    areas = {}
    if scored:
        settled = np.arange(right.shape[1]) >= min(SETTLED, carried) - 1
        scores = np.concatenate([np.asarray(each.lost)[:, settled] for each in scored])
        is_lost = ~np.concatenate([each.right[:, settled] for each in scored])
        value = area(scores, is_lost)
        areas = {} if value is None else {"lost_area": value}
    ever, times = after.any(axis=1), np.concatenate([each.milliseconds for each in found])
    return {
        "runs": runs, "carried": carried, "by_step": by_step, "errors": errors,
        **areas, "early": by_step[early], "early_error": errors[early],
        "right": by_step[carried - 1], "right_error": errors[carried - 1],
        "found": by_step[-1], "found_error": errors[-1],
        "steps": float(np.median(1 + after[ever].argmax(axis=1))) if ever.any() else None,
        "in_walls": max(each.in_walls for each in found),
        "milliseconds": float(np.median(times[1:])),  # the first run compiles
        "log_z_sd": deviation, "log_z_sd_error": deviation / np.sqrt(2 * (runs - len(found))),
        **errors_of_masses([each.masses for each in found if each.masses is not None]),
    }  # fmt: skip


def errors_of_masses(masses: list[np.ndarray]) -> dict[str, float]:
    """Of all runs, at both times; nothing of rooms that are not equal."""
    errors = {}
    for t, name in enumerate(("masses", "masses_after") if masses else ()):
        at = np.concatenate(masses)[:, t]
        squares = np.mean((at - 1 / at.shape[1]) ** 2, axis=1)
        errors[f"{name}_rmse"], errors[f"{name}_rmse_error"] = harness.rms_and_error(squares)
        errors[f"{name}_lost"] = float(np.mean(at < 1e-3))
    return errors


def picture(rows: list[dict[str, Any]]) -> Any:
    """A panel for each scene: the share of runs at the true pose by step, ± its standard error."""

    def panel(name: str) -> plotting.Panel:
        lines, carried = {}, None
        for row in rows:
            if row["scene"] == name:
                share, error, carried = row["by_step"], row["errors"], row["carried"]
                steps = np.arange(1, len(share) + 1)
                points = zip(steps, share, share - error, share + error, strict=True)
                lines[row["filter"]] = [*points]
        title = f"{name}: moved after {carried} scans"
        share = "fraction of runs at the true pose"
        return plotting.Panel(title, "time (scans)", share, lines, (-0.03, 1.03), carried)

    panels = [panel(name) for name in dict.fromkeys(row["scene"] for row in rows)]
    across = 2 if len(panels) == 4 else 3
    shown = [panels[start : start + across] for start in range(0, len(panels), across)]
    return plotting.draw_panels(shown, ("linear", "linear"))


if __name__ == "__main__":
    raise SystemExit(main())
