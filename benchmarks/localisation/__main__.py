"""A robot that is lost in a map, and one that is carried away: who finds the true pose.

    python -m benchmarks.localisation                       # all scenes that are there
    python -m benchmarks.localisation --scenes office ring --particles 1000
    python -m benchmarks.localisation --scenes twelve --steps 40 --particles 5000

Scenes are the buildings and the map of the folder that MPFJAX_DATA names, or ../shared/data, where
they are there (each file of logs/, and turtlebot), drawn offices of nine and of ten rooms that are
equal until a pillar is seen at the end, one of twelve equal rooms without any, and a ring of 24
doors. Each has four drives. A robot knows
nothing of its pose at first; when a drive has ended it is carried away without notice, and goes on
with the next one.

A run is right where more than half of the distribution lies near the true pose: within .6 m, in a
building 1 m, and .4 rad. `right` is the share of runs that are right at the end of the first drive,
`found again` those at the end of the second, `steps` the median of the steps until a run is right
after it was carried away, of those that ever are, and `sd of log Ẑ` that of the first drive,
between runs of the same drive. `lost` is the probability that
the filter itself has for not being right, and the area is that under its ROC curve over all scans
from the eighth of a drive on; AMCL's own measure is 1 - w_fast / w_slow. Each of twelve equal rooms
has a mass of 1/12 at all times: there are the errors of these masses at the end of the first drive,
and 15 scans after the robot was carried away, and the share of rooms that are lost, with a mass
below .001. All filters have
--particles, but AMCL, which has 2000 to 5000.

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
from benchmarks.localisation.filters import NAMES, milliseconds, run
from benchmarks.localisation.scenes import ROOMS, SCENES, Scene, Stretch, with_people

TABLES = {
    "right at the end": "{right:.2f} ± {right_error:.2f}",
    "right after 20 scans": "{early:.2f} ± {early_error:.2f}",
    "area under the ROC curve of lost": "{lost_area:.3f}",
    "ms per scan": "{milliseconds:.1f}",
    "sd of log Ẑ": "{log_z_sd:.1f} ± {log_z_sd_error:.1f}",
    "found again, after steps": "{found:.2f} ± {found_error:.2f}, {steps:.0f}",
    "RMSE of equal masses, lost": "{masses_rmse:.3f}, {masses_lost:.2f}",
    "the same 15 scans after": "{masses_after_rmse:.3f}, {masses_after_lost:.2f}",
}

EARLY = 20  # scans, one per second
SETTLED = 8  # scans of a drive, from which on a pose is asked for
LATER = 15  # scans after the robot was carried away, when masses are looked at

QUICK = ["replacing 1%", "AMCL", "mixture, with_restarts"]


@command(scenes=["ring"], filters=QUICK, seeds=2, particles=100, components=4, steps=5)
def main(
    *,
    scenes: Sequence[Annotated[str, (*SCENES,)]] = (*SCENES,),
    filters: Sequence[Annotated[str, (*NAMES,)]] = (*NAMES,),
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
        drives = scene.drives
        for filter in filters:
            found = [
                follow(name, scene, filter, pair, particles, components, seeds, 4 * seed + number)
                for number, pair in enumerate(zip(drives, drives[1:] + drives[:1], strict=True))
            ]
            row = {"scene": name, "filter": filter, **summary(found, len(drives[0].poses))}
            series = series_of(drives[0])
            timed = milliseconds(filter, scene.model, particles, components, series)
            rows.append(row | ({} if timed is None else {"milliseconds": timed}))
            harness.data(out / "localisation.json", settings=settings, rows=rows)
            print(f"{name}, {filter}: {TABLES['right at the end'].format(**rows[-1])}")
        # Programs keep memory maps, of which a process has 65 530, and no other scene needs these.
        jax.clear_caches()
    for title, cell in TABLES.items():
        print(f"\n{harness.pivot(title, rows, '{filter}', '{scene}', cell)}")
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


def follow(
    name: str, scene: Scene, filter: str, drives: tuple[Stretch, Stretch], size: int,
    components: int, seeds: int, seed: int,
) -> Found:  # fmt: skip
    """Runs of a filter on a drive, after which the robot is carried to the start of another."""
    both = Stretch(*map(np.concatenate, zip(*drives, strict=True)))
    keys, poses = jax.random.split(jax.random.key(seed), seeds), jnp.asarray(both.poses, float)
    arguments = size, components, keys, series_of(both), scene.near
    trace, increments, lost = run(filter, scene.model, *arguments)
    particles, logs = trace.particles, trace.log_weights
    x, y, turn = jnp.moveaxis(particles - poses[None, :, None], -1, 0)
    turned = jnp.abs((turn + jnp.pi) % (2 * jnp.pi) - jnp.pi)
    near = (jnp.hypot(x, y) < scene.near) & (turned < 0.4)
    right = jnp.sum(jnp.where(near, jnp.exp(logs), 0.0), axis=-1) > 0.5
    log_z = jnp.sum(increments[:, : len(drives[0].poses)], axis=1)
    rooms, masses = ROOMS.get(name), None
    if rooms and not rooms.pillar:
        carried = len(drives[0].poses)
        at = np.minimum([carried - 1, carried - 1 + LATER], len(poses) - 1)
        states = np.asarray(particles[:, at])
        masses = rooms.masses(states, np.exp(logs[:, at]))
    return Found(np.asarray(right), np.asarray(log_z, float), masses, lost)


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
        settled = np.arange(right.shape[1]) % carried >= min(SETTLED, carried - 1)
        scores = np.concatenate([np.asarray(each.lost)[:, settled] for each in scored])
        is_lost = ~np.concatenate([each.right[:, settled] for each in scored])
        value = area(scores, is_lost)
        areas = {} if value is None else {"lost_area": value}
    ever = after.any(axis=1)
    return {
        "runs": runs, "carried": carried, "by_step": by_step, "errors": errors,
        **areas, "early": by_step[early], "early_error": errors[early],
        "right": by_step[carried - 1], "right_error": errors[carried - 1],
        "found": by_step[-1], "found_error": errors[-1],
        "steps": float(np.median(1 + after[ever].argmax(axis=1))) if ever.any() else None,
        "log_z_sd": deviation, "log_z_sd_error": deviation / np.sqrt(2 * (runs - len(found))),
        **errors_of_masses([each.masses for each in found if each.masses is not None]),
    }  # fmt: skip


def errors_of_masses(masses: list[np.ndarray]) -> dict[str, float]:
    """Of all runs, at both times; nothing of rooms that are not equal."""
    errors = {}
    for t, name in enumerate(("masses", "masses_after") if masses else ()):
        at = np.concatenate(masses)[:, t]
        errors[f"{name}_rmse"] = float(np.sqrt(np.mean((at - 1 / at.shape[1]) ** 2)))
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
        title = f"{name}; carried away after {carried} scans"
        share = "share of runs at the true pose"
        return plotting.Panel(title, "time (scans)", share, lines, (-0.03, 1.03), carried)

    panels = [panel(name) for name in dict.fromkeys(row["scene"] for row in rows)]
    across = 2 if len(panels) == 4 else 3
    shown = [panels[start : start + across] for start in range(0, len(panels), across)]
    return plotting.draw_panels(shown, ("linear", "linear"))


if __name__ == "__main__":
    raise SystemExit(main())
