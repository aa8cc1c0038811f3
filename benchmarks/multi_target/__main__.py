"""An unknown number of objects among clutter: `bernoulli_filter` beside a Gaussian mixture PHD.

    python -m benchmarks.multi_target

Twelve objects in 100 scans, after the linear scene of Vo and Vo: they come to a square of 2 km, and
move on straight lines, with 60 false plots a scan; new ones appear at known spots, or anywhere.
OSPA has the cutoff 100 m and the order 1; `number` is the mean of |expected - true number|,
`switches` those of a run, `ms a scan` the median of the runs after the first, in CPU time.

Into --out DIR go multi_target.json and multi_target.png, the first run of the first scene.
"""

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np

import mpfjax
from benchmarks import harness
from benchmarks.harness import Count, command
from benchmarks.multi_target.gm_phd import followed
from benchmarks.multi_target.scenes import SCENES, STEPS, Scene, drawn, model_of, told

CUTOFF = 100.0
CELLS = {
    "OSPA": "{ospa:.1f} ± {ospa_error:.1f}",
    "number": "{number:.2f} ± {number_error:.2f}",
    "switches": "{switches:.1f}",
    "ms a scan": "{ms:.1f}",
}


@command(seeds=2, steps=10, particles_per_target=20, scenes=["known spots"])
def main(
    *,
    scenes: Sequence[Annotated[str, (*SCENES,)]] = (*SCENES,),
    seeds: Count = 20,
    steps: Count = STEPS,
    particles_per_target: Count = 150,
    out: Path = Path("results/multi_target"),
) -> None:
    """Scene by scene.

    - `particles_per_target`: of 24 that may exist, or of 112 a third of it where objects appear
      anywhere.
    """
    settings, rows, pictures = harness.settings_of(locals()), [], {}
    for name in scenes:
        scene = SCENES[name]
        data = [drawn(scene, seed, steps) for seed in range(seeds)]
        ours, phd = _ours(scene, particles_per_target), _gm_phd(scene)
        for label, run in (("bernoulli_filter", ours), ("GM-PHD", phd)):
            scores = []
            for seed, (truth, plots) in enumerate(data):
                start = time.process_time()
                found = run(seed, plots)
                spent = (time.process_time() - start) / steps * 1e3
                scores.append([*_scores(found, truth), spent])
                if seed == 0 and label != "GM-PHD":
                    pictures[name] = (truth, plots, found)
            ospa, number, switches, ms = np.array(scores).T
            rows.append(
                {"scene": name, "filter": label}
                | dict(zip(("ospa", "ospa_error"), harness.mean_and_error(ospa), strict=True))
                | dict(zip(("number", "number_error"), harness.mean_and_error(number), strict=True))
                | {"switches": _or_none(switches.mean()), "ms": _or_none(np.median(ms[1:]))}
            )
        harness.data(out / "multi_target.json", settings=settings, rows=rows)
    for title, cell in CELLS.items():
        print(f"\n{harness.pivot(title, rows, '{filter}', '{scene}', cell)}")
    harness.figures(out, multi_target=_picture(*pictures[next(iter(pictures))]))
    print(f"written to {out}")


def _ours(scene: Scene, each: int) -> Any:
    """Positions, which of them are told, labels, and the expected number, by seed and plots."""
    most, undetected = (24, 400) if scene.known else (112, 200)
    size = undetected + most * (each if scene.known else max(each // 3, 1))
    filter = mpfjax.bernoulli_filter(model_of(scene), size, most, undetected_particles=undetected)

    def run(seed: int, plots: np.ndarray) -> tuple[np.ndarray, ...]:
        given = jnp.asarray(plots, jnp.float32)
        run = mpfjax.run_filter(jax.random.key(seed), filter, given, collect=mpfjax.targets)
        found = jax.tree.map(np.asarray, run.collected)
        places = found.means[..., [0, 2]]
        return places, found.existence > 0.5, found.labels, found.existence.sum(axis=1)

    return run


def _gm_phd(scene: Scene) -> Any:
    """The same of the rival, whose objects have no labels."""

    def run(seed: int, plots: np.ndarray) -> tuple[np.ndarray, ...]:
        places, numbers = zip(*followed(scene, plots), strict=True)
        most = max(1, *map(len, places))
        padded = np.stack([np.pad(each, ((0, most - len(each)), (0, 0))) for each in places])
        told = np.arange(most) < np.array([len(each) for each in places])[:, None]
        return padded, told, np.full(told.shape, -1), np.array(numbers)

    return run


def _or_none(value: Any) -> float | None:
    """A number that JSON has."""
    return float(value) if np.isfinite(value) else None


@jax.jit
@jax.vmap
def _ospa(estimates: Any, truths: Any, is_told: Any, is_there: Any) -> Any:
    return mpfjax.metrics.ospa(
        estimates, truths, cutoff=CUTOFF, order=1.0, estimate_mask=is_told, truth_mask=is_there
    )


def _scores(found: tuple[np.ndarray, ...], truth: np.ndarray) -> tuple[float, float, float]:
    """Mean OSPA, mean error of the number, and switches; NaN without labels."""
    places, is_told, labels, numbers = found
    there, is_there = told(truth)
    ospa = np.mean(_ospa(np.float32(places), np.float32(there), is_told, is_there))
    error = np.mean(np.abs(numbers - is_there.sum(axis=1)))
    switches = np.nan
    if (labels >= 0).all():
        shown = np.where(is_told[..., None], places, np.nan)
        true = np.where(is_there[..., None], there, np.nan)
        switches = mpfjax.metrics.track_switches(shown, labels, true, cutoff=CUTOFF)
    return float(ospa), float(error), switches


def _picture(truth: np.ndarray, plots: np.ndarray, found: tuple[np.ndarray, ...]) -> Any:
    """Tracks through the plots, and the number over time."""
    from matplotlib.figure import Figure

    places, is_told, labels, numbers = found
    figure = Figure((10, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.plot(*plots.reshape(-1, 2).T, ".", color="0.85", markersize=1, zorder=0)
    there, is_there = told(truth)
    for k in range(there.shape[1]):
        left.plot(*there[is_there[:, k], k].T, color="k", linewidth=0.8)
    for label in np.unique(labels[is_told]):
        own = is_told & (labels == label)
        left.plot(*places[own].T, ".", markersize=3)
    left.set(xlabel="x (m)", ylabel="y (m)", aspect="equal")
    steps = np.arange(1, len(truth) + 1)
    right.step(steps, is_there.sum(axis=1), color="k", where="mid", label="true")
    right.plot(steps, numbers, label="expected")
    right.set(xlabel="scan", ylabel="number of objects")
    right.legend(frameon=False)
    return figure


if __name__ == "__main__":
    raise SystemExit(main())
